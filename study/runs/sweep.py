"""A scene at many values of its keys, each point on its own ranks; points that a file holds are not run again."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp import __version__
from softgrasp.fem import Model, RunOptions, Scene, Trajectory, adapt, note, remove_own, scene_hash, simulate
from softgrasp.fem.errors import Interrupted, SceneError, SoftgraspError, shortened
from softgrasp.fem.labelled import package, table
from softgrasp.fem.scene.file import find_scene, load_scene, unit_of
from softgrasp.fem.shown import Card, Shown, listed
from softgrasp.reduction import ReducedModel, errors_linear, full_run, reduce_linear, replay_linear

METHOD = "craig_bampton"  # needs no snapshots of the other values, and is stable at all of them
MOST = 100_000  # points: each is a run
DECADE = 10.0  # ratio of the largest listed value to the least from which an axis is logarithmic
FORM = "write KEY=FIRST:LAST:COUNT, KEY=FIRST:LAST:COUNT:log or KEY=A,B,C, as in tissue.material.mu=100:500:9"


@dataclass(frozen=True)
class SweepAxis:
    """One key and its values."""

    key: str  # of the scene
    values: tuple[float, ...]  # in its unit
    log: bool = False  # whether its axis is logarithmic


def axis_label(key: str) -> str:
    """The last word of a key with its unit, "mu [Pa]"."""
    name, unit = key.rsplit(".", 1)[-1], unit_of(key)
    return f"{name} [{unit}]" if unit else name


def parse_axis(text: str) -> SweepAxis:
    """``key=first:last:count[:log]`` or ``key=a,b,c``; whole numbers stay whole where all values are."""
    key, _, right = text.partition("=")
    parts, log = right.split(":"), right.endswith(":log")
    try:
        if len(parts) == 1:
            values = [float(word) for word in right.split(",")]
        else:
            first, last, count = float(parts[0]), float(parts[1]), int(parts[2])
            if count > MOST:
                raise SceneError(
                    f"'{shortened(text)}' has {shortened(str(count))} values; a sweep has at most {MOST} points"
                )
            with np.errstate(all="ignore"):
                values = [float(x) for x in (np.geomspace if log else np.linspace)(first, last, count)]
        good = bool(key) and len(parts) - log in (1, 3) and bool(np.isfinite(values).all()) and len(values) > 0
    except (ValueError, IndexError):
        good = False
    if not good:
        raise SceneError(f"'{shortened(text)}' is no sweep; {FORM}")
    whole = all(x == int(x) for x in values) and "." not in right and "e" not in right.lower()
    log = log or (len(parts) == 1 and min(values) > 0 and max(values) >= DECADE * min(values))
    return SweepAxis(key, tuple(int(x) for x in values) if whole else tuple(values), log)


def parse_axes(texts: Sequence[str]) -> tuple[SweepAxis, ...]:
    """:func:`parse_axis` of every text. Raises SceneError: also where a key is given twice, or for too many points."""
    axes = tuple(parse_axis(text) for text in texts)
    keys = [axis.key for axis in axes]
    if twice := next((shortened(key) for key in keys if keys.count(key) > 1), None):
        raise SceneError(f"{twice} is swept twice; give all its values at once, as in {twice}=1,2,5")
    checked_count(axes)
    return axes


def checked_count(axes: Sequence[SweepAxis]) -> None:
    """Raise SceneError where these have no point, or too many."""
    count = math.prod(len(axis.values) for axis in axes)
    if not 0 < count <= MOST:
        raise SceneError(f"the sweep has {count} points; give at least one and at most {MOST}")


@dataclass(frozen=True)
class Sweep:
    """A scene and the values of its keys."""

    path: Path  # scene file
    overrides: Sequence[str]  # arguments of ``--set``
    axes: tuple[SweepAxis, ...]  # keys with their values; all combinations are run
    N: int | None = None  # columns of the reduced model that runs instead of the full one; None for the full model

    def points(self) -> list[dict[str, float]]:
        """The values of every point, the last key fastest."""
        keys = [axis.key for axis in self.axes]
        return [dict(zip(keys, v, strict=True)) for v in itertools.product(*(axis.values for axis in self.axes))]

    def scene(self, values: dict[str, float]) -> Scene:
        """The scene of a point. Raises SceneError: a key or a value is wrong."""
        kept = ["output.snapshots=none"] if self.N is None else []
        return load_scene(self.path, [*self.overrides, *kept, *(f"{key}={value!r}" for key, value in values.items())])


@dataclass(frozen=True)
class SweepPoint:
    """One point: the values of its keys, and its numbers or why there are none."""

    values: dict[str, float]  # value of each key
    numbers: dict[str, float | None]  # lag and end of each output, energy drift or error of the reduced model, seconds
    reason: str = ""  # why there are no numbers, else empty

    def row(self) -> dict[str, Any]:
        """The keys of result.json."""
        return {**self.values, **self.numbers, **({"reason": self.reason} if self.reason else {})}

    def lags(self) -> dict[str, float]:
        """Largest distance of each output from the rigid motion, by the label of its column."""
        return {name: x for name, x in self.numbers.items() if " lag " in name and x is not None}


def only_material(a: Scene, b: Scene) -> bool:
    """Whether two scenes differ in ``tissue.material`` alone, so that no new assembly is needed."""
    left, right = (s.model_dump(mode="json", exclude={"tissue": {"material"}}) for s in (a, b))
    return left == right and not a.tissue.layers and a.tissue.refine is None


class Runner:
    """Runs points on one group of ranks and keeps what the next may use again: the model, the reduced model."""

    def __init__(self, sweep: Sweep, comm: MPI.Intracomm, out: Path) -> None:
        self.sweep, self.comm, self.out = sweep, comm, out
        self.model: Model | None = None
        self.rom: ReducedModel | None = None
        self.base: Trajectory | None = None

    def at(self, scene: Scene) -> Model:
        """Model of a scene, by sums of the matrices that are there where only the material differs. Collective."""
        if self.model is None or not only_material(self.model.scene, scene):
            self.model, self.rom = adapt.build(scene, comm=self.comm), None
        m = scene.tissue.material
        return self.model.with_materials(m.lam, m.mu, m.rho) if only_material(self.model.scene, scene) else self.model

    def numbers(self, scene: Scene, with_error: bool) -> dict[str, float | None]:
        """Largest distance of each output from the rigid motion, final outputs, energy drift, seconds. Collective."""
        N = self.sweep.N
        if N is None:
            model = self.at(scene)
            run = simulate(model, RunOptions(self.out))
            lags = _outputs(run, run.outputs)
            return {**lags, "energy_drift": run.energy_drift, "seconds": run.seconds["steps"]}
        if self.rom is None:
            first = self.at(self.sweep.scene({}))
            self.base = simulate(first)
            self.rom = reduce_linear(first, [full_run(first, self.base)], METHOD, N)
        model = self.at(scene)
        if self.base is None or not only_material(self.sweep.scene({}), scene):
            raise SceneError(f"--reduced {N}: the reduced model is affine in tissue.material only; sweep its keys")
        begin = MPI.Wtime()
        small = replay_linear(self.rom, model, self.base)
        seconds, off = MPI.Wtime() - begin, None
        if with_error:
            off = float(errors_linear(self.rom, small, full_run(model, simulate(model))).error_deformation)
        return {**_outputs(self.base, small.outputs), "seconds": seconds, "error_deformation": off}


def _outputs(run: Trajectory, outputs: np.ndarray) -> dict[str, float]:
    """Numbers of the outputs, by the labels of their columns."""
    numbers = {"lag": np.abs(outputs - run.outputs_rigid).max(axis=0), "end": outputs[-1]}
    return {
        f"{c.label} {what} [{c.unit}]": float(x)
        for what, values in numbers.items()
        for c, x in zip(run.columns, values, strict=True)
    }


def run_sweep_points(
    sweep: Sweep, out: Path, comm: MPI.Intracomm, each: int, progress: Callable[[int, int], None]
) -> list[SweepPoint]:
    """All points, ``comm.size / each`` at a time, in their order on all ranks. Collective.

    A point that fails has its reason instead of numbers and is tried again by the next call. ``out`` takes a file of
    points a group of ranks; ``progress`` gets the points done (of the own group, times the groups) and in all.

    Raises:
        SceneError: a key or a value is wrong; on all ranks, before the first run.
        Interrupted: as it was asked; the next call goes on.
    """
    points = sweep.points()
    scenes = [sweep.scene(values) for values in points]
    keys = _keys(sweep, scenes)
    done: dict[str, SweepPoint] = comm.bcast(
        _read(out, dict(zip(keys, points, strict=True))) if comm.rank == 0 else None
    )
    groups = max(1, comm.size // each)
    number = min(comm.rank // each, groups - 1)
    group = comm.Split(number, comm.rank)
    runner, file = Runner(sweep, MPI.Intracomm(group), out / f"stopped-{number}"), out / f"points-{number}.jsonl"
    missing = [i for i, key in enumerate(keys) if key not in done]
    own: dict[str, SweepPoint] = {}
    for count, i in enumerate(missing[number::groups], start=1):
        try:
            point = SweepPoint(points[i], runner.numbers(scenes[i], with_error=i in (0, len(points) - 1)))
        except Interrupted:
            if group.rank == 0:
                remove_own(out, runner.out)  # nothing goes on within a point
            at = ", ".join(f"{key} = {value:g}" for key, value in points[i].items())
            raise Interrupted(f"stopped at {at}; the same command goes on from there") from None
        except SoftgraspError as error:
            own[keys[i]] = SweepPoint(points[i], {}, str(error))
        else:
            own[keys[i]] = point
            if group.rank == 0:
                note(file)
                with file.open("a") as lines:
                    lines.write(json.dumps(_sealed(keys[i], point.numbers)) + "\n")
        progress(min(len(points), len(points) - len(missing) + count * groups), len(points))
    for part in comm.allgather(own):
        done |= part
    group.Free()
    return [done[key] for key in keys]


@dataclass(frozen=True, repr=False)
class SweepTable(Shown):
    """The points of a sweep in their order."""

    points: tuple[SweepPoint, ...]
    """Values and numbers of every point."""

    def card(self) -> Card:
        """Keys, and what there is at each point."""
        first = self.points[0]
        failed = sum(bool(point.reason) for point in self.points)
        rows = (
            ("keys", listed(first.values)),
            ("numbers", listed(first.numbers)),
            ("points", f"{len(self.points)}, of them {failed} refused"),
        )
        return Card("Sweep", rows)

    def to_pandas(self) -> Any:
        """One row a point, as ``pandas.DataFrame``. Raises SoftgraspError: pandas is not installed."""
        return table(point.row() for point in self.points)

    def to_xarray(self) -> Any:
        """A dimension a key, as ``xarray.Dataset``; values that are lists are labels, as "[4, 8]".

        A number is NaN where its point was refused; units are in ``attrs["units"]``.

        Raises SoftgraspError: xarray is not installed.
        """
        xarray = package("xarray")

        def mark(value: Any) -> Any:
            return value if isinstance(value, int | float | str) else str(list(value))

        places = [tuple(mark(value) for value in point.values.values()) for point in self.points]
        axes = {key: list(dict.fromkeys(at[i] for at in places)) for i, key in enumerate(self.points[0].values)}
        data = {}
        for name in dict.fromkeys(name for point in self.points for name in point.numbers):
            numbers = np.full([len(values) for values in axes.values()], np.nan)
            for point, place in zip(self.points, places, strict=True):
                if (number := point.numbers.get(name)) is not None:
                    numbers[tuple(v.index(x) for v, x in zip(axes.values(), place, strict=True))] = number
            word, _, unit = name.partition(" [")
            data[word] = (tuple(axes), numbers, {"units": unit.rstrip("]")} if unit else {})
        return xarray.Dataset(data, {key: (key, values, {"units": unit_of(key)}) for key, values in axes.items()})


def sweep(scene: str | Path, values: Mapping[str, Sequence[float]], *, N: int | None = None) -> SweepTable:
    """Lag = max_t |y - C_s q_s| and end = y(T) of a scene at all combinations of some values of its keys. Collective.

    >>> import softgrasp as sg
    >>> table = sg.sweep("paper_forward", {"tissue.material.mu": [20, 500], "tissue.cells": [[2, 4]]})
    >>> [point.numbers["tip_x lag [m]"] > 0.01 for point in table.points]
    [True, True]

    Args:
        scene: the path of its file, or the name of one that ships.
        values: of each key, "section.key"; where only the material differs nothing is assembled again.
        N: columns of a reduced model that runs instead of the full one (a sweep of the material).

    Raises:
        SceneError: a key or a value is wrong, or there are more than 100000 points; a point that cannot be run has
            its ``reason`` instead of numbers.
    """
    if single := next((key for key, each in values.items() if isinstance(each, str) or not np.iterable(each)), None):
        raise SceneError(f"{shortened(single)} needs a list of values, as in {{'tissue.material.mu': [20, 500]}}")
    axes = tuple(SweepAxis(key, tuple(each)) for key, each in values.items())
    checked_count(axes)
    plan = Sweep(find_scene(scene), (), axes, N)
    with TemporaryDirectory(prefix="softgrasp-sweep-") as folder:
        points = run_sweep_points(plan, Path(folder), MPI.COMM_WORLD, MPI.COMM_WORLD.size, lambda done, of: None)
    return SweepTable(tuple(points))


def _keys(sweep: Sweep, scenes: Sequence[Scene]) -> list[str]:
    return [f"{scene_hash(scene)}-{sweep.N}-{__version__}" for scene in scenes]


def read_points(sweep: Sweep, out: Path) -> dict[str, SweepPoint]:
    """The points of a sweep that earlier calls have left in a folder. Not collective."""
    points = sweep.points()
    return _read(out, dict(zip(_keys(sweep, [sweep.scene(values) for values in points]), points, strict=True)))


def _sealed(key: str, numbers: dict[str, float | None]) -> dict[str, Any]:
    """The line of a point, with the SHA-256 of what it says."""
    return {"key": key, "numbers": numbers, "sha256": hashlib.sha256(json.dumps([key, numbers]).encode()).hexdigest()}


def _read(out: Path, points: dict[str, dict[str, float]]) -> dict[str, SweepPoint]:
    """Which of these points earlier calls have run; a line that is not what was written is no point."""
    done = {}
    for file in sorted(out.glob("points-*.jsonl")):
        for line in file.read_text(errors="replace").splitlines() if file.is_file() else ():
            try:
                entry = json.loads(line)
                key, numbers = entry["key"], entry["numbers"]
                if entry == _sealed(key, numbers) and key in points:
                    done[key] = SweepPoint(points[key], numbers)
            except (ValueError, TypeError, KeyError, RecursionError):
                continue
    return done
