"""One entry to the large Riccati equation, the method by size and wish with the reason, and modal feedback by name."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import on_root
from softgrasp.lqr.dense.care import care_of
from softgrasp.lqr.dense.modal import DenseRiccati, closed_loop_rates, factor_psd, lowest_plant
from softgrasp.lqr.diagnosis import diagnose
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.lowrank.solver import LowRankSolver, Progress
from softgrasp.lqr.plant.checks import ControlError, check_weights
from softgrasp.lqr.plant.operators import modes_couple
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import modal_basis
from softgrasp.lqr.reduced.riccati import full_gain, project_plant

Method = Literal["auto", "dense", "newton_adi", "radi", "galerkin"]
METHODS: tuple[Method, ...] = get_args(Method)
Spelling = Method | Literal["newton-adi"]  # as in scenes
# Exact to rounding, without a start or shifts that could fail, and still as fast as low rank within some tenths of a
# second; the faster one of the two changes between 92 and 160 states (docs/benchmarks.md).
DENSE_STATES = 200
# A complex factorisation a shift: beyond these sizes 70 to 100 of them need more than a quarter of an hour on two ranks
# (docs/benchmarks.md), while Galerkin needs about 5.
LOW_RANK_LIMIT = {1: 800_000, 2: 800_000, 3: 40_000}  # 1: systems without a mesh


@dataclass(frozen=True)
class SolverChoice:
    """A method and the reason in words."""

    method: Method  # name of the method
    reason: str  # reason of the choice, in words


def choose(problem: RiccatiProblem, method: Spelling = "auto") -> SolverChoice:
    """The method for a problem.

    Newton-ADI by default; RADI where damping couples the modes; Galerkin where complex factorisations no longer fit.
    Layers with different damping couple the modes of the start to those left out, so K_0 has an error of that coupling
    however many modes are kept short of all (residual 1e-4 after one Newton step with 10 to 120 of 286 modes): three
    steps, where RADI needs the solves of one. Nor is that start known to stabilise.

    Raises SolverError: the name is unknown.
    """
    name = cast(Method, method.replace("-", "_"))
    if name not in METHODS:
        raise SolverError(f"the Riccati method {method!r} is unknown; choose one of {', '.join(METHODS)}")
    if name != "auto":
        return SolverChoice(name, "requested")
    layout, damping = problem.layout, problem.system.damping
    if layout.states <= DENSE_STATES:
        return SolverChoice("dense", f"{layout.states} states <= {DENSE_STATES}: all modes, exact to rounding")
    if not damping.active:
        return SolverChoice("dense", "without damping X has no low rank: only the dense method can report what is lost")
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
) -> DenseRiccati | LowRankSolver[Any]:
    """The solver object.

    Args:
        method: any but auto.
        tol: true relative residual (gain change for galerkin); None: the method's own.
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
    method: Spelling = "auto",
    tol: float | None = None,
    progress: Progress | None = None,
    checkpoint: Path | None = None,
) -> RiccatiSolution:
    """Solve A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 and return X ~ Z Z' and the gain. Collective.

    By Newton-ADI [K68, BHSW16], RADI [BBKS18], structured Galerkin, or dense in modal coordinates [L79].
    When Newton's start does not stabilise, the choice ``auto`` goes on with RADI. The problem is not changed.

    Args:
        problem: operators and weights.
        method: dense, newton_adi or newton-adi as in scenes, radi, galerkin, or auto by size and damping.
        tol: see :func:`make_solver`.
        progress: observer of the iteration.
        checkpoint: folder for restart files.

    Returns:
        Factor Z, ``rank`` columns of the size of the state, gain K = -R^{-1} B'XE, true residual, method and reason.

    Raises:
        ControlError: weights or data are refused, or some mode cannot be stabilised.
        SolverError: not converged, or the true residual misses the tolerance.
        ResourceError: dense was requested at a size that would not fit, or the factor of a shift does not fit.

    >>> import softgrasp as sg
    >>> problem = sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    >>> sg.solve(problem).residual < 1e-8
    True
    """
    choice = choose(problem, method)
    if method == "auto" and choice.method == "dense" and problem.layout.states > DenseRiccati().limit:
        # undamped and too large for the dense method: which modes are lost matters more than the memory that is missing
        diagnose(problem).require()
    try:
        solution = make_solver(choice.method, tol, progress, checkpoint).solve(problem)
    except SolverError as error:
        if method != "auto" or choice.method != "newton_adi":
            raise
        choice = SolverChoice("radi", f"newton_adi failed ({error})")
        solution = make_solver("radi", tol, progress).solve(problem)
    return replace(solution, reason=choice.reason)


def modal_lqr(problem: RiccatiProblem, modes: int = 10, candidates: int = 40) -> RiccatiSolution:
    """Riccati equation of the hand and the lowest modes that feedback can stabilise, expanded by the filter Phi'M_ee.

    One-way coupling and a modal filter leave the other modes where they are: with damping they decay by themselves,
    without damping they stay on the imaginary axis, driven but not destabilised. With two-way coupling the hand feels
    them, so that the whole loop must be checked with :class:`softgrasp.lqr.spectrum.modal_loop.ModalLoop`. Collective.

    Args:
        modes: number of modes in the model.
        candidates: lowest modes they are chosen from; modes that inputs do not reach or outputs do not see are skipped.

    Returns:
        A solution of rank up to 2 n_s + 2 modes. ``residual`` is the true one of the whole plant: it is large when
        modes that matter are left out.

    Raises:
        ControlError: fewer than ``modes`` of the candidates can be stabilised, or the small equation has no solution.
    """
    system, comm = problem.system, problem.layout.comm
    begin = time.perf_counter()
    check_weights(problem.Q, problem.R, problem.C_s.shape[0], problem.inputs)
    if modes < 0:
        raise ControlError(f"modal_lqr: modes = {modes} must be 0 or more")
    k = min(max(candidates, modes, 1), system.layout.n_e)
    plant = lowest_plant(problem, k)
    good = np.flatnonzero(closed_loop_rates(problem, plant).lost == 0)
    if len(good) < modes:
        raise ControlError(
            f"modal_lqr: only {len(good)} of the lowest {k} modes can be stabilised, {modes} are requested; request at "
            f"most {len(good)}"
        )
    pick = good[:modes]
    basis = modal_basis(problem, "modal_lqr", plant, pick)
    m = project_plant(problem, basis)
    middle = time.perf_counter()
    P_N = on_root(comm, lambda: care_of(m).X)
    Z = basis.W.times(on_root(comm, lambda: factor_psd(P_N)))
    gain = full_gain(problem, basis, P_N)
    left = system.layout.n_e - modes
    word = (
        "decay by their own damping" if system.damping.active else "are not stabilised and stay on the imaginary axis"
    )
    return RiccatiSolution(
        Z,
        gain,
        residual(problem, Z),
        "modal_lqr",
        f"hand and {modes} modes; the other {left} modes {word}",
        counts={"newton_steps": 0, "adi_steps": 0, "solves": 0},
        seconds={"modes": middle - begin, "small": time.perf_counter() - middle},
    )
