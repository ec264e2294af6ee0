"""Runs of the full model for a study: each gives a trajectory at fixed places and its times, medians of repeats.

A node output is the displacement of the node nearest to a point, which differs from mesh to mesh. Here the point itself
counts, see :mod:`softgrasp.fem.fields.probe`, so that runs on different meshes can be compared.
"""

from __future__ import annotations

import gc
import statistics
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.interpolate import CubicSpline

from softgrasp.fem import Array, Model, Run, RunOptions, Scene, adapt, build, make_outputs, make_ts, total
from softgrasp.fem.fields.probe import Probe, make_probe
from softgrasp.study.precision.cache import Cache
from softgrasp.study.precision.settings import Setting, own_setting, variant
from softgrasp.study.shell import medians

REGION_POINTS = 4  # along each axis of the box of a region output
BURST_SECONDS = 0.05  # of the steps in each repeat after the first, which is the whole run
LONG_SECONDS = 5.0  # a run that takes longer is its own average, and is not repeated
BUILD_SECONDS = 2.0  # builds are repeated about this long


@dataclass(frozen=True)
class Places:
    """Where the outputs of a scene are, the same on every mesh."""

    names: tuple[str, ...]  # of the outputs
    points: tuple[Array, ...]  # places [m] whose mean each output is, one array (k, d) an output; empty for the hand

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.points[0].shape[1])


@dataclass(frozen=True)
class Probed:
    """One run of the full model at fixed places."""

    times: Array  # (steps + 1,) [s]
    own: Array  # displacements against the hand, (steps + 1, p) [m], on every rank
    y: Array  # displacements, same shape
    stamps: Array  # seconds of every step on the slowest rank, (steps,)
    factor: float  # seconds of the factorisation


def find_places(scene: Scene, model: Model) -> Places:
    """Places of the scene's outputs: points as the scene names them, regions by a grid, else the farthest node.

    A scene that sees nothing but its hand counts as one without outputs, since no tissue is in them. Collective.

    Raises:
        SceneError: an output lies outside the body.
    """
    outputs = scene.control.outputs if scene.control is not None else []
    if all(output.kind == "hand" for output in outputs):
        scene, outputs = scene.model_copy(update={"control": None}), []
    nodes = make_outputs(scene, model.system)
    low, high = model.system.layout.bounds()
    points = []
    for i, node in enumerate(nodes):
        kind = outputs[i].kind if outputs else "farthest"
        if kind == "hand":
            points.append(np.zeros((0, model.system.layout.dimension)))
        elif kind == "region":
            box = np.clip(np.asarray(outputs[i].box, dtype=float), low, high)
            share = (np.arange(REGION_POINTS) + 0.5) / REGION_POINTS
            axes = [a + (b - a) * share for a, b in box.T]
            points.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, box.shape[1]))
        else:
            named = outputs[i].point if outputs else None
            points.append(np.array([node.point if named is None else named], dtype=float))
    return Places(tuple(o.name for o in nodes), tuple(points))


class ProbedRun(Run):
    """A run that records places on its mesh instead of the scene's nodes, and the seconds of every step."""

    def __init__(self, model: Model, probe: Probe) -> None:
        self.probe: Probe | None = None
        super().__init__(model, RunOptions())
        self.probe = probe
        self.local_outputs = np.zeros((self.steps + 1, len(probe.weights)))
        self.stamps = np.zeros(self.steps)

    def step(self, ts: Any) -> None:
        """One step, timed without the check of its solve. Collective."""
        begin, n, checked = time.perf_counter(), self.reached, self.checking
        super().step(ts)
        self.stamps[n] = time.perf_counter() - begin - (self.checking - checked)

    def record(self, n: int) -> None:
        """This rank's share of the places, and what the work of the load needs."""
        self.ledger.pulls[n] = self.midpoint.pull()
        if self.probe is not None and len(self.probe.dofs):
            self.local_outputs[n] = self.probe.weights @ self.state.array[self.probe.dofs]


