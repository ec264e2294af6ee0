"""The question of the Riccati equation: solver x tolerance against the error of the gain, the residual and time.

The gain of every solver is compared with the tightest solution of another one, so that no method is its own judge:
Newton-ADI with RADI, all others with Newton-ADI. How far these two are apart is the error estimate of both.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Model, ResourceError, SceneError, SolverError, Stopwatch, on_root
from softgrasp.lqr import ControlError, Design, Method, control_of, solve, solve_reduced
from softgrasp.lqr.design.feedback import check, design
from softgrasp.lqr.design.orders import orders
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import A_PRIORI, BASES, BasisFamily, make_family
from softgrasp.lqr.reduced.riccati import GainReport, gain_error, reduce_riccati
from softgrasp.study.control.measure import with_time
from softgrasp.study.control.result import TITLES as BASIS_TITLES
from softgrasp.study.control.result import report_dict
from softgrasp.study.precision.cache import Cache
from softgrasp.study.precision.fit import Slope, series_of, slope
from softgrasp.study.precision.points import CONTROL, ReducedRiccatiPoint, RiccatiPoint
from softgrasp.study.precision.result import Question, ReducedReference, RiccatiReference
from softgrasp.study.shell import repeated, timed

METHODS: tuple[Method, ...] = ("newton_adi", "radi", "galerkin", "dense")
TITLES: dict[str, str] = {"newton_adi": "Newton-ADI", "radi": "RADI", "galerkin": "Galerkin", "dense": "dense"}
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
FEW_TOLERANCES = (1e-2, 1e-6, 1e-10)  # of a large plant
TIGHT = (1e-12, 1e-11, 1e-10, 1e-8)  # of the two references, the first that rounding allows
DENSE_MOST = 1000  # states; beyond, one dense solution takes longer than all others together
REPEAT_SECONDS = 1.0  # a solver is repeated while it has taken less
LARGE = {2: 15_000, 3: 3_000}  # tissue unknowns beyond which the questions of control are asked by name only
CLOSE = 10.0  # times the error of the reference; gains nearer to it give no slope


@dataclass(frozen=True)
class GainReference:
    """The two tightest solutions and how far their gains are apart."""

    solutions: dict[str, RiccatiSolution]  # by method; the first is what the reduced equations are made of
    tolerances: dict[str, float]  # that they reached
    error: float  # relative difference of their gains; nan when only one method got through

    def other_than(self, method: str) -> RiccatiSolution:
        """The solution that a method is compared with: of another method, where there is one."""
        others = [s for name, s in self.solutions.items() if name != method]
        return (others or list(self.solutions.values()))[0]


@dataclass(frozen=True)
class Refusal:
    """Why a scene has no answer; empty when it has."""

    reason: str  # why there is no reference


class ControlRuns:
    """The control problem on the scene's own mesh; solutions are made when the first point is not in the cache.

    Questions that are named are answered at any size. Collective.
    """

    def __init__(self, model: Model, store: Cache, named: Sequence[str] = ()) -> None:
        self.model, self.cache, self.named = model, store, named
        self.scene, self.layout = model.scene, model.system.layout
        self.repeats = self.scene.study.repeats
        self.large = self.layout.n_e > LARGE[self.layout.dimension]
        self.family, self.report = cache(self._family), cache(self._report)

    def _family(self, name: str) -> BasisFamily:
        """Bases of one method."""
        return make_family(name, self.problem, self.design.solution.factor)

    def _report(self, name: str, N: int) -> GainReport:
        """The gain of one basis and order, checked on the full plant."""
        return self.design.gain_check.report(self.family(name).at(N))

    def refused(self) -> str:
        """Why the questions of control cannot be asked of this scene, in one sentence; empty when they can."""
        if self.scene.control is None:
            return "the scene has no [control] section"
        if self.large and not set(self.named) & set(CONTROL):
            return (
                f"n_e = {self.layout.n_e} in {self.layout.dimension}D: the solutions would take minutes; ask for it "
                "with --question"
            )
        return self.cache.get("control", {}, Refusal, lambda: [self._diagnose()])[0].reason

    def _diagnose(self) -> Refusal:
        try:
            modal = check(self.model)[2]
        except (ControlError, SceneError) as error:
            return Refusal(str(error))
        return Refusal("control.method = 'modal' leaves no P of the whole plant to compare with" if modal else "")

    @cached_property
    def problem(self) -> RiccatiProblem:
        """Plant, outputs, weights."""
        return make_problem(self.model)

    @cached_property
    def design(self) -> Design:
        """The optimal feedback as ``softgrasp control`` makes it, with its gain check."""
        return design(self.model, Stopwatch(self.layout.comm))

    @cached_property
    def reference(self) -> GainReference:
        """The tightest solutions of Newton-ADI and RADI; others replace one that fails.

        Raises:
            SolverError: no method reaches any of :data:`TIGHT`.
        """
        problem = self.problem
        solutions: dict[str, RiccatiSolution] = {}
        tolerances: dict[str, float] = {}
        for name in self.methods:
            for tol in TIGHT:
                try:
                    solutions[name], tolerances[name] = solve(problem, name, tol), tol
                    break
                except (SolverError, ResourceError):  # rounding, or it does not converge here
                    continue
            if len(solutions) == 2:
                break
        if not solutions:
            raise SolverError("no method solves the Riccati equation of this scene to 1e-8; add damping")
        gains = [s.gain for s in solutions.values()]
        error = gain_error(problem, gains[0], gains[1]) if len(gains) == 2 else float("nan")
        return GainReference(solutions, tolerances, error)

    @property
    def methods(self) -> list[Method]:
        """The dense one is left out of a large plant."""
        return [m for m in METHODS if m != "dense" or self.layout.states <= DENSE_MOST]

    def reference_names(self) -> RiccatiReference:
        """Names and error of the reference, from the cache when they are there."""

        def measure() -> list[RiccatiReference]:
            tight = self.reference
            names = tuple(f"{TITLES[name]} to {tol:.0e}" for name, tol in tight.tolerances.items())
            return [RiccatiReference(names, tight.error, tuple(s.residual for s in tight.solutions.values()))]

        key = {"reference": list(TIGHT)}
        return self.cache.point("Riccati reference", "riccati", key, RiccatiReference, measure)[0]


def tolerances_of(method: str, large: bool) -> tuple[float, ...]:
    """Tolerances to try; the dense solver has none."""
    if method == "dense":
        return (1e-8,)
    return FEW_TOLERANCES if large else TOLERANCES


def settings_of(runs: ControlRuns) -> list[tuple[Method, float]]:
    """Methods with their tolerances."""
    return [(m, tol) for m in runs.methods for tol in tolerances_of(m, runs.large)]


def ask_riccati(runs: ControlRuns) -> Question:
    """All methods at all tolerances. Collective.

    A setting that a method does not reach stays as a point that is not ok, with the reason.

    Raises:
        SolverError: there is no reference.
    """
    reference, points = runs.reference_names(), []
    for method, tol in settings_of(runs):
        label = TITLES[method] if method == "dense" else f"{TITLES[method]}, tolerance {tol:g}"
        key = {"method": method, "tolerance": tol, "repeats": runs.repeats}

        points += runs.cache.point(label, "riccati", key, RiccatiPoint, partial(_measure, runs, method, tol, label))
    return Question(tuple(points), tuple(riccati_slopes(points, reference.error)), reference)


def _measure(runs: ControlRuns, method: Method, tol: float, label: str) -> list[RiccatiPoint]:
    """Gain error, true residual, counts and median seconds of one solver at one tolerance. Collective."""
    problem = runs.problem
    tight = runs.reference.other_than(method).gain
    solutions: list[RiccatiSolution] = []
    repeats = 1 if runs.large else runs.repeats

    def once() -> None:
        solutions[:] = [solve(problem, method, tol)]

    try:
        times = repeated(runs.layout.comm, once, repeats, REPEAT_SECONDS)
    except (SolverError, ResourceError) as error:
        lost = float("inf")
        return [RiccatiPoint(method, label, lost, lost, False, method=method, tolerance=tol, reason=str(error),
                             residual=lost)]  # fmt: skip
    (solution,) = solutions
    counts: dict[str, Any] = {
        name: solution.counts.get(name, 0) for name in ("newton_steps", "solves", "factorisations")
    }
    return [RiccatiPoint(
        method, label, statistics.median(times), gain_error(problem, tight, solution.gain), method=method,
        tolerance=tol, residual=solution.residual, repeats=len(times), rank=solution.rank, **counts,
    )]  # fmt: skip


def above(error: float | None) -> float:
    """Errors from which on a reference with this error gives a slope."""
    return CLOSE * error if error is not None and np.isfinite(error) else 0.0


def riccati_slopes(points: Sequence[RiccatiPoint], reference_error: float | None) -> list[Slope]:
    """Powers of gain error and residual in the tolerance, and of time in the residual."""
    slopes: list[Slope] = []
    for name, line in series_of([p for p in points if p.ok]).items():
        clear = [p for p in line if p.error > above(reference_error)]
        slopes += slope(clear, "gain error against tolerance", "tolerance", "error")
        if name != "galerkin":  # which bounds the change of its gain
            slopes += slope(line, "residual against tolerance", "tolerance", "residual")
            slopes += slope(line, "seconds against residual", "residual", "seconds")
    return slopes


SMALL_SECONDS = 0.2  # a small equation is repeated while it has taken less


def ask_reduced_riccati(runs: ControlRuns) -> Question:
    """All bases at all N: the error of the gain, what it costs on the full plant, and the time of its equation.

    A gain that does not stabilise the full plant, or is not certified to, stays as a point that is not ok. Collective.

    Raises:
        SolverError: the full equation cannot be solved.
    """
    kind, once = "reduced_riccati", {"reference": True}
    (reference,) = runs.cache.point("gain of reference", kind, once, ReducedReference, lambda: [_reference(runs)])
    points: list[ReducedRiccatiPoint] = []
    for name in BASES:
        label = f"reduced Riccati equation, {BASIS_TITLES.get(name, name)}"
        key = {"basis": name, "N": control_of(runs.model).N, "repeats": runs.repeats}
        points += runs.cache.point(label, kind, key, ReducedRiccatiPoint, partial(_orders, runs, name))
    return Question(tuple(points), tuple(reduced_riccati_slopes(points, reference.error)), reference)


def _orders(runs: ControlRuns, name: str) -> list[ReducedRiccatiPoint]:
    """All orders of one basis; a basis that the plant refuses gives none. Collective."""
    comm, spent = runs.layout.comm, runs.design.solution.seconds
    try:
        seconds = timed(comm, partial(runs.family, name))  # this question is the first to need it
    except ControlError:
        return []
    full = float(comm.allreduce(spent.get("total", sum(spent.values())), MPI.MAX))
    before = seconds + (full if name != A_PRIORI else 0.0)
    return [_order(runs, name, N, seconds, before) for N in runs.family(name).orders(orders(runs.design)[0])]


def _order(runs: ControlRuns, name: str, N: int, time_basis: float, before: float) -> ReducedRiccatiPoint:
    """One reduced equation: cost of its gain, median seconds to solve it, and those of the rest. Collective."""
    report = with_time(runs.problem, runs.report(name, N))
    seconds, rest, comm = float("inf"), 0.0, runs.layout.comm
    if report.matrices is not None:
        whole = timed(comm, lambda: reduce_riccati(runs.problem, runs.family(name).at(N)))
        rest = max(whole - report.time_are, 0.0)  # project and reconstruct
        once = partial(solve_reduced, report.matrices)
        seconds = statistics.median(on_root(comm, lambda: repeated(MPI.COMM_SELF, once, runs.repeats, SMALL_SECONDS)))
    return ReducedRiccatiPoint(
        name, f"{BASIS_TITLES.get(name, name)}, N = {N}", seconds, report.error_K, report.stable, method=name,
        time_lift=rest, time_basis=time_basis, scratch=seconds + rest + before,
        **{key: value for key, value in report_dict(report).items() if key != "examined"},  # every gain is, here
    )  # fmt: skip


def _reference(runs: ControlRuns) -> ReducedReference:
    """What the reduced gains are compared with, and its distance to the tightest solution of another method."""
    solution = runs.design.solution
    other = runs.reference.other_than(solution.method)
    gap = gain_error(runs.problem, other.gain, solution.gain)
    return ReducedReference(solution.summary, solution.residual, gap, runs.design.gain_check.optimal)


def reduced_riccati_slopes(points: Sequence[ReducedRiccatiPoint], reference_error: float | None) -> list[Slope]:
    """Power of the gain error in N by basis; of the excess cost in the gain error and of time in N overall.

    The cost is least at the optimal gain, so that its excess is of second order in the error of the gain.
    """
    clear = [p for p in points if p.ok and p.error > above(reference_error)]
    slopes: list[Slope] = []
    for line in series_of(clear).values():
        if len(line) > 2:
            slopes += slope(line, "gain error against N", "N", "error")
    near = [p for p in clear if p.error < 1]
    slopes += slope(near, "excess cost against gain error", "error", "cost_excess", "all")
    return slopes + slope(clear, "seconds against N", "N", "seconds", "all")
