"""The questions of reduced models: basis x N against error and time, and engines that factor the snapshots."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.fields.probe import Probe, make_probe
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.engines import ENGINES, factor, small_svd
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import Stepper, prepared, run
from softgrasp.reduction.projection import project
from softgrasp.reduction.propagator import propagator
from softgrasp.reduction.registry import METHODS, possible_sizes
from softgrasp.reduction.replay import FullRun, comparison_of, full_run, replay_inputs
from softgrasp.reduction.states import States
from softgrasp.study.precision.fit import Slope, power_law
from softgrasp.study.precision.full import FullRuns, Series, errors_of
from softgrasp.study.precision.points import Row, Setting, WorkPoint, number, scene_setting
from softgrasp.study.precision.reference import Reference
from softgrasp.study.reduce.result import Point
from softgrasp.study.reduce.sweep import bases_of, chosen_methods, measure

CALLS = 2_000  # single steps of a reduced model that are timed
ENGINE_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
ENGINE_WORK = {"tsqr": 2e-3, "svd": 2e-2, "gram": 1e-3}  # of one basis, in the unit of the guard, over rows x columns^2
WIDEST = 2e8  # entries of the snapshots beyond which the slower engines are left out


class ReducedRuns:
    """Reduced models of one mesh and step; the full run is made when the first point is not in the cache. Collective.

    Args:
        scene: the study's scene.
        setting: of the full run behind the bases.
        runs: of the full model.
        truth: reference solution.
    """

    def __init__(self, scene: Scene, setting: Setting, runs: FullRuns, truth: Reference) -> None:
        self.scene, self.setting, self.runs, self.truth = scene, setting, runs, truth
        self._made: tuple[FullRun, Probe, Model] | None = None

    def full(self) -> tuple[FullRun, Probe, Model]:
        """The full run with snapshots, and the places on its mesh."""
        if self._made is None:
            comm = self.runs.cache.comm
            model = self.runs.model(self.setting)
            fresh = Model(
                self.runs.variant(self.setting, "memory"), model.space, model.system, model.inventory, Stopwatch(comm)
            )
            probe = make_probe(fresh.space, self.runs.places.points, self.scene.effects.rotation)
            self._made = (full_run(fresh, simulate(fresh)), probe, fresh)
        return self._made

    def rows(self, name: str, sizes: Sequence[int]) -> list[Row]:
        """Every N of one basis: errors and times; see :func:`_measured`."""
        wanted = self.scene.reduction.model_copy(update={"N": list(sizes)})
        key = {
            "method": name, "N": list(sizes), "inner": wanted.inner, "engine": wanted.engine, "energy": wanted.energy,
            "setting": [self.setting.cells, self.setting.order, self.setting.steps, self.setting.solver],
        }  # fmt: skip

        def sweep() -> Row:
            against, probe, model = self.full()
            states = States(model.system, ((model.system, against.snapshots),))
            refused: dict[int, str] = {}
            found = possible_sizes(METHODS[name], model.system.layout.n_s, wanted.N)
            bases, _ = bases_of(name, states, found, wanted, refused)
            outputs, key = make_outputs(model.scene, model.system), scene_hash(model.scene)
            models = [project(basis, model.system, outputs, key) for basis in bases]
            shared = comparison_of(models[-1], against) if models else None  # the largest holds the others
            rows = [_measured(m, measure(m, against, shared), against, probe) for m in models]
            return {"rows": rows, "refused": {str(k): v for k, v in refused.items()}}

        return list(self.runs.cache.get("reduced", key, sweep)["rows"])

    def points(self, name: str, sizes: Sequence[int], full: Row) -> list[WorkPoint]:
        """Points of one basis. ``full`` is the row of the full run behind it."""
        self.runs.guard.next(f"{METHODS[name].title}, {self.setting.label}", 5e5)
        return [self._point(name, row, full) for row in self.rows(name, sizes)]

    def _point(self, name: str, row: Row, full: Row) -> WorkPoint:
        series = Series(np.array(row["times"], float), np.array(row["values"], float), full["dimension"])
        finite = bool(np.isfinite(series.values).all())
        error, displacement = errors_of(series, self.truth.series) if finite else (float("inf"), float("inf"))
        scratch = row["time_offline"] + row["time_setup"] + row["time_online"]
        scratch += full["seconds"] if METHODS[name].snapshots else full["mesh"] + full["assembly"]
        kept = {k: v for k, v in row.items() if k not in ("times", "values")}
        gap = errors_of(series, self.runs.series(full))[0] if finite else float("inf")
        details = {
            "method": name, **kept,
            "error_full": number(row["error"]), "error_full_deformation": number(row["error_deformation"]),
            "error_outputs_full": gap, "error_deformation": error, "error_displacement": displacement,
            "error_range": self.truth.range_of(error), "scratch": scratch, "mesh": self.setting.mesh,
            "steps": self.setting.steps, "cells": None if self.setting.cells is None else list(self.setting.cells),
            "order": self.setting.order, "solver": self.setting.solver, "rtol": None,
        }  # fmt: skip
        details.pop("error", None)
        label = f"{METHODS[name].title}, N = {row['N']}, {self.setting.label}"
        return WorkPoint("reduced", name, label, row["time_online"], error, bool(row["stable"]) and finite, details)


def _measured(model: ReducedModel, point: Point, against: FullRun, probe: Probe) -> Row:
    """Errors and times of one reduced model with its outputs at the places, and quantiles of single steps. Collective.

    Keys: those of :class:`study.reduce.result.Point`, times and values of its outputs, p50, p99 and max of a step.
    """
    system = against.model.system
    comm = system.layout.comm
    small = model.at()
    with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
        step, drive = replay_inputs(model, small, against)
        found = run(step, allow_unstable=True, **drive)
        lift = model.lift
        C = probe.of_rows(comm, lift.L_q) if lift is not None else np.zeros((len(probe.weights), small.N))
        own = found.x @ C.T
        y = own + found.q_s @ probe.C_s.T
        stamps = _steps(model, against) if small.stable else np.full(1, np.nan)
    stamps = np.array([comm.allreduce(float(np.quantile(stamps, q)), MPI.MAX) for q in (0.5, 0.99, 1.0)])
    row: Row = {k: getattr(point, k) for k in Point.__dataclass_fields__}
    row |= dict(zip(("p50", "p99", "max"), stamps.tolist(), strict=True))
    return row | {"times": found.times, "values": np.hstack([own, y])}


def _steps(model: ReducedModel, against: FullRun) -> Array:
    """Seconds of single steps, called one by one as a control loop would. Not collective."""
    step = Stepper(prepared(propagator(model.at(), against.dt), None, False))
    force, stamps = against.force, np.empty(CALLS)
    for k in range(CALLS):
        begin = time.perf_counter()
        step(force[k % len(force)])
        stamps[k] = time.perf_counter() - begin
    return stamps


def sweep_reduced(
    scene: Scene, runs: FullRuns, truth: Reference, full: Row, names: Sequence[str] = ()
) -> list[WorkPoint]:
    """All bases of the scene at all N, on the scene's own mesh and step. Collective.

    Raises:
        BasisError: a basis is unknown.
        SolverError: a solve or a factorisation failed.
        Interrupted: somebody asked to stop.
    """
    made = ReducedRuns(scene, own_setting(scene), runs, truth)
    points: list[WorkPoint] = []
    for name in names or chosen_methods(scene.reduction):
        points += made.points(name, scene.reduction.N, full)
    return points


def own_setting(scene: Scene) -> Setting:
    """The scene's mesh, order and steps, as the forward diagram names them. Not collective."""
    own = scene_setting(scene)
    return Setting(own.cells, own.order, own.steps)


