"""What one row of the benchmark measures, inside the ranks that ``benchmarks.forward`` launches."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.peers import BareSolve, PlainCholesky, PymorLoop, ScipyLoop, TextbookLoop, has_pymor
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array, to_scipy, whole_copy
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.motion import motion_table
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.scene.file import load_scene_collective
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.solvers import make_solver
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell.timing import RepeatableRun, interleave, medians, timed, warm

DT = 0.005  # [s], that of the paper: 600 steps in 3 s
PAPER_STEPS = 600
REPEAT_SECONDS = 0.1  # of the TS steps: long against the timer, short against the moods of a shared machine
BUILD_SECONDS = 20.0  # assembly and factor are repeated at most this long
PYMOR_LIMIT = 12_000  # [n_e]; beyond, its LU of size 2 n_e needs minutes
PEER_SHARE = 3  # SciPy and pyMOR need about so many times longer a step


@dataclass(frozen=True)
class WholeRun:
    """The paper's run from the assembled model on, factor included."""

    steps: int  # number of time steps
    seconds: dict[str, float]  # by method, medians
    samples: dict[str, list[float]]  # seconds of each repeat, by method
    drift: float  # of the energy, the largest


@dataclass(frozen=True)
class ForwardCost:
    """One mesh on so many ranks; what a large run leaves out is empty."""

    problem: str  # dimension and element order, as in 3D P2
    large: bool  # whether slow methods are left out
    dimension: int  # 2 or 3
    cells: list[int]  # cells along each axis, (dimension,)
    n_e: int  # number of tissue unknowns
    states: int  # number of states of the first-order model
    ranks: int  # number of ranks
    solver: str  # solver of the midpoint matrix
    seconds: dict[str, float]  # mesh, assembly, factor
    step_us: dict[str, float]  # microseconds of a step by method
    drift: float  # of the energy after drift_steps
    drift_steps: int  # number of steps behind the drift
    residual: float  # relative residual of a solve [1]
    memory_mb: float  # peak of all ranks [MiB]
    memory_base_mb: float  # peak of all ranks by the libraries alone [MiB]
    repeats: int  # number of timed repeats
    steps_per_repeat: int  # number of steps of a repeat
    samples_us: dict[str, list[float]] = field(default_factory=dict)  # microseconds of a step in each repeat, by method
    ratio: float | None = None  # median of a TS step over PETSc's bare solves
    ratio_own: float | None = None  # median of a TS step over its own bare solves
    factor_peer_s: dict[str, float] = field(default_factory=dict)  # seconds of the factorisation, by peer
    whole: WholeRun | None = None  # the paper's whole run; None on other meshes


def cells_for(dimension: int, size: int) -> list[int]:
    """Cells of the 1 x 2 rectangle (1 x 1 x 2 box) whose free nodes come nearest to ``size`` unknowns.

    Size 1000 in 2D gives 15 x 30, the mesh of the paper.
    """

    def unknowns(n: int) -> float:
        if dimension == 2:
            return 2 * ((n + 1) * (2 * n + 1) - 2 * (n / 2 + 1.5))
        return 3 * ((n + 1) ** 2 * (2 * n + 1) - 2 * (n + 1) * (n / 2 + 1.5))

    start = max(2, int((size / (4 if dimension == 2 else 6)) ** (1 / dimension)))
    n = min(range(max(2, start - 3), start + 4), key=lambda m: abs(unknowns(m) - size))
    return [n] * (dimension - 1) + [2 * n]


def bench_scene(comm: MPI.Intracomm, dimension: int, cells: list[int], steps: int, snapshots: str = "none") -> Scene:
    """The paper's scene on another mesh, or its 3D sister; the step stays 0.005 s. Collective."""
    changes = [f"tissue.cells={cells}", f"time.steps={steps}", f"time.end={steps * DT!r}"]
    changes.append(f"output.snapshots={snapshots}")
    if dimension == 3:
        changes += ["tissue.size=[1.0, 1.0, 2.0]", "contact.box=[[0.0, 0.0, 1.5], [1.0, 1.0, 2.0]]"]
        changes += ["motion.target=[5.0, 3.0, 0.0]", "control.outputs.0.point=[0.5, 0.5, 0.0]"]
    return load_scene_collective(comm, "paper_forward", changes)


