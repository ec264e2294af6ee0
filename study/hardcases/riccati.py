"""Hard cases of the hand's Riccati equation: weights of any size, hardly any damping, outputs that see nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.modal import DenseRiccati, paper_form
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.diagnosis import diagnose
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.study.hardcases.cases import EPS, Family, HardCase, Outcome, here, make, textbook, thin
from softgrasp.study.hardcases.exact import exact_gain, worst_part_error

TOLERANCE = 1e-8  # of both solvers on the residual, relative to |C'QC|
DENSE, LOW_RANK = math.sqrt(EPS), math.sqrt(TOLERANCE)
REASONS = {
    DENSE: "half of the digits of a double, in the gain for each of hand and tissue, displacement and velocity",
    LOW_RANK: "half of the digits that the solver's tolerance on the residual, 1e-8, gives, in each part of the gain",
}
HEAVY = "; at R = 1e12 the hand's poles are 1e-9 of the tissue's, and the residual may not reach the tolerance"
WEAK = "; with next to no damping a solver may give up, but not return a wrong gain"


@cache
def problem_of(*more: str, beta: float = 0.002) -> RiccatiProblem:
    """The paper's control problem on a mesh small enough for exact gains, 48 states."""
    damping = f"effects={{damping={{kind='kelvin-voigt', beta={beta!r}}}}}" if beta else "effects={}"
    return make_problem(make("paper_lqr", "tissue.cells=[2, 4]", damping, *more))


# solver and bound of each way
SOLVERS: dict[str, tuple[DenseRiccati | NewtonADI, float]] = {
    "dense": (DenseRiccati(), DENSE),
    "low rank": (NewtonADI(tol=TOLERANCE), LOW_RANK),
}


def gain(way: str, problem: RiccatiProblem) -> Array:
    """K, (m, states), of one rank after the diagnosis; ControlError or SolverError where there is none."""
    diagnose(problem).require()
    K = SOLVERS[way][0].solve(problem).gain
    return np.hstack([K.K_s, K.K_z.T, K.K_v.T])


def scipy_error(problem: RiccatiProblem, exact: Array | None, pencil: bool = False) -> Outcome:
    """SciPy's solver, which balances, on x' = E^{-1}A x + E^{-1}B u of the paper; error of its gain.

    Without ``exact`` there is no gain, and the answer is where the closed loop's poles lie. ``pencil`` hands over E.
    """
    (E, A, B, C), T = paper_form(problem), problem.system.T
    E, A, H = E.toarray(), A.toarray(), C.T @ problem.Q @ C
    if pencil:
        X = scipy.linalg.solve_continuous_are(A, B, H, problem.R, e=E)
        K = -np.linalg.solve(problem.R, B.T @ X @ E)
    else:
        A, B = np.linalg.solve(E, A), np.linalg.solve(E, B)
        K = -np.linalg.solve(problem.R, B.T @ scipy.linalg.solve_continuous_are(A, B, H, problem.R))
    abscissa = float(scipy.linalg.eigvals(A + B @ K, E if pencil else None).real.max())
    grows = "" if abscissa < 0 else f"closed loop grows by {abscissa:.0e}/s, no warning"
    if exact is None:
        return Outcome(None, grows or f"closed loop decays by {-abscissa:.0e}/s only, no warning")
    n_s, n = problem.layout.n_s, len(T)
    K[:, :n_s] += K[:, 2 * n_s : 2 * n_s + n] @ T  # from absolute to hand-relative coordinates
    K[:, n_s : 2 * n_s] += K[:, 2 * n_s + n :] @ T
    return Outcome(worst_part_error(K, exact, n_s), grows)


def both_ways(problem: RiccatiProblem, exact: Array | None) -> Outcome:
    """SciPy without E and with E; the better number, and in words what the other one is."""
    first, second = textbook(scipy_error, problem, exact), textbook(scipy_error, problem, exact, True)
    if first.value is None or first.text or second.value is None:
        return first if exact is None or first.value is not None else second
    return replace(first, text=f"{second.value:.1g} with e = E")


def gain_rows(
    name: str, x: float, problem: RiccatiProblem, note: str = "", solvers: Sequence[str] = tuple(SOLVERS)
) -> Iterator[HardCase]:
    """Error of the solvers' gains against the exact one; ``note`` says why it may be refused."""
    exact = exact_gain(problem)
    scipy_ = both_ways(problem, exact)
    for group in solvers:
        bound = SOLVERS[group][1]
        error = here(lambda: worst_part_error(gain(group, problem), exact, problem.layout.n_s))  # noqa: B023  (at once)
        case, group = (f"{name}, {group}", group) if len(solvers) > 1 else (name, "")
        yield HardCase(case, x, error, scipy_, bound, REASONS[bound] + note, may_refuse=bool(note), group=group)


