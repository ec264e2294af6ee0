"""The question of the reduced Riccati equations: basis x N against gain error, excess cost and time."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from functools import partial

from mpi4py import MPI

from softgrasp.fem.petsc import on_root
from softgrasp.lqr.dense.small_care import solve_reduced
from softgrasp.lqr.design.orders import orders
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.reduced.bases import BASES, BasisFamily, make_family
from softgrasp.lqr.reduced.riccati import ReducedRiccati, gain_error, reduce_riccati
from softgrasp.study.control.result import TITLES, report_dict
from softgrasp.study.control.sweep import with_time
from softgrasp.study.precision.fit import Slope, series_of, slope
from softgrasp.study.precision.points import ReducedRiccatiPoint
from softgrasp.study.precision.result import Question, ReducedReference
from softgrasp.study.precision.riccati import ControlRuns, above
from softgrasp.study.shell.timing import repeated, timed

A_PRIORI = "structured"  # the basis that is made without P
REPEAT_SECONDS = 0.2  # a small equation is repeated while it has taken less


def ask_reduced_riccati(runs: ControlRuns) -> Question:
    """All bases at all N: the error of the gain, what it costs on the full plant, and the time of its equation.

    A gain that does not stabilise the full plant, or is not certified to, stays as a point that is not ok. Collective.

    Raises:
        SolverError: the full equation cannot be solved.
    """
    runs.guard.next("gain of reference")
    reference = runs.cache.get("reduced_riccati", {"reference": True}, ReducedReference, lambda: [_reference(runs)])[0]
    points: list[ReducedRiccatiPoint] = []
    for name in BASES:
        runs.guard.next(f"reduced Riccati equation, {TITLES.get(name, name)}")
        key = {"basis": name, "N": list(runs.scene.control.N) if runs.scene.control else [], "repeats": runs.repeats}
        points += runs.cache.get("reduced_riccati", key, ReducedRiccatiPoint, lambda name=name: _family(runs, name))  # type: ignore[misc]
    return Question(tuple(points), tuple(reduced_riccati_slopes(points, reference.error)), reference)


def _family(runs: ControlRuns, name: str) -> list[ReducedRiccatiPoint]:
    """All orders of one basis; a basis that the plant refuses gives none. Collective."""
    design, comm = runs.design, runs.layout.comm
    families: list[BasisFamily] = []
    try:
        seconds = timed(comm, lambda: families.append(make_family(name, runs.problem, design.solution.factor)))
    except ControlError:
        return []
    spent = design.solution.seconds
    full = float(comm.allreduce(spent.get("total", sum(spent.values())), MPI.MAX))
    before = seconds + (full if name != A_PRIORI else 0.0)
    sizes = families[0].orders(orders(design)[0])
    return [_order(runs, families[0], N, seconds, before) for N in sizes]


def _order(runs: ControlRuns, family: BasisFamily, N: int, time_basis: float, before: float) -> ReducedRiccatiPoint:
    """One reduced equation: cost of its gain, median seconds to solve it, and those to project and lift. Collective."""
    report = with_time(runs.problem, runs.design.judge.report(family.at(N)))
    seconds, lift = float("inf"), 0.0
    if not report.reason:
        solutions: list[ReducedRiccati] = []
        whole = timed(runs.layout.comm, lambda: solutions.append(reduce_riccati(runs.problem, family.at(N))))
        (reduced,) = solutions
        lift = max(whole - report.time_are, 0.0)  # the rest is solving

        def median() -> float:
            once = partial(solve_reduced, reduced.matrices)
            return statistics.median(repeated(MPI.COMM_SELF, once, runs.repeats, REPEAT_SECONDS))

        seconds = on_root(runs.layout.comm, median)
    name = family.name
    return ReducedRiccatiPoint(
        name, f"{TITLES.get(name, name)}, N = {N}", seconds, report.error_K, report.stable, method=name,
        time_lift=lift, time_basis=time_basis, scratch=seconds + lift + before,
        **report_dict(report),
    )  # fmt: skip


def _reference(runs: ControlRuns) -> ReducedReference:
    """What the reduced gains are compared with, and its distance to the tightest solution of another method."""
    solution = runs.design.solution
    other = runs.reference.judge_of(solution.method)
    gap = gain_error(runs.problem, other.gain, solution.gain)
    return ReducedReference(solution.summary, solution.residual, gap, runs.design.judge.optimal)


def reduced_riccati_slopes(points: Sequence[ReducedRiccatiPoint], reference_error: float | None) -> list[Slope]:
    """Power of the gain error in N by basis; of the excess cost in the gain error and of time in N overall.

    The cost is least at the optimal gain, so that its excess is of second order in the error of the gain.
    """
    clear = [p for p in points if p.ok and p.error > above(reference_error)]
    question, slopes = "reduced_riccati", []
    for name, line in series_of(clear).items():
        if len(line) > 2:
            slopes += slope(question, name, "gain error against N", [p.N for p in line], [p.error for p in line])
    near = [p for p in clear if p.error < 1]
    excess = [p.cost_excess for p in near]
    slopes += slope(question, "all", "excess cost against gain error", [p.error for p in near], excess)
    return slopes + slope(question, "all", "seconds against N", [p.N for p in clear], [p.seconds for p in clear])
