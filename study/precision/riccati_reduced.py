"""The question of the reduced Riccati equations: basis x N against gain error, excess cost and time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import on_root
from softgrasp.lqr.dense.small_care import solve_reduced
from softgrasp.lqr.design.orders import orders
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.reduced.bases import BASES, BasisFamily, make_family
from softgrasp.lqr.reduced.riccati import gain_error, reduce_riccati
from softgrasp.study.control.result import TITLES, report_dict
from softgrasp.study.control.sweep import with_time
from softgrasp.study.precision.fit import Slope, power_law
from softgrasp.study.precision.points import Row, WorkPoint, number
from softgrasp.study.precision.riccati import CLOSE, SECOND, ControlRuns

A_PRIORI = "structured"  # the basis that is made without P
REPEAT_SECONDS = 0.2  # a small equation is repeated while it has taken less
JUDGING = 0.15 * SECOND  # work of one gain in the unit of the guard


def sweep_riccati_reduced(runs: ControlRuns) -> list[WorkPoint]:
    """All bases at all N: the error of the gain, what it costs on the full plant, and the time of its equation.

    A gain that does not stabilise the full plant, or that nobody can vouch for, stays as a point that is not ok.
    Collective.

    Raises:
        SolverError: the full equation cannot be solved.
        Interrupted: somebody asked to stop.
    """
    points = []
    for name in BASES:
        runs.guard.next(f"reduced Riccati equation, {TITLES.get(name, name)}", basis_work(runs))
        key = {"basis": name, "N": list(runs.scene.control.N) if runs.scene.control else [], "repeats": runs.repeats}
        found = runs.cache.get("reduced_riccati", key, lambda name=name: _family(runs, name))  # type: ignore[misc]
        points += [_point(name, row, found) for row in found["rows"]]
    return points


def basis_work(runs: ControlRuns) -> float:
    """Expected work of one basis at all N, in the unit of the guard. Not collective."""
    count = len(runs.scene.control.N) if runs.scene.control else 0
    return count * (JUDGING + 0.05 * runs.work)


def _point(name: str, row: Row, found: Row) -> WorkPoint:
    error, seconds = number(row["error_K"]), number(row["seconds"])
    scratch = seconds + row["time_lift"] + found["time_basis"] + (found["time_full"] if name != A_PRIORI else 0.0)
    details = {"method": name, **row, "time_basis": found["time_basis"], "scratch": scratch}
    return WorkPoint("reduced_riccati", name, f"{TITLES.get(name, name)}, N = {row['N']}", seconds, error,
                     bool(row["stable"]), details)  # fmt: skip


def _family(runs: ControlRuns, name: str) -> Row:
    """All orders of one basis; a basis that the plant refuses gives no rows. Collective."""
    design, comm = runs.design, runs.layout.comm
    wanted, note = orders(design)
    comm.Barrier()
    begin = time.perf_counter()
    empty: Row = {"rows": [], "refused": "", "time_basis": 0.0, "time_full": 0.0, "note": note}
    try:
        family = make_family(name, runs.problem, design.solution.factor)
    except ControlError as error:
        return empty | {"refused": str(error)}
    seconds = float(comm.allreduce(time.perf_counter() - begin, MPI.MAX))
    taken = design.solution.seconds
    full = taken.get("total", sum(taken.values()))
    rows = [_order(runs, family, N) for N in family.orders(wanted)]
    return empty | {"rows": rows, "time_basis": seconds, "time_full": float(comm.allreduce(full, MPI.MAX))}


def _order(runs: ControlRuns, family: BasisFamily, N: int) -> Row:
    """One reduced equation: worth of its gain, median seconds to solve it, and those to project and lift. Collective.

    Keys: those of :func:`study.control.sweep.report_dict`, seconds, time_lift.
    """
    report = with_time(runs.problem, runs.design.judge.report(family.at(N)))
    row = report_dict(report) | {"seconds": None, "time_lift": 0.0}
    if report.reason:
        return row
    comm = runs.layout.comm
    comm.Barrier()
    begin = time.perf_counter()
    matrices = reduce_riccati(runs.problem, family.at(N)).matrices
    lift = comm.allreduce(time.perf_counter() - begin, MPI.MAX) - report.time_are  # the rest is solving

    def median() -> float:
        times: list[float] = []
        while not times or (len(times) < runs.repeats and sum(times) < REPEAT_SECONDS):
            begin = time.perf_counter()
            solve_reduced(matrices)
            times.append(time.perf_counter() - begin)
        return statistics.median(times)

    return row | {"seconds": on_root(comm, median), "time_lift": max(float(lift), 0.0)}


def reference_note(runs: ControlRuns) -> Row:
    """What the reduced gains are compared with, and its distance to the tightest solution of another method.

    Collective.
    """

    def measure() -> Row:
        solution, tight = runs.design.solution, runs.reference
        gap = gain_error(runs.problem, tight.judge_of(solution.method).gain, solution.gain)
        return {"method": solution.summary, "residual": solution.residual, "error": gap,
                "optimal": runs.design.judge.optimal}  # fmt: skip

    runs.guard.next("gain of reference", 2 * runs.work)
    return runs.cache.get("reduced_riccati", {"reference": True}, measure)


def reduced_riccati_slopes(points: Sequence[WorkPoint], reference_error: float) -> list[Slope]:
    """Power of the gain error in N by basis; of the excess cost in the gain error and of time in N overall.

    The cost is least at the optimal gain, so that its excess is of second order in the error of the gain. Not
    collective.
    """
    floor = CLOSE * reference_error if np.isfinite(reference_error) else 0.0
    clear = [p for p in points if p.ok and p.error > floor]
    groups = [(name, [p for p in clear if p.series == name]) for name in dict.fromkeys(p.series for p in clear)]
    fits = [(name, "gain error against N", [_order_of(p) for p in mine], [p.error for p in mine], len(mine))
            for name, mine in groups if len(mine) > 2]  # fmt: skip
    costs = [p for p in clear if p.error < 1]
    excess = [number(p.details["cost_excess"]) for p in costs]
    fits.append(("all", "excess cost against gain error", [p.error for p in costs], excess, len(costs)))
    fits.append(("all", "seconds against N", [_order_of(p) for p in clear], [p.seconds for p in clear], len(clear)))
    powers = [(name, against, power_law(x, y), count) for name, against, x, y, count in fits]
    return [Slope("reduced_riccati", name, against, p, count) for name, against, p, count in powers if p is not None]


def _order_of(p: WorkPoint) -> float:
    return float(p.details["N"])
