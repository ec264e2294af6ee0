"""Hard cases of the hand's Riccati equation: weights of any size, hardly any damping, outputs that see nothing."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.modal import DenseRiccati, gather_tissue, relative_space
from softgrasp.lqr.design import make_problem
from softgrasp.lqr.diagnosis import diagnose
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.plant.identities import translation_defect, velocity_defect
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.study.hardcases.cases import Family, Outcome, Row, make, ours, plain, thin

TOLERANCE = 1e-8  # of both solvers on the residual, relative to |C'QC|
EXACT = "the solver's tolerance on the residual; of the exact gain the identities hold exactly"
HEAVY = EXACT + "; at R = 1e12 the hand's poles are 1e-9 of the tissue's, and the residual may not reach the tolerance"
WEAK = EXACT + "; with next to no damping a solver may give up, but not return a wrong gain"


@cache
def problem_of(cells: str = "[3, 6]", beta: float = 0.002, *more: str) -> RiccatiProblem:
    """The paper's control problem on a small mesh. Not collective."""
    damping = f"effects={{damping={{kind='kelvin-voigt', beta={beta!r}}}}}" if beta else "effects={}"
    return make_problem(make("paper_lqr", f"tissue.cells={cells}", damping, *more))


def identities(problem: RiccatiProblem, solution: RiccatiSolution) -> float:
    """Worst defect of the two identities that the exact gain obeys for every mesh and damping. Not collective."""
    return max(translation_defect(problem, solution), velocity_defect(problem, solution) or 0.0)


def dense(problem: RiccatiProblem) -> float:
    """Diagnose, solve densely, and check the exact identities. Not collective.

    Raises:
        ControlError, SolverError: there is no gain, or none within the tolerance.
    """
    diagnose(problem).require()
    return identities(problem, DenseRiccati().solve(problem))


def low_rank(problem: RiccatiProblem) -> float:
    """The same by Newton's method with low-rank ADI. Not collective.

    Raises:
        ControlError, SolverError: there is no gain, or none within the tolerance.
    """
    diagnose(problem).require()
    return identities(problem, NewtonADI(tol=TOLERANCE).solve(problem))


def paper_matrices(problem: RiccatiProblem) -> tuple[Array, Array, Array, Array, Array]:
    """E, A, B, C of the paper in absolute displacements [q_s, v_s, q_e, v_e], and T. Not collective.

    Raises:
        ValueError: more than one rank.
    """
    space, tissue = relative_space(problem), gather_tissue(problem)
    if space is None or tissue is None:
        raise ValueError("the textbook way runs on one rank")
    n_s, n = problem.layout.n_s, len(tissue.M)
    L, R = np.eye(len(space.E)), np.eye(len(space.E))
    q, v = slice(2 * n_s, 2 * n_s + n), slice(2 * n_s + n, None)
    L[q, :n_s], L[v, n_s : 2 * n_s] = -tissue.T, -tissue.T
    R[q, :n_s] = tissue.T
    return R @ space.E @ L, R @ space.A @ L, space.B, space.C @ L, tissue.T


def textbook(problem: RiccatiProblem) -> Outcome:
    """SciPy's solver on the paper's matrices as they are; defect of the same identities. Not collective.

    The remark tells when it hands out a gain whose closed loop does not decay.
    """
    E, A, B, C, T = paper_matrices(problem)
    X = scipy.linalg.solve_continuous_are(A, B, C.T @ problem.Q @ C, problem.R, e=E)
    K = -np.linalg.solve(problem.R, B.T @ X @ E)
    n_s = problem.layout.n_s
    one, none, nothing = np.eye(n_s), np.zeros((n_s, n_s)), np.zeros_like(T)
    x, v = np.vstack([one, none, T, nothing]), np.vstack([none, one, nothing, T])
    wanted, start = problem.C_s.T @ problem.Q @ problem.C_s, E @ x
    first = np.linalg.norm((K @ x).T @ problem.R @ (K @ x) - wanted) / np.linalg.norm(wanted)
    cost = start.T @ X @ start
    second = np.linalg.norm((K @ x).T @ problem.R @ (K @ v) - cost) / np.linalg.norm(cost)
    abscissa = float(scipy.linalg.eigvals(A + B @ K, E).real.max())
    text = "" if abscissa < 0 else f"closed loop grows by {abscissa:.0e}/s, no warning"
    return Outcome(float(max(first, second)) if np.isfinite(X).all() else math.nan, text)


# --- weights


