"""Seconds of the reduced models beside those of the full one, and beside the paper's."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace

from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.reduction.replay import FullRun, full_run
from softgrasp.study.reduce.result import FullTimes, MethodSweep, Speed, nearest

FULL_REPEATS = 3  # behind the median of the full run
PATIENCE = 2.0  # seconds of a full run above which one is enough
PAPER_FULL, PAPER_REDUCED = 16.22, 0.097  # seconds of [SBRH21]: 2n = 1916, 600 steps, and PSD at N = 14
LEAST_MESH = 50  # tissue unknowns: a body of fewer deforms in no useful way


def measured_run(model: Model, progress: Callable[[Run], None]) -> tuple[FullRun, FullTimes]:
    """The full run, and its seconds in the median of several when it is short. Collective."""
    first = simulate(model, RunOptions(progress=progress))
    comm, runs = model.system.layout.comm, [first]
    repeats = comm.bcast(FULL_REPEATS if steps_seconds(first) < PATIENCE else 1)
    runs += [simulate(replace(model, watch=Stopwatch(comm))) for _ in range(repeats - 1)]
    factors = [run.seconds["factor"] for run in runs]
    times = FullTimes(statistics.median(map(steps_seconds, runs)), statistics.median(factors))
    return full_run(model, first), times


def steps_seconds(run: Trajectory) -> float:
    """Seconds of all steps; the first is not among those measured, since it sets up the solver."""
    n = len(run.times) - 1
    return run.seconds["steps"] / max(n - 1, 1) * n


def speed_of(sweep: MethodSweep, full: FullTimes) -> Speed | None:
    """Compare times; None for a method without points."""
    i = nearest(sweep.points)
    i = nearest(sweep.points, stable=False) if i is None else i
    if i is None:
        return None
    p = sweep.points[i]
    return Speed(sweep.method, p, *full.against(p.time_offline, p.time_setup, p.time_online))


def speed_notes(n_e: int, steps: int, full: FullTimes, speeds: Sequence[Speed]) -> tuple[str, ...]:
    """What the speed-up is measured against, the mesh that pays, and the paper's figure beside ours."""
    against = (
        f"Full model, prefactored: {steps} steps in {1e3 * full.steps:.1f} ms; its factorisation takes "
        f"{1e3 * full.factor:.1f} ms. new: a new parameter, small matrices, test of stability and propagator with the "
        "run. x again: steps of the full model over a run of the same small model again, all made beforehand on both "
        "sides. x new: factorisation and steps over new. Break-even runs = offline / (full - new), at new parameters; "
        "the full run that gives the snapshots is one more."
    )
    stable = [s for s in speeds if s.point.stable]
    chosen = next((s for s in stable if s.method.key == "psd"), None) or next(iter(stable), None)
    if chosen is None:
        return (against,)
    # tissue unknowns at which a full run would take as long as a reduced one, at this mesh's time per unknown
    p = chosen.point
    mesh, model = n_e * p.time_online / full.steps, f"{chosen.method.title}, N = {p.N}"
    if mesh < LEAST_MESH:
        pays = f"the reduced run ({model}) is faster than a full run on every mesh"
    else:
        pays = f"a full run of n_e = {mesh:.0f} would take as long as the reduced one ({model})"
    return (
        against,
        f"Break-even mesh: {pays}, at this mesh's time per unknown. The reduced time does not grow with the mesh, see "
        "python -m softgrasp.study.bench meshes.",
        f"The paper reports {PAPER_FULL} s against {PAPER_REDUCED} s at 2n = 1916 and N = 14, a speed-up of "
        f"{PAPER_FULL / PAPER_REDUCED:.0f}; here the same comparison, each side from its matrices on, gives "
        f"{1e3 * (full.factor + full.steps):.1f} ms against {1e3 * (p.time_setup + p.time_online):.2f} ms, "
        f"a speed-up of {chosen.speedup_new_parameter:.0f} for a new parameter ({model}).",
    )
