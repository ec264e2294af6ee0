"""The question of the Riccati equation: solver x tolerance against the error of the gain, the residual and time.

The gain of every solver is compared with the tightest solution of another one, so that no method is its own judge:
Newton-ADI with RADI, all others with Newton-ADI. How far these two are apart is the error estimate of both.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError, SceneError, SolverError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.lqr.design.feedback import Design, check, design
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.riccati import gain_error
from softgrasp.lqr.riccati import Method, solve
from softgrasp.study.precision.fit import Slope, power_law
from softgrasp.study.precision.points import CONTROL, Cache, Guard, Row, WorkPoint, number

TITLES: dict[str, str] = {"newton_adi": "Newton-ADI", "radi": "RADI", "galerkin": "Galerkin", "dense": "dense"}
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
FEW_TOLERANCES = (1e-2, 1e-6, 1e-10)  # of a large plant
TIGHT = (1e-12, 1e-11, 1e-10, 1e-8)  # of the two references, the first that rounding allows
DENSE_MOST = 1000  # states; beyond, one dense solution takes longer than all others together
REPEAT_SECONDS = 1.0  # a solver is repeated while it has taken less
LARGE = {2: 15_000, 3: 3_000}  # tissue unknowns beyond which the questions of control are asked by name only
SECOND = 4e6  # work of the guard that is about a second
CLOSE = 10.0  # times the error of the reference; gains nearer to it tell no slope


@dataclass(frozen=True)
class GainReference:
    """The two tightest solutions and how far their gains are apart.

    Attributes:
        solutions: by method; the first is what the reduced equations are made of.
        tolerances: that they reached.
        error: relative difference of their gains; nan when only one method got through.
    """

    solutions: dict[str, RiccatiSolution]
    tolerances: dict[str, float]
    error: float

    def judge_of(self, method: str) -> RiccatiSolution:
        """The solution that a method is compared with: of another method, where there is one. Not collective."""
        others = [s for name, s in self.solutions.items() if name != method]
        return (others or list(self.solutions.values()))[0]

    @property
    def names(self) -> list[str]:
        """Methods and tolerances in words."""
        return [f"{TITLES[name]} to {tol:.0e}" for name, tol in self.tolerances.items()]


class ControlRuns:
    """The control problem of a scene; solutions are made when the first point is not in the cache. Collective.

    Args:
        model: the scene's own mesh.
        cache: of measured points.
        guard: asked before each of them.
        asked: questions that were asked by name, which are answered at any size.
    """

    def __init__(self, model: Model, cache: Cache, guard: Guard, asked: Sequence[str] = ()) -> None:
        self.model, self.cache, self.guard, self.asked = model, cache, guard, asked
        self.scene, self.layout = model.scene, model.system.layout
        self.repeats = self.scene.study.repeats
        self.large = self.layout.n_e > LARGE[self.layout.dimension]
        self._problem: RiccatiProblem | None = None
        self._reference: GainReference | None = None
        self._design: Design | None = None

    def refused(self) -> str:
        """Why the questions of control cannot be asked of this scene, in one sentence; empty when they can."""
        if self.scene.control is None:
            return "the scene has no [control] section"
        if self.large and not set(self.asked) & set(CONTROL):
            return (
                f"n_e = {self.layout.n_e} in {self.layout.dimension}D: the solutions would take minutes; ask for it "
                "with --question"
            )
        return str(self.cache.get("control", {}, self._diagnose)["refused"])

    def _diagnose(self) -> Row:
        try:
            self._problem, _, modal = check(self.model)
        except (ControlError, SceneError) as error:
            return {"refused": str(error)}
        return {"refused": "control.method = 'modal' leaves no P of the whole plant to compare with" if modal else ""}

    @property
    def work(self) -> float:
        """Expected work of one large solution, in the unit of the guard."""
        n = self.layout.n_e
        return SECOND * (0.3 * n / 440 if self.layout.dimension == 2 else 1.8 * (n / 1800) ** 2.5)

    @property
    def problem(self) -> RiccatiProblem:
        """Plant, outputs, weights."""
        if self._problem is None:
            self._problem = check(self.model)[0]
        return self._problem

    @property
    def design(self) -> Design:
        """The optimal feedback as ``softgrasp control`` makes it, with its judge."""
        if self._design is None:
            self._design = design(self.model, Stopwatch(self.layout.comm))
        return self._design

    @property
    def reference(self) -> GainReference:
        """The tightest solutions of two methods.

        Raises:
            SolverError: no method reaches any of :data:`TIGHT`.
        """
        if self._reference is None:
            self._reference = make_reference(self.problem)
        return self._reference

    def reference_row(self) -> Row:
        """Names and error of the reference, from the cache when they are there."""

        def measure() -> Row:
            found = self.reference
            residuals = [s.residual for s in found.solutions.values()]
            return {"names": found.names, "error": found.error, "residuals": residuals}

        self.guard.next("Riccati reference", 2 * self.work)
        return self.cache.get("riccati", {"reference": list(TIGHT)}, measure)


def make_reference(problem: RiccatiProblem) -> GainReference:
    """The tightest solutions of Newton-ADI and RADI; others stand in for one that fails. Collective.

    Raises:
        SolverError: no method reaches any tolerance.
    """
    found: dict[str, RiccatiSolution] = {}
    reached: dict[str, float] = {}
    names: tuple[Method, ...] = ("newton_adi", "radi", "galerkin", "dense")
    for name in names:
        for tol in TIGHT:
            if name == "dense" and problem.layout.states > DENSE_MOST:
                break
            try:
                found[name], reached[name] = solve(problem, name, tol), tol
                break
            except (SolverError, ResourceError):  # rounding, or it does not converge here
                continue
        if len(found) == 2:
            break
    if not found:
        raise SolverError("no method solves the Riccati equation of this scene to 1e-8; add damping")
    gains = [s.gain for s in found.values()]
    error = gain_error(problem, gains[0], gains[1]) if len(gains) == 2 else float("nan")
    return GainReference(found, reached, error)


def tolerances_of(method: str, large: bool) -> tuple[float, ...]:
    """Tolerances to try; the dense solver has none. Not collective."""
    if method == "dense":
        return (1e-8,)
    return FEW_TOLERANCES if large else TOLERANCES


def settings_of(runs: ControlRuns) -> list[tuple[Method, float]]:
    """Methods with their tolerances. Not collective."""
    methods: tuple[Method, ...] = ("newton_adi", "radi", "galerkin", "dense")
    fit = [m for m in methods if m != "dense" or runs.layout.states <= DENSE_MOST]
    return [(m, tol) for m in fit for tol in tolerances_of(m, runs.large)]


def setting_work(runs: ControlRuns, method: str) -> float:
    """Expected work of one setting, in the unit of the guard. Not collective."""
    if method == "dense":
        return SECOND * 10 * (runs.layout.states / 880) ** 3
    return runs.work * (1 if runs.large else min(runs.repeats, REPEAT_SECONDS * SECOND / runs.work + 1))


def riccati_work(runs: ControlRuns) -> float:
    """Expected work of all settings. Not collective."""
    return sum(setting_work(runs, method) for method, _ in settings_of(runs))


def sweep_riccati(runs: ControlRuns) -> list[WorkPoint]:
    """All methods at all tolerances. Collective.

    A setting that a method does not reach stays as a point that is not ok, with the reason.

    Raises:
        SolverError: there is no reference.
        Interrupted: somebody asked to stop.
    """
    points = []
    for method, tol in settings_of(runs):
        label = TITLES[method] if method == "dense" else f"{TITLES[method]}, tolerance {tol:g}"
        runs.guard.next(label, setting_work(runs, method))
        key = {"method": method, "tolerance": tol, "repeats": runs.repeats}
        row = runs.cache.get("riccati", key, lambda method=method, tol=tol: _measure(runs, method, tol))  # type: ignore[misc]
        error, seconds = number(row["gain_error"]), number(row["seconds"])
        details = {"method": method, **{k: v for k, v in row.items() if k not in ("gain_error", "seconds")}}
        points.append(WorkPoint("riccati", method, label, seconds, error, not row["reason"], details))
    return points


def _measure(runs: ControlRuns, method: Method, tol: float) -> Row:
    """Gain error, true residual, counts and median seconds of one solver at one tolerance. Collective."""
    problem, comm = runs.problem, runs.layout.comm
    against = runs.reference.judge_of(method).gain
    times: list[float] = []
    solution: RiccatiSolution | None = None
    row: Row = {"tolerance": tol, "reason": "", "gain_error": None, "residual": None, "seconds": None}
    try:
        while solution is None or (len(times) < (1 if runs.large else runs.repeats) and sum(times) < REPEAT_SECONDS):
            comm.Barrier()
            begin = time.perf_counter()
            solution = solve(problem, method, tol)
            times.append(float(comm.allreduce(time.perf_counter() - begin, MPI.MAX)))
    except (SolverError, ResourceError) as error:
        return row | {"reason": str(error)}
    counts = {k: solution.counts.get(k, 0) for k in ("newton_steps", "solves", "factorisations")}
    return row | {
        "gain_error": gain_error(problem, against, solution.gain), "residual": solution.residual,
        "seconds": statistics.median(times), "repeats": len(times), "rank": solution.rank, **counts,
    }  # fmt: skip


def riccati_slopes(points: Sequence[WorkPoint], reference_error: float) -> list[Slope]:
    """Powers of gain error and residual in the tolerance, and of time in the residual. Not collective."""
    found = []
    floor = CLOSE * reference_error if np.isfinite(reference_error) else 0.0
    for name in dict.fromkeys(p.series for p in points):
        mine = [p for p in points if p.series == name and p.ok]
        clear = [p for p in mine if p.error > floor]
        fits = [("gain error against tolerance", [_tol(p) for p in clear], [p.error for p in clear])]
        if name != "galerkin":  # which bounds the change of its gain
            residuals = [p.details["residual"] for p in mine]
            fits.append(("residual against tolerance", [_tol(p) for p in mine], residuals))
            fits.append(("seconds against residual", residuals, [p.seconds for p in mine]))
        for against, x, y in fits:
            power = power_law(x, y)
            if power is not None:
                found.append(Slope("riccati", name, against, power, len(x)))
    return found


def _tol(p: WorkPoint) -> float:
    return float(p.details["tolerance"])