def reduced_slopes(points: Sequence[WorkPoint]) -> list[Slope]:
    """Slope of the error of the outputs against N, and of online time against N, for every basis. Not collective."""
    found = []
    for name in dict.fromkeys(p.series for p in points):
        mine = [p for p in points if p.series == name and p.ok]
        for against, values in (
            ("error against N", [p.details["error_outputs_full"] for p in mine]),
            ("online seconds against N", [p.seconds for p in mine]),
        ):
            power = power_law([p.details["N"] for p in mine], values)
            if power is not None:
                found.append(Slope("reduced", name, against, power, len(mine)))
    return found


def sweep_bases(scene: Scene, runs: FullRuns, truth: Reference) -> list[WorkPoint]:
    """Every engine at several tolerances on the snapshots of the scene's own run. Collective.

    The error is what the basis leaves of the snapshots, |X - U U' X|_F / |X|_F, measured and not read off the engine's
    own singular values; the time is that of factoring and making the vectors, the median of repeats.

    Raises:
        SolverError: a solve or a factorisation failed.
        Interrupted: somebody asked to stop.
    """
    made, comm = ReducedRuns(scene, own_setting(scene), runs, truth), runs.cache.comm
    points: list[WorkPoint] = []
    for engine in ENGINES:
        runs.guard.next(f"engine {engine}", engine_work(scene, engine))
        s = made.setting
        key = {"engine": engine, "setting": [s.cells, s.order, s.steps], "repeats": scene.study.repeats}

        def sweep(engine: Any = engine) -> Row:
            X = made.full()[0].snapshots.Z
            if X.size * comm.size > WIDEST and engine == "svd":
                return {"rows": []}
            return {"rows": [_engine(comm, X, engine, t, scene.study.repeats) for t in ENGINE_TOLERANCES]}

        for row in runs.cache.get("basis", key, sweep)["rows"]:
            label = f"{engine}, tolerance {row['tolerance']:g}, {row['columns']} vectors"
            ok = row["error"] is not None and row["error"] <= 1.1 * row["tolerance"]
            points.append(WorkPoint("bases", engine, label, row["seconds"], row["error"], ok, row))
    return points


