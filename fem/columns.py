"""Columns of outputs and of the hand: name, axis and unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

AXES, TURNS = ("x", "y", "z"), ("rx", "ry", "rz")


@dataclass(frozen=True)
class OutputColumn:
    """One component of an output, or one degree of freedom of the hand."""

    name: str  # name of the output, "tip"
    axis: str = ""  # x, y, z of a displacement, rx, ry, rz of a rotation; empty for a number without direction

    @property
    def label(self) -> str:
        """Name and axis, as in tables and files: "tip_x"."""
        return f"{self.name}_{self.axis}" if self.axis else self.name

    @property
    def rotation(self) -> bool:
        """Whether it is an angle."""
        return self.axis in TURNS

    @property
    def unit(self) -> str:
        """Of the displacement or angle; of its rate of change with "/s"."""
        return "rad" if self.rotation else "m"

    @property
    def load_unit(self) -> str:
        """Of the force along the axis, or of the torque about it."""
        return "N m" if self.rotation else "N"

    @property
    def title(self) -> str:
        """Name and axis for a figure."""
        if self.rotation:
            return f"{self.name}, about {self.axis[1]}"
        return f"{self.name}, {self.axis}" if self.axis else self.name


Columns = tuple[OutputColumn, ...]


def labels(columns: Sequence[OutputColumn]) -> tuple[str, ...]:
    """Name and axis of each column."""
    return tuple(column.label for column in columns)


def label_unit(label: str) -> str:
    """Unit of an output by its label: "rad" of "tip_rz", else "m"."""
    return "rad" if label.rpartition("_")[2] in TURNS else "m"


def hand_of(n_s: int, outputs: Sequence[str]) -> Columns:
    """The hand's degrees of freedom where only the labels of the outputs determine whether it moves in space."""
    return hand_columns(n_s, 3 if n_s == 6 or any(name.endswith("_z") for name in outputs) else 2)


def hand_columns(n_s: int, dimension: int, name: str = "hand") -> Columns:
    """The hand's degrees of freedom: x, y (z), then the rotations rz in the plane, rx, ry, rz in space."""
    turns = TURNS[2:] if dimension == 2 else TURNS
    return tuple(OutputColumn(name, axis) for axis in (*AXES[:dimension], *turns)[:n_s])


def placed(q: Array, columns: Sequence[OutputColumn], digits: int) -> str:
    """Values by their units, in so many digits: "(0.02, -0.02) m", "(0.02, -0.02) m, 0.1 rad"."""
    parts = []
    for unit in dict.fromkeys(column.unit for column in columns):
        values = [f"{x:.{digits}g}" for x, column in zip(q, columns, strict=True) if column.unit == unit]
        parts.append(f"{values[0] if len(values) == 1 else f'({", ".join(values)})'} {unit}")
    return ", ".join(parts)


def farthest(outputs: Array, target: Array, columns: Sequence[OutputColumn] = ()) -> Array:
    """Distance of the farthest output from its target [m], (m,); rotations count only where there is nothing else.

    Args:
        outputs: (m, p).
        target: (p,).
        columns: one per output component; those without axis, and all when there are none, count as one vector.
    """
    known = [*columns, *[OutputColumn("")] * (outputs.shape[1] - len(columns))]
    groups: dict[str, list[int]] = {}
    for i, column in enumerate(known):
        if not column.rotation or all(other.rotation for other in known):
            groups.setdefault(column.name if column.axis in AXES else "", []).append(i)
    error = outputs - target
    return np.asarray(np.max([np.linalg.norm(error[:, group], axis=1) for group in groups.values()], axis=0))