def run_probed(model: Model, probe: Probe, until: int | None = None) -> Probed:
    """Factor and run, to the end or a first part. Collective.

    Raises:
        SolverError: a solve failed, missed its tolerance, or the energy is no longer finite.
    """
    comm = model.system.layout.comm
    model.watch.seconds.pop("factor", None)
    run = ProbedRun(model, probe)
    ts = make_ts(run)
    try:
        run.start()
        last = run.steps if until is None else min(until, run.steps)
        comm.Barrier()
        run.check_step(ts, last)
        run.watch_energy()
        stamps = np.empty_like(run.stamps[:last])
        comm.Allreduce(run.stamps[:last], stamps, MPI.MAX)
        rigid = run.drive.q[: last + 1] @ probe.C_s.T
        own = total(comm, run.local_outputs[: last + 1])
        times = run.end * np.arange(last + 1) / run.steps
        return Probed(times, own, own + rigid, stamps, model.watch.seconds["factor"])
    finally:
        ts.destroy()
        run.midpoint.destroy()


@dataclass(frozen=True)
class Series:
    """Outputs over time: deformations y - rigid, what the tissue does, and displacements y, side by side."""

    times: Array  # (steps + 1,) [s]
    values: Array  # (steps + 1, 2 p) [m]
    dimension: int  # d; p is a multiple of it

    def at(self, times: Array) -> Array:
        """Values at other times, by cubic splines."""
        if len(times) == len(self.times) and np.allclose(times, self.times, rtol=0, atol=1e-12 * self.times[-1]):
            return self.values
        return np.asarray(CubicSpline(self.times, self.values)(times))


@dataclass(frozen=True)
class TimedRun:
    """One run of the full model."""

    mesh: float  # median time of the mesh [s]
    assembly: float  # median time of the assembly [s]
    n_e: int  # tissue unknowns
    states: int  # dimension of the first-order model
    dimension: int  # 2 or 3
    steps: int  # number of time steps
    dt: float  # step [s]
    factor: float  # median time of the factorisation [s]
    per_step: float  # median time of a step [s]
    p50: float  # median time of a step [s]
    p99: float  # 99 % quantile of the time of a step [s]
    max: float  # largest time of a step [s]
    seconds: float  # of the whole run
    times: Array  # times of its outputs [s]
    values: Array  # outputs at these times [m, rad]

    @property
    def series(self) -> Series:
        """Its outputs."""
        return Series(self.times, self.values, self.dimension)


def largest(values: Array, d: int) -> tuple[float, float]:
    """Largest length of the vectors in the first half of the columns, and in the second."""
    places = values.reshape(len(values), 2, -1, d)
    lengths = np.linalg.norm(places, axis=3).max(axis=(0, 2))
    return float(lengths[0]), float(lengths[1])


def relative(values: Array, scale: tuple[float, float], d: int) -> tuple[float, float]:
    """:func:`largest` over a scale of both halves; 0 where that is 0."""
    first, second = (length / s if s > 0 else 0.0 for length, s in zip(largest(values, d), scale, strict=True))
    return first, second


def errors_of(series: Series, true: Series) -> tuple[float, float]:
    """Largest error over the largest value: of the deformation, the measure of a study, and of the displacement.

    The rigid motion of the hand is many times the deformation, and hides it in the second.
    """
    return relative(series.values - true.at(series.times), largest(true.values, true.dimension), true.dimension)


@dataclass(frozen=True)
class Pace:
    """Of a run."""

    seconds: float  # of its second step