def engine_work(scene: Scene, engine: str) -> float:
    """Expected work of one engine at all tolerances, in the unit of the guard. Not collective."""
    own, d = own_setting(scene), scene.dimension or 3
    rows, columns = 2.0 * max(own.unknowns(d), 300), own.steps + 1
    if rows * columns > WIDEST and engine == "svd":
        return 0.0
    return len(ENGINE_TOLERANCES) * (1 + scene.study.repeats) * ENGINE_WORK[engine] * rows * columns**2


def bases_slopes(points: Sequence[WorkPoint]) -> list[Slope]:
    """Slope of what is left of the snapshots, and of the seconds, against the vectors; every engine. Not collective."""
    found = []
    for name in dict.fromkeys(p.series for p in points):
        mine = [p for p in points if p.series == name and p.ok]
        for against, values in (
            ("left of the snapshots against vectors", [p.error for p in mine]),
            ("seconds against vectors", [p.seconds for p in mine]),
        ):
            power = power_law([p.details["columns"] for p in mine], values)
            if power is not None:
                found.append(Slope("bases", name, against, power, len(mine)))
    return found


def _engine(comm: MPI.Intracomm, X: Array, engine: Any, tolerance: float, repeats: int) -> Row:
    """Factor, keep what the tolerance asks for, and measure what is left. Collective."""
    square = float(total(comm, np.array([np.sum(X * X)]))[0])

    def vectors() -> Array:
        f = factor(comm, X, engine)
        u, s, _ = small_svd(comm, f.R)
        tail = np.sqrt(np.append(np.cumsum((s**2)[::-1])[::-1][1:], 0.0)) * f.scale
        keep = min(int(np.argmax(tail <= tolerance * np.sqrt(square))) + 1, len(s))
        return np.asarray(f.Q @ u[:, :keep])

    U = vectors()
    rest = X - U @ total(comm, U.T @ X)
    error = float(np.sqrt(total(comm, np.array([np.sum(rest * rest)]))[0] / square))
    off = float(np.abs(total(comm, U.T @ U) - np.eye(U.shape[1])).max())
    seconds = _median(comm, vectors, repeats)
    return {"tolerance": tolerance, "columns": U.shape[1], "error": error, "orthonormality": off, "seconds": seconds}


def _median(comm: MPI.Intracomm, call: Callable[[], object], repeats: int) -> float:
    """Median seconds of a collective call on the slowest rank. Collective."""
    found = []
    for _ in range(repeats):
        comm.Barrier()
        begin = time.perf_counter()
        call()
        found.append(float(comm.allreduce(time.perf_counter() - begin, MPI.MAX)))
    return statistics.median(found)
