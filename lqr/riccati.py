"""One entry to the large Riccati equation: the method by size and wish, with the reason."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

from softgrasp.fem.errors import SolverError
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.diagnosis import diagnose
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.lowrank.solver import Progress
from softgrasp.lqr.plant.operators import modes_couple
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution

Method = Literal["auto", "dense", "newton_adi", "radi", "galerkin"]
METHODS: tuple[Method, ...] = ("auto", "dense", "newton_adi", "radi", "galerkin")
# Exact to rounding, without a start or shifts that could fail, and still as fast as low rank within some tenths of a
# second; the faster one of the two changes between 92 and 160 states (softgrasp.study.bench.switches).
DENSE_STATES = 200
# A complex factorisation a shift: beyond these sizes 70 to 100 of them take more than a quarter of an hour on two ranks
# (softgrasp.study.bench.switches --large times one), while Galerkin needs about 5.
LOW_RANK_LIMIT = {1: 800_000, 2: 800_000, 3: 40_000}  # 1: systems without a mesh


class Solver(Protocol):
    """What every method offers."""

    def solve(self, problem: RiccatiProblem) -> RiccatiSolution:
        """Solve. Collective."""


@dataclass(frozen=True)
class SolverChoice:
    """A method and the reason in words."""

    method: Method
    reason: str


def choose(problem: RiccatiProblem, method: Method = "auto") -> SolverChoice:
    """The method for a problem.

    Newton-ADI by default; RADI where damping couples the modes; Galerkin where complex factorisations no longer fit.
    Layers with different damping couple the modes of the start to those left out, so K_0 is off by that coupling,
    however many modes are kept short of all (residual 1e-4 after one Newton step with 10 to 120 of 286 modes): three
    steps, where RADI takes the solves of one. Nor is that start known to stabilise.

    Raises SolverError: the name is unknown.
    """
    if method not in METHODS:
        raise SolverError(f"the Riccati method {method!r} is unknown; choose one of {', '.join(METHODS)}")
    if method != "auto":
        return SolverChoice(method, "asked for")
    layout, damping = problem.layout, problem.system.damping
    if layout.states <= DENSE_STATES:
        return SolverChoice("dense", f"{layout.states} states <= {DENSE_STATES}: all modes, exact to rounding")
    if not damping.active:
        return SolverChoice("dense", "without damping X has no low rank: only the dense method can tell what is lost")
    limit = LOW_RANK_LIMIT[layout.dimension]
    if layout.n_e > limit:
        return SolverChoice("galerkin", f"n_e = {layout.n_e} > {limit} in {layout.dimension}D: few factorisations fit")
    if modes_couple(problem.system):
        return SolverChoice(
            "radi", "damping couples the modes: the modal start of Newton's method is not known to stabilise"
        )
    return SolverChoice(
        "newton_adi", f"{layout.states} states, modes decoupled: modal start and usually one Newton step"
    )


def make_solver(
    method: Method, tol: float | None = None, progress: Progress | None = None, checkpoint: Path | None = None
) -> Solver:
    """The solver object.

    Args:
        method: any but auto.
        tol: true relative residual (gain change for galerkin); None takes the method's own.
        progress: observer of the iteration; dense has none.
        checkpoint: folder for restart files; newton_adi only.
    """
    if method == "dense":
        return DenseRiccati() if tol is None else DenseRiccati(tolerance=tol)
    if method == "galerkin":
        return StructuredGalerkin(tol=1e-6 if tol is None else tol, progress=progress)
    if method == "radi":
        return RADI(tol=1e-10 if tol is None else tol, progress=progress)
    return NewtonADI(tol=1e-10 if tol is None else tol, progress=progress, checkpoint=checkpoint)


def solve(
    problem: RiccatiProblem,
    method: Method = "auto",
    tol: float | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> RiccatiSolution:
    """Solve A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 and return X ~ Z Z' and the gain. Collective.

    By Newton-ADI [K68, BHSW16], RADI [BBKS18], structured Galerkin, or dense in modal coordinates [L79].
    When Newton's start does not stabilise, the choice ``auto`` goes on with RADI. The problem is not changed.

    Args:
        problem: operators and weights.
        method: dense, newton_adi, radi, galerkin, or auto by size and damping.
        tol: see :func:`make_solver`.
        progress: observer of the iteration.
        checkpoint: folder for restart files.

    Returns:
        Factor Z, ``rank`` columns of the size of the state, gain K = -R^{-1} B'XE, true residual, method and reason.

    Raises:
        ControlError: weights or data are refused, or some mode cannot be stabilised.
        SolverError: not converged, or the true residual misses the tolerance.
        ResourceError: dense was asked for at a size that would not fit, or the factor of a shift does not fit.

    >>> import softgrasp as sg
    >>> problem = sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    >>> sg.solve(problem).residual < 1e-8
    True
    """
    choice = choose(problem, method)
    if method == "auto" and choice.method == "dense" and problem.layout.states > DenseRiccati().limit:
        # undamped and too large for the dense method: which modes are lost says more than the memory that is missing
        diagnose(problem).require()
    try:
        solution = make_solver(choice.method, tol, progress, checkpoint).solve(problem)
    except SolverError as error:
        if method != "auto" or choice.method != "newton_adi":
            raise
        choice = SolverChoice("radi", f"newton_adi failed ({error})")
        solution = make_solver("radi", tol, progress).solve(problem)
    return replace(solution, reason=choice.reason)
