"""Runs as labelled arrays: an ``xarray.Dataset`` over time, or a ``pandas.DataFrame``, with units. Not collective."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from softgrasp.fem.columns import Array, Columns, hand_of
from softgrasp.fem.errors import SoftgraspError


@dataclass(frozen=True)
class Quantity:
    """One quantity of a run over time, by components."""

    values: Array  # (times, components)
    labels: tuple[str, ...]  # labels of the components, (components,)
    units: tuple[str, ...]  # units of the components, (components,)
    dimension: str  # kind of the components: "output" or "hand"; empty for a quantity without components
    mid: bool = False  # whether a row is at the middle of a step: one row less than the times


def package(name: str) -> Any:
    """An optional package.

    Raises SoftgraspError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise SoftgraspError(f"{name} is not installed; `pip install 'softgrasp[data]'` brings it") from error


def of_energy(values: Array) -> Quantity:
    """An energy over time, (times,)."""
    return Quantity(values[:, None], ("",), ("J",), "")


def of_hand(values: Array, names: Sequence[str], *, rate: str = "", load: bool = False) -> Quantity:
    """A quantity of the hand; the dimension is that of the outputs' names."""
    return of_columns(values, hand_of(values.shape[1], names), "hand", rate=rate, load=load)


def of_columns(values: Array, columns: Columns, dimension: str, *, rate: str = "", load: bool = False) -> Quantity:
    """A quantity with one column per component; ``rate`` follows the unit, ``load`` labels forces and torques."""
    units = tuple(f"{c.load_unit if load else c.unit}{rate}" for c in columns)
    labels = tuple(c.axis for c in columns) if dimension == "hand" else tuple(c.label for c in columns)
    return Quantity(values, labels, units, dimension, mid=load)


class Labelled(ABC):
    """A run whose quantities over time have labels and units."""

    times: Array
    """Time grid, (steps + 1,) [s]."""

    @property
    @abstractmethod
    def quantities(self) -> dict[str, Quantity]:
        """What there is over time, by the name of the field."""

    @property
    def attributes(self) -> dict[str, Any]:
        """Numbers of the whole run, by name."""
        return {}

    def to_xarray(self) -> Any:
        """The run as ``xarray.Dataset`` of the dimensions time, output, hand and, for what acts in a step, midpoint.

        The unit of a quantity is in ``attrs["units"]``: one, or one per component. Not collective.

        Raises SoftgraspError: xarray is not installed.
        """
        xarray = package("xarray")
        data: dict[str, Any] = {}
        coordinates: dict[str, Any] = {"time": ("time", self.times, {"units": "s"})}
        for name, q in self.quantities.items():
            row = "midpoint" if q.mid else "time"
            if q.mid:
                coordinates[row] = (row, (self.times[1:] + self.times[:-1]) / 2, {"units": "s"})
            if not q.dimension:
                data[name] = ((row,), q.values[:, 0], {"units": q.units[0]})
                continue
            coordinates[q.dimension] = (q.dimension, list(q.labels), {})
            units = q.units[0] if len(set(q.units)) == 1 else list(q.units)
            data[name] = ((row, q.dimension), q.values, {"units": units})
        return xarray.Dataset(data, coordinates, self.attributes)

    def to_pandas(self) -> Any:
        """The run as ``pandas.DataFrame``, one column a component, "outputs tip_x [m]". Not collective.

        What acts within a step is in the row of its end, nan in the first.

        Raises SoftgraspError: pandas is not installed.
        """
        pandas = package("pandas")
        columns = {}
        for name, q in self.quantities.items():
            values = np.vstack([np.full((1, q.values.shape[1]), np.nan), q.values]) if q.mid else q.values
            for j, (label, unit) in enumerate(zip(q.labels, q.units, strict=True)):
                columns[f"{f'{name} {label}'.strip()} [{unit}]"] = values[:, j]
        return pandas.DataFrame(columns, index=pandas.Index(self.times, name="time [s]"))


def table(rows: Iterable[Mapping[str, Any]]) -> Any:
    """Rows by their keys as a ``pandas.DataFrame``. Raises SoftgraspError: pandas is not installed."""
    return package("pandas").DataFrame.from_records(list(rows))