class FullRuns:
    """Runs of one scene under many settings, cached; the model of the last mesh is kept. Collective."""

    def __init__(self, scene: Scene, places: Places, reference: Array, cache: Cache) -> None:
        self.scene, self.places, self.cache = scene, places, cache
        self.reference = reference.tolist() if scene.effects.rotation else None
        self.repeats, self.dimension = scene.study.repeats, places.dimension
        self._mesh: tuple[Setting, Model, Probe, dict[str, float]] | None = None
        self._compiled: set[tuple[int, object]] = set()  # forms by order and maker; the first build makes them

    def variant(self, setting: Setting, snapshots: str = "none") -> Scene:
        """The scene under a setting."""
        return variant(self.scene, setting, snapshots, self.reference)

    def run(self, setting: Setting, repeats: int | None = None) -> TimedRun:
        """Times, sizes and the trajectory of a setting."""
        count = self.repeats if repeats is None else repeats
        key = {"setting": setting.parameters | {"rtol": setting.rtol}, "repeats": count}
        return self.cache.point(setting.label, "run", key, TimedRun, lambda: [self._measure(setting, count)])[0]

    def expected(self, setting: Setting) -> float:
        """Seconds of the steps of a setting, from its second one; the first sets up the solver."""

        def second_step() -> list[Pace]:
            _, probe, _ = self._built(setting, 1)
            return [Pace(float(run_probed(self.model(setting), probe, 2).stamps[1]))]

        key = {"setting": setting.parameters | {"rtol": setting.rtol}}
        return setting.steps * self.cache.get("pace", key, Pace, second_step)[0].seconds

    def _built(self, setting: Setting, repeats: int) -> tuple[Model, Probe, dict[str, float]]:
        """Model and probe of a mesh, with the median seconds of its builds; the first build also compiles."""
        held = self._mesh
        if held is not None and held[0].group == setting.group:
            return held[1:]
        self._mesh = None
        comm = self.cache.comm
        seconds: dict[str, list[float]] = {"mesh": [], "assembly": []}
        scene = self.variant(setting)
        if setting.refine == "scene":  # one mesh whatever the steps, which its passes depend on a little
            scene = self.variant(own_setting(self.scene))
        make = adapt.build if setting.refine == "scene" else build
        forms = setting.order, make
        if forms not in self._compiled:
            make(scene, comm=comm)
            self._compiled.add(forms)
        for _ in range(repeats):
            gc.collect()
            model = make(scene, comm=comm)
            for stage, values in seconds.items():
                values.append(model.watch.seconds[stage])
            if comm.bcast(sum(map(sum, seconds.values()))) > BUILD_SECONDS:
                break
        probe = make_probe(model.space, self.places.points, self.scene.effects.rotation)
        self._mesh = (setting, model, probe, medians(seconds))
        return self._mesh[1:]

    def model(self, setting: Setting) -> Model:
        """The model of a setting, with the mesh that was built for it."""
        return replace(self._built(setting, 1)[0], scene=self.variant(setting))

    def _measure(self, setting: Setting, repeats: int) -> TimedRun:
        _, probe, built = self._built(setting, repeats)
        model = self.model(setting)
        gc.collect()
        begin = time.perf_counter()
        first = run_probed(model, probe)
        if self.cache.comm.bcast(time.perf_counter() - begin) > LONG_SECONDS:
            repeats = 1
        burst = int(np.clip(BURST_SECONDS / max(float(first.stamps.mean()), 1e-7), 2, setting.steps))
        runs = [first] + [run_probed(model, probe, burst) for _ in range(repeats - 1)]
        later = [r.stamps[1:] if len(r.stamps) > 1 else r.stamps for r in runs]  # the first step sets up the solver
        steps = np.concatenate(later)
        layout = model.system.layout
        factor = statistics.median(r.factor for r in runs)
        per_step = statistics.median(float(s.mean()) for s in later)
        p50, p99, most = (float(np.quantile(steps, q)) for q in (0.5, 0.99, 1.0))
        return TimedRun(
            **built, n_e=layout.n_e, states=layout.states, dimension=layout.dimension, steps=setting.steps,
            dt=self.scene.time_end / setting.steps, factor=factor, per_step=per_step, p50=p50, p99=p99, max=most,
            seconds=built["mesh"] + built["assembly"] + factor + setting.steps * per_step,
            times=first.times, values=np.hstack([first.own, first.y]),
        )  # fmt: skip
