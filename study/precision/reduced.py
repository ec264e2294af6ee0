"""The questions of reduced models: basis x N against error and time, and engines that factor the snapshots."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Array, Probe, Stopwatch, make_probe, simulate, total
from softgrasp.reduction import ReducedModel, Stepper, find_method, prepared, states_of
from softgrasp.reduction.bases.engines import ENGINES, EngineName, Factor, factor, small_svd
from softgrasp.reduction.online import run
from softgrasp.reduction.propagator import propagator
from softgrasp.reduction.replay import FullRun, full_run, replay_inputs
from softgrasp.study.precision.fit import slopes
from softgrasp.study.precision.full import FullRuns, Series, errors_of
from softgrasp.study.precision.points import BasisPoint, ReducedPoint
from softgrasp.study.precision.result import Question, ReferenceSolution
from softgrasp.study.precision.settings import Setting
from softgrasp.study.reduce.linear.bases import bases_of
from softgrasp.study.reduce.linear.measure import chosen_methods, measured
from softgrasp.study.reduce.linear.result import Point
from softgrasp.study.shell import repeated

CALLS = 2_000  # single steps of a reduced model that are timed
ENGINE_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
LONG = 1.0  # seconds of a factorisation that is not repeated
WIDEST = 2e8  # entries of the snapshots beyond which the slower engines are left out


@dataclass(frozen=True, kw_only=True)
class TimedModel(Point):
    """A reduced model with its outputs at the places."""

    p50: float  # median time of a step [s]; inf when it is unstable
    p99: float  # 99 % quantile of the time of a step [s]; inf when it is unstable
    max: float  # largest time of a step [s]; inf when it is unstable
    times: Array  # times of its outputs, (steps + 1,) [s]
    values: Array  # deformations of the p outputs, then the outputs, at these times, (steps + 1, 2 p) [m, rad]


class ReducedRuns:
    """Reduced models of one mesh and step; the full run is made again when the cache lacks a point. Collective.

    Args:
        setting: mesh, order, steps and solver of the full run.
        runs: full runs and their cache.
        truth: reference solution that errors refer to.
    """

    def __init__(self, setting: Setting, runs: FullRuns, truth: ReferenceSolution) -> None:
        self.scene, self.setting, self.runs, self.truth = runs.scene, setting, runs, truth
        self.timed = runs.run(setting)  # the full run behind the models, without its snapshots
        self._full: tuple[FullRun, Probe] | None = None

    def full(self) -> tuple[FullRun, Probe]:
        """The full run with snapshots, and the places on its mesh."""
        if self._full is None:
            model, scene = self.runs.model(self.setting), self.runs.variant(self.setting, "memory")
            fresh = replace(model, scene=scene, watch=Stopwatch(self.runs.cache.comm))
            probe = make_probe(fresh.space, self.runs.places.points, self.scene.effects.rotation)
            self._full = full_run(fresh, simulate(fresh)), probe
        return self._full

    def points(self, name: str, sizes: Sequence[int]) -> list[ReducedPoint]:
        """A point for every N of ``sizes`` with the basis ``name`` of ``[reduction]``."""
        section = self.scene.reduction.model_copy(update={"N": list(sizes)})
        key = {
            "method": name, "N": list(sizes), "inner": section.inner, "engine": section.engine,
            "energy": section.energy, "setting": self.setting.parameters,
        }  # fmt: skip

        def sweep() -> list[TimedModel]:
            against, probe = self.full()
            bases, _ = bases_of(name, states_of(against.model.system, against.snapshots), section.N, section, {})
            return [
                _timed_model(each.model, each.timed(against), against, probe) for each in measured(bases, against, {})
            ]

        label = f"{find_method(name).title}, {self.setting.label}"
        models = self.runs.cache.point(label, "reduced", key, TimedModel, sweep)
        return [self._point(name, model) for model in models]

    def _point(self, name: str, model: TimedModel) -> ReducedPoint:
        """The point of one model, with errors against reference and full run."""
        full = self.timed
        series = Series(model.times, model.values, full.dimension)
        finite = bool(np.isfinite(series.values).all())
        lost = (float("inf"), float("inf"))
        error, displacement = errors_of(series, self.truth.series) if finite else lost
        scratch = model.time_offline + model.time_setup + model.time_online
        scratch += full.seconds if find_method(name).snapshots else full.mesh + full.assembly
        label, setting = f"{find_method(name).title}, N = {model.N}, {self.setting.label}", self.setting
        own = ("error", "error_deformation", "times", "values")
        return ReducedPoint(
            name, label, model.time_online, error, model.stable and finite, method=name, mesh=setting.mesh,
            error_displacement=displacement, error_range=self.truth.range_of(error), **setting.entries,
            error_full=model.error, error_full_deformation=model.error_deformation,
            error_outputs_full=errors_of(series, full.series)[0] if finite else float("inf"), scratch=scratch,
            **{k: v for k, v in vars(model).items() if k not in own},
        )  # fmt: skip


def _timed_model(model: ReducedModel, point: Point, against: FullRun, probe: Probe) -> TimedModel:
    """Add outputs at the places and quantiles of single steps to the errors of one reduced model. Collective."""
    system = against.model.system
    comm = system.layout.comm
    small = model.at()
    with np.errstate(all="ignore"):  # an unstable model may overflow, and is marked
        step, drive = replay_inputs(model, small, against)
        move = run(step, allow_unstable=True, **drive)
        reconstruction = model.reconstruction
        rows = len(probe.weights), small.N
        C = np.zeros(rows) if reconstruction is None else probe.of_rows(comm, reconstruction.L_q)
        own = move.x @ C.T
        y = own + move.q_s @ probe.C_s.T
        stamps = _steps(model, against) if small.stable else np.full(1, np.nan)
    p50, p99, most = (comm.allreduce(float(np.quantile(stamps, q)), MPI.MAX) for q in (0.5, 0.99, 1.0))
    return TimedModel(**asdict(point), p50=p50, p99=p99, max=most, times=move.times, values=np.hstack([own, y]))


def _steps(model: ReducedModel, against: FullRun) -> Array:
    """Wall time of each of CALLS steps, called one by one as a control loop would, (CALLS,) [s]."""
    step = Stepper(prepared(propagator(model.at(), against.dt), None, False))
    force, stamps = against.force, np.empty(CALLS)
    for k in range(CALLS):
        begin = time.perf_counter()
        step(force[k % len(force)])
        stamps[k] = time.perf_counter() - begin
    return stamps


def ask_reduced(reduced: ReducedRuns) -> Question:
    """All bases of the scene at all N. Collective.

    Raises:
        BasisError: a basis is unknown.
        SolverError: a solve or a factorisation failed.
    """
    section = reduced.scene.reduction
    points = [p for name in chosen_methods(reduced.scene) for p in reduced.points(name, section.N)]
    relations = ("error against N", "N", "error_outputs_full"), ("online seconds against N", "N", "seconds")
    return Question(tuple(points), slopes(points, *relations), reduced.timed)


def ask_bases(reduced: ReducedRuns) -> Question:
    """Every engine at several tolerances on the snapshots of the full run. Collective.

    The error is what the basis leaves of the snapshots, |X - U U' X|_F / |X|_F, measured and not read off the engine's
    own singular values; the time is that of factoring and making the vectors, the median of repeats.

    Raises:
        SolverError: a solve or a factorisation failed.
    """
    cache, repeats = reduced.runs.cache, reduced.runs.repeats
    points: list[BasisPoint] = []
    for engine in ENGINES:
        key = {"engine": engine, "setting": reduced.setting.parameters, "repeats": repeats}

        def sweep(engine: EngineName = engine) -> list[BasisPoint]:
            X = reduced.full()[0].snapshots.Z
            if X.size * cache.comm.size > WIDEST and engine == "svd":
                return []
            return _factored(cache.comm, X, engine, repeats)

        points += cache.point(f"engine {engine}", "basis", key, BasisPoint, sweep)
    left = "left of the snapshots against vectors", "columns", "error"
    return Question(
        tuple(points), slopes(points, left, ("seconds against vectors", "columns", "seconds")), reduced.timed
    )


def _factored(comm: MPI.Intracomm, X: Array, engine: EngineName, repeats: int) -> list[BasisPoint]:
    """Factor, keep what each tolerance asks for, and measure what is left. Collective."""
    square = float(total(comm, np.array([np.sum(X * X)]))[0])
    factors: list[Factor] = []
    seconds = statistics.median(repeated(comm, lambda: factors.append(factor(comm, X, engine)), repeats, LONG))
    f, points = factors[-1], []

    def vectors(tolerance: float) -> Array:
        u, s, _ = small_svd(comm, f.R)
        tail = np.sqrt(np.append(np.cumsum((s**2)[::-1])[::-1][1:], 0.0)) * f.scale
        keep = min(int(np.argmax(tail <= tolerance * np.sqrt(square))) + 1, len(s))
        return np.asarray(f.Q @ u[:, :keep])

    for tolerance in ENGINE_TOLERANCES:
        U = vectors(tolerance)
        rest = X - U @ total(comm, U.T @ X)
        error = float(np.sqrt(total(comm, np.array([np.sum(rest * rest)]))[0] / square))
        off = float(np.abs(total(comm, U.T @ U) - np.eye(U.shape[1])).max())
        more = statistics.median(repeated(comm, partial(vectors, tolerance), repeats, LONG))
        label = f"{engine}, tolerance {tolerance:g}, {U.shape[1]} vectors"
        points.append(
            BasisPoint(engine, label, seconds + more, error, error <= 1.1 * tolerance, tolerance=tolerance,
                       columns=U.shape[1], orthonormality=off)
        )  # fmt: skip
    return points