def _builds(comm: MPI.Intracomm, scene: Scene, repeats: int) -> tuple[Model, dict[str, list[float]], float, float]:
    """Build and factor several times: last model, seconds, peak memory after the first, seconds of a TS step."""
    seconds: dict[str, list[float]] = {"mesh": [], "assembly": [], "factor": []}
    begin, memory, pace = time.perf_counter(), 0.0, 0.0
    for i in range(repeats):
        model = build(scene, comm=comm)
        run = RepeatableRun(model)
        for name, values in seconds.items():
            values.append(model.watch.seconds[name])
        if i == 0:
            few = comm.bcast(int(np.clip(0.05 / run.seconds_per_step(3), 1, 400)))
            pace, memory = run.seconds_per_step(few), peak_memory_mb(comm)
        run.destroy()
        gc.collect()
        if comm.bcast(time.perf_counter() - begin) > BUILD_SECONDS:
            break
    return model, seconds, memory, pace


def _repeated(comm: MPI.Intracomm, loop: Any, count: int) -> Callable[[], float]:
    """Microseconds of a step, over so many of them."""

    def steps() -> float:
        loop.advance(warm(count))
        return 1e6 * timed(comm, lambda: loop.advance(count)) / count

    return steps


def _steps(comm: MPI.Intracomm, model: Model, k: int, repeats: int, peers: bool) -> dict[str, Any]:
    """Per-step times of all methods [us] and the energy drift of the TS run."""
    run = Run(model, RunOptions())
    ts = make_ts(run)
    run.start()
    run.advance_to(ts, 2)

    def of_ts() -> float:
        run.advance_to(ts, run.reached + warm(k))
        seconds = timed(comm, lambda: run.advance_to(ts, run.reached + k))
        run.watch_energy()
        return 1e6 * seconds / k

    factor: dict[str, float] = {}
    loops, solvers = _loops(run, factor)
    methods = {"ts": of_ts} | {name: _repeated(comm, loop, k) for name, loop in loops.items()}
    if peers and comm.size == 1:
        few = max(2, k // PEER_SHARE)
        for name, make in _peers(model).items():
            begin = time.perf_counter()
            methods[name] = _repeated(comm, make(), few)
            if name == "scipy":  # pyMOR factors in its first step
                factor[name] = time.perf_counter() - begin
    samples = interleave(methods, repeats)

    def ratio(name: str) -> float | None:
        return float(np.median(np.divide(samples["ts"], samples[name]))) if name in samples else None

    result = {
        "step_us": medians(samples), "samples_us": samples, "ratio": ratio("solve"), "ratio_own": ratio("own"),
        "residual": run.check_step(ts, run.reached + 1), "factor_peer_s": factor,
        "drift": run.ledger.drift(run.state, run.reached),
        "drift_steps": run.reached, "solver": run.solver[0],
    }  # fmt: skip
    ts.destroy()
    for solver in (run.midpoint, *solvers):
        solver.destroy()
    return result


def _loads(model: Model) -> Array:
    """c_n = -a_n in the load G c_n of a prescribed motion, (steps, n_s)."""
    return -motion_table(model.scene, model.system.layout.n_s).a


def _loops(run: Run, factor: dict[str, float]) -> tuple[dict[str, Any], list[Any]]:
    """The bare solves and the textbook loop, and what is to be freed after them; notes PETSc's factor time. Collective.

    The textbook loop uses PETSc's plain solve on one rank; on several, where vectors are distributed, ours.
    """
    system, midpoint, name = run.model.system, run.midpoint, run.solver[0]
    bare = BareSolve(midpoint.solver, midpoint.r)
    loops: dict[str, Any] = {"solve": bare}
    solvers: list[Any] = []
    solve = midpoint.solver.solve
    if name == "cholesky":
        S = midpoint_matrix(system, DT)
        begin = time.perf_counter()
        petsc = PlainCholesky(whole_copy(S))
        factor["petsc"] = time.perf_counter() - begin
        S.destroy()
        loops, solve, solvers = {"solve": petsc, "own": bare}, petsc.solve, [petsc.ksp]
    if midpoint.operators.whole and system.layout.comm.size > 1:
        solvers.append(make_solver(midpoint_matrix(system, DT), name, system.layout, "textbook_"))
        solve = solvers[-1].solve
    loops["loop"] = TextbookLoop(system, DT, solve, _loads(run.model))
    return loops, solvers


def _peers(model: Model) -> dict[str, Callable[[], Any]]:
    """SciPy's loop and pyMOR's where it is installed and small enough, yet to be set up."""
    system = model.system
    arguments = to_scipy(system.K_ee), to_scipy(system.M_ee), system.G, DT, _loads(model)
    loops: dict[str, Callable[[], Any]] = {"scipy": partial(ScipyLoop, *arguments)}
    if has_pymor() and system.layout.n_e <= PYMOR_LIMIT:
        loops["pymor"] = partial(PymorLoop, *arguments)
    return loops


def _whole(comm: MPI.Intracomm, model: Model, cells: list[int], steps: int, repeats: int) -> WholeRun:
    scenes = {kind: bench_scene(comm, 2, cells, steps, kind) for kind in ("none", "memory")}
    drifts: list[float] = []

    def of_ts(kind: str) -> None:
        drifts.append(simulate(replace(model, scene=scenes[kind])).energy_drift)

    calls: dict[str, Callable[[], Any]] = {f"ts_{kind}": partial(of_ts, kind) for kind in scenes}
    if comm.size == 1:
        peers = _peers(replace(model, scene=scenes["none"]))
        calls["scipy"] = lambda: peers["scipy"]().store(steps)
        if "pymor" in peers:
            calls["pymor"] = lambda: peers["pymor"]().advance(steps)
    methods = {name: partial(timed, comm, call) for name, call in calls.items()}
    interleave(methods, 1)  # warm up
    samples = interleave(methods, repeats)
    return WholeRun(steps, medians(samples), samples, max(drifts))


def measure(
    comm: MPI.Intracomm,
    dimension: int,
    size: int,
    repeats: int,
    repeat_seconds: float = REPEAT_SECONDS,
    whole: bool = False,
    peers: bool = True,
    problem: str = "",
) -> ForwardCost:
    """One point, each number measured ``repeats`` times. Collective.

    One repeat lasts about ``repeat_seconds``; ``whole``: also the paper's 600 steps; ``peers``: SciPy and pyMOR too.
    """
    cells = cells_for(dimension, size)
    build(bench_scene(comm, dimension, [2] * (dimension - 1) + [4], 1), comm=comm)  # compiles the forms
    base = peak_memory_mb(comm)
    model, samples, memory, pace = _builds(comm, bench_scene(comm, dimension, cells, PAPER_STEPS), repeats)
    k = int(np.clip(repeat_seconds / pace, 3, 50_000))
    stepped = replace(model, scene=bench_scene(comm, dimension, cells, repeats * (k + warm(k)) + 10))
    return ForwardCost(
        **_sizes(model, cells), problem=problem, large=False, seconds=medians(samples), memory_mb=memory,
        memory_base_mb=base, repeats=repeats, steps_per_repeat=k, **_steps(comm, stepped, k, repeats, peers),
        whole=_whole(comm, model, cells, PAPER_STEPS, repeats) if whole else None,
    )  # fmt: skip


def measure_large(comm: MPI.Intracomm, dimension: int, size: int, steps: int, problem: str = "") -> ForwardCost:
    """A large scene once, from the mesh to the end, nothing stored. Collective."""
    cells = cells_for(dimension, size)
    base = peak_memory_mb(comm)
    begin = time.perf_counter()
    model = build(bench_scene(comm, dimension, cells, steps), comm=comm)
    run = simulate(model)
    seconds = {name: run.seconds[name] for name in ("mesh", "assembly", "factor")}
    seconds["total"] = comm.allreduce(time.perf_counter() - begin, MPI.MAX)
    return ForwardCost(
        **_sizes(model, cells), problem=problem, large=True, seconds=seconds, memory_mb=peak_memory_mb(comm),
        memory_base_mb=base, repeats=1, steps_per_repeat=steps, step_us={"ts": 1e6 * run.seconds["steps"] / steps},
        drift=run.energy_drift, drift_steps=steps, residual=run.residuals[1], solver=run.solver[0],
    )  # fmt: skip


def _sizes(model: Model, cells: list[int]) -> dict[str, Any]:
    layout = model.system.layout
    names = {"dimension": layout.dimension, "n_e": layout.n_e, "states": layout.states, "ranks": layout.comm.size}
    return names | {"cells": cells}


def measure_row(*, large: bool, **arguments: Any) -> list[ForwardCost]:
    """The point that :mod:`benchmarks.forward` names on the command line. Collective."""
    return [(measure_large if large else measure)(MPI.COMM_WORLD, **arguments)]