# --- weights


def weight_rows(quick: bool) -> Iterator[HardCase]:
    """Input weights R from 1e-12 to 1e12."""
    problem = problem_of()
    for power in thin([-12, -8, -4, -2, 0, 2, 4, 8, 12], quick):
        r = 10.0**power
        yield from gain_rows(f"R = {r:.0e}", r, replace(problem, R=r * problem.R), HEAVY if r > 1e10 else "")


def output_rows(quick: bool) -> Iterator[HardCase]:
    """Outputs that are weighted hugely, singularly or not at all, that see little, or nothing of what moves."""
    problem, undamped = problem_of(), problem_of(beta=0.0)
    hand = problem_of("control.outputs=[{kind='hand'}]")
    hand_undamped = problem_of("control.outputs=[{kind='hand'}]", beta=0.0)
    cases: list[tuple[str, RiccatiProblem, bool]] = [
        ("Q = 1e12", replace(problem, Q=1e12 * problem.Q), False),
        ("Q = diag(1, 1e-8)", replace(problem, Q=np.diag([1.0, 1e-8])), False),
        ("Q = diag(1, 0): no weight on y", replace(problem, Q=np.diag([1.0, 0.0])), True),
        ("Q = 0", replace(problem, Q=np.zeros((2, 2))), True),
        ("only deformation is seen", replace(problem, C_s=np.zeros_like(problem.C_s)), True),
        ("only the hand is seen, damped tissue", hand, False),
        ("only the hand is seen, undamped tissue", hand_undamped, True),
        ("the tip is seen, undamped tissue", undamped, True),
        ("Q with a negative eigenvalue", replace(problem, Q=np.diag([1.0, -1.0])), True),
        ("R singular", replace(problem, R=np.diag([1.0, 0.0])), True),
    ]
    for i, (name, case, refuse) in enumerate(cases[::2] if quick else cases):
        if refuse:
            reason = "there is no stabilising feedback, or no minimum"
            yield HardCase(name, i + 1, here(gain_size, "dense", case), both_ways(case, None), None, reason)
        else:
            yield from gain_rows(name, i + 1, case, solvers=("dense",))


def gain_size(way: str, problem: RiccatiProblem) -> float:
    """Size of a gain that ought to have been refused."""
    return float(np.linalg.norm(gain(way, problem)))


# --- damping


def lqr_damping_rows(quick: bool) -> Iterator[HardCase]:
    """Kelvin-Voigt damping down to none: the gain must be right, or the modes that are lost must be named."""
    for beta in [2e-3, 2e-6] if quick else [0.2, 0.02, 2e-3, 2e-4, 2e-5, 2e-6, 2e-8, 2e-10, 2e-14]:
        yield from gain_rows(f"beta = {beta:.0e} s", beta, problem_of(beta=beta), WEAK if beta < 1e-5 else "")
    reason = "without damping X is not of low rank and high modes are lost to rounding"
    undamped = [("undamped", problem_of(beta=0.0))]
    if not quick:
        undamped.append(("paper_lqr_undamped, 880 states", make_problem(make("paper_lqr_undamped"))))
    for name, case in undamped:
        answer = here(gain_size, "low rank", case)
        yield HardCase(name, 0.0, answer, textbook(scipy_error, case, None), None, reason, group="low rank")


FAMILIES = (
    Family("weights", "Input weights from 1e-12 to 1e12", "R", "relative error of the gain",
           "SciPy, E inverted",
           "In energy coordinates the gain for the tissue, far smaller than that for the hand, keeps its digits over "
           "twenty decades of weights; in the paper's it loses up to ten of them, with E handed over nearly all.",
           weight_rows),
    Family("outputs", "Weights and outputs that see too little", "case", "relative error of the gain",
           "SciPy, E inverted",
           "Where no feedback exists the textbook way may return a number all the same; here the sentence names what "
           "is not seen.",
           output_rows, axis="listed"),
    Family("lqr_damping", "Riccati equations with hardly any damping", "Kelvin-Voigt time beta [s]",
           "relative error of the gain", "SciPy, E inverted",
           "As damping goes, poles meet the axis: the gain stays right as long as there is one, then modes are named. "
           "SciPy loses three digits more when E is inverted, and all but one or two when it is handed over.",
           lqr_damping_rows),
)  # fmt: skip