def weight_rows(quick: bool) -> list[Row]:
    """Input weights R from 1e-12 to 1e12."""
    problem, rows = problem_of(), []
    for power in thin([-12, -8, -4, -2, 0, 2, 4, 8, 12], quick):
        r = 10.0**power
        case = replace(problem, R=r * problem.R)
        scipy_ = plain(textbook, case)
        for name, solver in (("dense", dense), ("low rank", low_rank)):
            may, reason = (True, HEAVY) if r > 1e10 else (False, EXACT)
            mine = ours(solver, case)
            rows.append(Row(f"R = {r:.0e}, {name}", r, mine, scipy_, TOLERANCE, reason, may_refuse=may, group=name))
    return rows


def output_rows(quick: bool) -> list[Row]:
    """Outputs that are weighted hugely, singularly or not at all, that see little, or nothing of what moves."""
    problem, undamped = problem_of(), problem_of("[3, 6]", 0.0)
    hand = problem_of("[3, 6]", 0.002, "control.outputs=[{kind='hand'}]")
    hand_undamped = problem_of("[3, 6]", 0.0, "control.outputs=[{kind='hand'}]")
    cases: list[tuple[str, RiccatiProblem, bool]] = [
        ("Q = 1e12", replace(problem, Q=1e12 * problem.Q), False),
        ("Q = diag(1, 1e-8)", replace(problem, Q=np.diag([1.0, 1e-8])), False),
        ("Q = diag(1, 0): nobody sees y", replace(problem, Q=np.diag([1.0, 0.0])), True),
        ("Q = 0", replace(problem, Q=np.zeros((2, 2))), True),
        ("only deformation is seen", replace(problem, C_s=np.zeros_like(problem.C_s)), True),
        ("only the hand is seen, damped tissue", hand, False),
        ("only the hand is seen, undamped tissue", hand_undamped, True),
        ("the tip is seen, undamped tissue", undamped, True),
        ("Q with a negative eigenvalue", replace(problem, Q=np.diag([1.0, -1.0])), True),
        ("R singular", replace(problem, R=np.diag([1.0, 0.0])), True),
    ]
    rows = []
    for i, (name, case, refuse) in enumerate(cases[::2] if quick else cases):
        reason = "there is no stabilising feedback, or no minimum" if refuse else EXACT
        rows.append(Row(name, i + 1, ours(dense, case), plain(textbook, case), None if refuse else TOLERANCE, reason))
    return rows


# --- damping


def lqr_damping_rows(quick: bool) -> list[Row]:
    """Kelvin-Voigt damping down to none: the gain must be right, or the modes that are lost must be named."""
    rows = []
    for beta in [2e-3, 2e-6] if quick else [0.2, 0.02, 2e-3, 2e-4, 2e-5, 2e-6, 2e-8, 2e-10, 2e-14]:
        case = problem_of("[3, 6]", beta)
        scipy_, name = plain(textbook, case), f"beta = {beta:.0e} s"
        weak = beta < 1e-5
        for way, solver in (("dense", dense), ("low rank", low_rank)):
            mine, reason = ours(solver, case), WEAK if weak else EXACT
            rows.append(Row(f"{name}, {way}", beta, mine, scipy_, TOLERANCE, reason, may_refuse=weak, group=way))
    case = problem_of("[3, 6]", 0.0)
    reason = "without damping X is not of low rank and high modes are lost to rounding"
    rows.append(Row("undamped", 0.0, ours(low_rank, case), plain(textbook, case), None, reason, group="low rank"))
    if not quick:
        paper = make_problem(make("paper_lqr_undamped"))
        name = "paper_lqr_undamped, 880 states"
        rows.append(Row(name, 0.0, ours(low_rank, paper), plain(textbook, paper), None, reason, group="low rank"))
    return rows


FAMILIES = (
    Family("weights", "Input weights from 1e-12 to 1e12", "R", "defect of the gain's identities",
           "SciPy on the paper's matrices",
           "Balanced energy coordinates stand twenty-four decades of weights; the raw matrices do not.", weight_rows),
    Family("outputs", "Weights and outputs that see too little", "case", "defect of the gain's identities",
           "SciPy on the paper's matrices",
           "Where no feedback exists the plain way may return a number all the same; ours names what is not seen.",
           output_rows, axis="listed"),
    Family("lqr_damping", "Riccati equations with hardly any damping", "Kelvin-Voigt time beta [s]",
           "defect of the gain's identities", "SciPy on the paper's matrices",
           "As damping goes, poles meet the axis: the gain stays right as long as there is one, then modes are named.",
           lqr_damping_rows),
)  # fmt: skip
