"""The outputs of a scene at fixed places of the body, so that runs on different meshes can be compared.

A node output is the displacement of the node nearest to a point, which differs from mesh to mesh. Here the point itself
counts, see :mod:`softgrasp.fem.fields.probe`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.interpolate import CubicSpline

from softgrasp.fem.fields.probe import Probe
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.scene.scene import Scene

REGION_POINTS = 4  # along each axis of the box of a region output


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
    rigid: Array  # the part that moves with the hand, same shape
    stamps: Array  # seconds of every step on the slowest rank, (steps,)
    factor: float  # seconds of the factorisation

    @property
    def y(self) -> Array:
        """Displacements, (steps + 1, p) [m]."""
        return self.own + self.rigid


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
        self.pulls[n] = self.midpoint.pull()
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
        return Probed(times, own, rigid, stamps, model.watch.seconds["factor"])
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

    # mesh, assembly, factor, per_step: seconds, medians
    mesh: float
    assembly: float
    # n_e, states, dimension, steps: sizes
    n_e: int
    states: int
    dimension: int
    steps: int
    dt: float  # step [s]
    factor: float
    per_step: float
    # p50, p99, max: quantiles of the seconds of a step
    p50: float
    p99: float
    max: float
    seconds: float  # of the whole run
    # times, values: of its Series
    times: Array
    values: Array

    @property
    def series(self) -> Series:
        """Its outputs."""
        return Series(self.times, self.values, self.dimension)


def largest(values: Array, d: int) -> tuple[float, float]:
    """Largest length of the vectors in the first half of the columns, and in the second."""
    places = values.reshape(len(values), 2, -1, d)
    lengths = np.linalg.norm(places, axis=3).max(axis=(0, 2))
    return float(lengths[0]), float(lengths[1])


def errors_of(series: Series, true: Series) -> tuple[float, float]:
    """Largest error over the largest value: of the deformation, the measure of a study, and of the displacement.

    The rigid motion of the hand is many times the deformation, and hides it in the second.
    """
    scale = largest(true.values, true.dimension)
    gap = largest(series.values - true.at(series.times), true.dimension)
    return tuple(g / s if s > 0 else 0.0 for g, s in zip(gap, scale, strict=True))  # type: ignore[return-value]
