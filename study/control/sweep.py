"""Gains of the reduced Riccati equations on one scene, the time of each equation, and gains re-tuned over a box."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import on_root
from softgrasp.lqr.dense.care import solve_reduced
from softgrasp.lqr.design.duration import LoopPlan, with_bounds
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.orders import BasisGains, Notify, fast_order, reduce_gains
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import A_PRIORI, BasisFamily
from softgrasp.lqr.reduced.retune import Materials, RetunedGain, Retuner, retuned_gain
from softgrasp.lqr.reduced.riccati import GainReport
from softgrasp.lqr.riccati import solve
from softgrasp.lqr.spectrum.modal_loop import SOME_MODES
from softgrasp.reduction.parameters import grid_of, materials_at, outside
from softgrasp.study.control.result import Retuned
from softgrasp.study.shell.timing import repeated

SOLUTIONS = 3  # of a reduced equation, the fastest counts
REPEATS = 5  # of a re-tuning, the best counts
BOX_STATES = 30_000  # above, nine more full solutions would take minutes


def sweep(design: Design, orders: Sequence[int], notify: Notify | None = None) -> tuple[BasisGains, ...]:
    """All bases over their orders, see :func:`softgrasp.lqr.design.orders.reduce_gains`, with times. Collective."""
    bases = reduce_gains(design, orders, notify)
    return tuple(replace(b, reports=tuple(with_time(design.problem, r) for r in b.reports)) for b in bases)


def with_time(problem: RiccatiProblem, report: GainReport) -> GainReport:
    """With the seconds of one solution of its reduced equation. Collective."""
    matrices = report.matrices
    if matrices is None:
        return report
    seconds = on_root(
        problem.layout.comm, lambda: repeated(MPI.COMM_SELF, lambda: solve_reduced(matrices), SOLUTIONS, np.inf)
    )
    return replace(report, time_are=min(seconds))


def retune(
    design: Design, bases: Sequence[BasisGains], plan: LoopPlan, notify: Notify | None = None
) -> tuple[tuple[Retuned, ...], str]:
    """The a-priori basis and the paper's best at a small order, re-tuned over the box; or why not. Collective.

    The duality gaps of all gains of one setting come from the same few runs of ``plan``.
    """
    layout = design.problem.layout
    reason = outside(design.model)
    if not reason and layout.states > BOX_STATES:
        reason = (
            f"{layout.states} states are more than {BOX_STATES}: the full solutions to compare with would take long"
        )
    chosen = re_tunable(bases, layout.n_s)
    if not reason and not chosen:
        reason = f"no basis has a stable gain of order N <= {fast_order(layout.n_s)}"
    if reason:
        return (), reason
    settings = [materials_at(design.model, *place) for place in grid_of(design.model)]
    solutions: dict[Materials, RiccatiSolution] = {}

    def full(problem: RiccatiProblem) -> RiccatiSolution:
        key = problem.system.materials
        if key not in solutions:
            solutions[key] = solve(problem)
        return solutions[key]

    tuners = [Retuner(design.problem, family.at(N)) for family, N in chosen]
    columns = list[list[RetunedGain]]()
    for materials in settings:
        points = [_at(tuner, materials, full, design) for tuner in tuners]
        if materials in solutions:
            problem = replace(design.problem, system=design.problem.system.with_materials(materials))
            points = with_bounds(problem, solutions[materials], points, design.error, plan)
        columns.append([replace(point, gain=None) for point in points])
        if notify is not None:
            notify(len(columns), len(settings))
    rows = zip(*columns, strict=True)
    return tuple(Retuned(family.name, N, tuple(row)) for (family, N), row in zip(chosen, rows, strict=True)), ""


def _at(
    tuner: Retuner, materials: Materials, full: Callable[[RiccatiProblem], RiccatiSolution], design: Design
) -> RetunedGain:
    comm, modes = tuner.problem.layout.comm, min(SOME_MODES, tuner.problem.layout.n_e)
    try:
        point = retuned_gain(tuner, materials, full, design.error, modes, design.judge.law)
    except (ControlError, SolverError) as failed:  # the full solution, not the re-tuned one
        return RetunedGain(materials, reason=f"no reference: {failed}")
    if point.reason:
        return point
    # the first solution of a size pays for memory and caches, which a running controller does not
    return replace(point, seconds=on_root(comm, lambda: min(tuner.solve(materials).seconds for _ in range(REPEATS))))


def re_tunable(bases: Sequence[BasisGains], n_s: int) -> list[tuple[BasisFamily, int]]:
    """The a-priori basis and the best of the others, each at its best small order."""
    best = [(b.family, r) for b in bases if b.family is not None and (r := b.best(fast_order(n_s))) is not None]
    own = [(family, r.N) for family, r in best if family.name == A_PRIORI]
    others = sorted((x for x in best if x[0].name != A_PRIORI), key=lambda x: (x[1].cost_excess, x[0].name))
    return [*own, *((family, r.N) for family, r in others[:1])]
