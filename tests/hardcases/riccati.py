"""Hard cases of Riccati equations: CAREX with its known solutions; the hand's with weights of any size and no damping.

Examples of CAREX are numbered as in the SLICOT subroutine BB01AD (Abels, Benner, SLICOT Working Note 1999-14). Gains of
the hand are measured against those to thirty digits, by Newton's method on residuals in decimal arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import count

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.care import care
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.dense.paper import paper_form
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.diagnosis import diagnose
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from tests.hardcases.cases import EPS, Family, HardCase, Outcome, here, make, textbook, thin
from tests.hardcases.gains import GainBounds, exact_gain, worst_part_error

Solve = Callable[[Array, Array, Array, Array, Array], Array]  # X from A, B, C, Q, R
BYERS = "as many roundings as the Hamiltonian matrix has rows, times the condition of the equation [B85]"


@dataclass(frozen=True)
class Example:
    """A'X + XA - XBR^{-1}B'X + C'QC = 0 with its stabilising solution X [BLM95]."""

    A: Array  # state matrix, (n, n)
    B: Array  # input matrix, (n, m)
    C: Array  # output matrix, (p, n)
    Q: Array  # weight of the outputs, (p, p)
    R: Array  # weight of the inputs, (m, m)
    X: Array  # stabilising solution, (n, n)

    @property
    def graded(self) -> Example:
        """The same in coordinates in which X has a unit diagonal, so that no entry of it hides another one."""
        T = 1 / np.sqrt(np.diag(self.X))
        A, X = self.A / T[:, None] * T, self.X * T[:, None] * T
        return replace(self, A=A, B=self.B / T[:, None], C=self.C * T, X=X)

    @property
    def bound(self) -> float:
        """Backward error of a Schur method, as many roundings as the Hamiltonian matrix has rows, times condition."""
        return 2 * len(self.A) * EPS * self.graded.condition

    def error(self, X: Array) -> float:
        """|X - exact| / |exact|, both scaled by the exact diagonal; half a rounding where no bit differs."""
        T = 1 / np.sqrt(np.diag(self.X))
        return max(float(np.linalg.norm((X - self.X) * T[:, None] * T) / np.linalg.norm(self.graded.X)), EPS / 2)

    @property
    def condition(self) -> float:
        """How much relative changes of the data are magnified in X.

        Estimate of [B85]: |Omega^{-1}| (|Q| + 2 |A||X| + |G||X|^2) / |X|, Omega the Lyapunov operator of A - GX.
        """
        G, H = self.B @ np.linalg.solve(self.R, self.B.T), self.C.T @ self.Q @ self.C
        closed, one = self.A - G @ self.X, np.eye(len(self.A))
        if np.array_equal(closed, closed.T):  # Omega is normal, its eigenvalues are the sums of two of the closed loop
            least = 2 * np.abs(np.linalg.eigvalsh(closed)).min()
        else:
            least = np.linalg.svd(np.kron(one, closed.T) + np.kron(closed.T, one), compute_uv=False)[-1]
        a, g, h, x = (float(np.linalg.norm(M)) for M in (self.A, G, H, self.X))
        return (h + 2 * a * x + g * x * x) / (float(least) * x)


def example_1_1(_: float) -> Example:
    """Double integrator, Q = diag(1, 2)."""
    A = np.eye(2, k=1)
    return Example(A, np.eye(2)[:, 1:], np.eye(2), np.diag([1.0, 2.0]), np.eye(1), np.array([[2.0, 1.0], [1.0, 2.0]]))


def example_1_2(_: float) -> Example:
    """Stabilisable but not controllable, Q of rank one."""
    A, B = np.array([[4.0, 3.0], [-4.5, -3.5]]), np.array([[1.0], [-1.0]])
    C = np.array([[3.0, 2.0]])
    return Example(A, B, C, np.eye(1), np.eye(1), (1 + np.sqrt(2)) * C.T @ C)


def example_2_1(e: float) -> Example:
    """Nearly uncontrollable: B = [e, 0]."""
    w = np.sqrt(1 + e * e)
    off = 1 / (2 + w)
    X = np.array([[(1 + w) / e**2, off], [off, (1 - e**2 * off**2) / 4]])
    return Example(np.diag([1.0, -2.0]), np.array([[e], [0.0]]), np.ones((1, 2)), np.eye(1), np.eye(1), X)


def example_2_3(e: float) -> Example:
    """Hardly coupled double integrator, A = [0 e; 0 0]."""
    w = np.sqrt(1 + 2 * e)
    X = np.array([[w / e, 1.0], [1.0, w]])
    return Example(e * np.eye(2, k=1), np.eye(2)[:, 1:], np.eye(2), np.eye(2), np.eye(1), X)


def example_2_4(e: float) -> Example:
    """Closed-loop poles near the axis: A = [e+1 1; 1 e+1], G = I, Q = e^2 I."""
    one, pair = np.ones((2, 2)), np.array([[1.0, -1.0], [-1.0, 1.0]])
    x, y = ((a + np.sqrt(a * a + e * e)) for a in (e + 2, e))  # on [1, 1] and [1, -1]
    A = np.array([[e + 1, 1.0], [1.0, e + 1]])
    return Example(A, np.eye(2), np.eye(2), e * e * np.eye(2), np.eye(2), (x * one + y * pair) / 2)


def example_2_6(e: float) -> Example:
    """Badly scaled: A = e V diag(1, 2, 3) V, G = I / e, Q = V diag(1/e, 1, e) V, V = I - 2/3 [1]."""
    V = np.eye(3) - 2 / 3
    i = np.arange(1.0, 4.0)
    q = np.array([1 / e, 1.0, e])
    # e x^2 - 2 i e^3 x - q e^2 = 0 on each direction, divided by e
    x = i * e**2 + np.sqrt(i**2 * e**4 + q * e)
    return Example(e * (V * i) @ V, np.eye(3), np.eye(3), (V * q) @ V, e * np.eye(3), (V * x) @ V)


def example_3_2(_: float) -> Example:
    """Circulant of order 64: A = circ(-2, 1, 0, ..., 0, 1), G = Q = I."""
    n = 64
    A = scipy.linalg.circulant(np.eye(n)[0] * -2 + np.eye(n)[1] + np.eye(n)[-1])
    theta = np.cos(2 * np.pi * np.arange(n) / n)
    values = -2 + 2 * theta + np.sqrt(5 + 4 * theta * (theta - 2))
    column = np.fft.ifft(values).real
    X = scipy.linalg.circulant((column + np.roll(column[::-1], 1)) / 2)
    return Example(A, np.eye(n), np.eye(n), np.eye(n), np.eye(n), (X + X.T) / 2)


EXAMPLES: tuple[tuple[str, Callable[[float], Example], tuple[float, ...]], ...] = (
    ("1.1", example_1_1, (1.0,)), ("1.2", example_1_2, (1.0,)), ("2.3", example_2_3, (1.0, 1e-6, 1e6)),
    ("2.4", example_2_4, (1.0, 1e-4, 1e-7)), ("2.6", example_2_6, (1.0, 1e3, 1e6)), ("3.2", example_3_2, (1.0,)),
)  # fmt: skip


def _scipy(A: Array, B: Array, C: Array, Q: Array, R: Array) -> Array:
    return np.asarray(scipy.linalg.solve_continuous_are(A, B, C.T @ Q @ C, R))


def _balanced(A: Array, B: Array, C: Array, Q: Array, R: Array) -> Array:
    return care(A, B, C, Q, R).X


def _error(solve: Solve, x: Example) -> float:
    return x.error(solve(x.A, x.B, x.C, x.Q, x.R))


def _chain(solve: Solve, n: int = 21) -> float:
    """CAREX [BLM95] 4.1: n integrators in a row, pushed at the last, seen at the first; x_1n = 1."""
    X = solve(np.eye(n, k=1), np.eye(n)[:, -1:], np.eye(n)[:1], np.eye(1), np.eye(1))
    return max(abs(float(X[0, -1]) - 1), EPS / 2)  # half a rounding where no bit differs


def carex_rows(quick: bool) -> Iterator[HardCase]:
    """Relative error of X against the known solution."""
    place = count(1)
    for number, example, parameters in EXAMPLES:
        for e in parameters[:1] + parameters[-1:] if quick and len(parameters) > 1 else parameters:
            x = example(e)
            name = f"CAREX {number}" + (f", parameter {e:g}" if len(parameters) > 1 else "")
            yield HardCase(name, next(place), here(_error, _balanced, x), textbook(_error, _scipy, x), x.bound, BYERS)
    reason = "X has the condition 2e17, so nothing is certain; three digits are asked, the tolerance of every study"
    answers = here(_chain, _balanced), textbook(_chain, _scipy)
    yield HardCase("CAREX 4.1, entry x_1n", next(place), *answers, 1e-3, reason)


def reach_rows(quick: bool) -> Iterator[HardCase]:
    """CAREX 2.1: an unstable mode that the input reaches less and less."""
    for power in thin([0, -1, -2, -3, -4, -5, -6, -7, -8, -10, -12], quick):
        e = 10.0**power
        x = example_2_1(e)
        reason = BYERS + "; X grows like 2 / e^2 and from 1e12 on it may be refused"
        answers = here(_error, _balanced, x), textbook(_error, _scipy, x)
        yield HardCase(f"B = [{e:.0e}, 0]", e, *answers, x.bound, reason, may_refuse=power < -6)


# --- the hand's equation

TOLERANCE = 1e-8  # of both solvers on the residual, relative to |C'QC|
REASONS = {
    "dense": "rounding of each entry of the equation in energy coordinates, as a random walk, through the inverse of "
    "its derivative",
    "low rank": "the residual of the answer, each entry to fifty digits, through the inverse of the derivative of the "
    "equation; the residual itself must keep the tolerance, 1e-8",
}
HEAVY = "; at R = 1e12 the hand's poles are 1e-9 of the tissue's, and the residual may not reach the tolerance"
WEAK = "; with next to no damping a solver may give up, but not return a wrong gain"


@cache
def problem_of(*more: str, beta: float = 0.002) -> RiccatiProblem:
    """The paper's control problem on a mesh small enough for exact gains, 48 states."""
    damping = f"effects={{damping={{kind='kelvin-voigt', beta={beta!r}}}}}" if beta else "effects={}"
    return make_problem(make("paper_lqr", "tissue.cells=[2, 4]", damping, *more))


SOLVERS: dict[str, DenseRiccati | NewtonADI] = {"dense": DenseRiccati(), "low rank": NewtonADI(tol=TOLERANCE)}


def solved(way: str, problem: RiccatiProblem) -> tuple[Array, Block]:
    """K, (m, states), and Z of one rank after the diagnosis; ControlError or SolverError where there is none."""
    diagnose(problem).require()
    solution = SOLVERS[way].solve(problem)
    K = solution.gain
    return np.hstack([K.K_s, K.K_z.T, K.K_v.T]), solution.factor


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
    scipy_, bounds = both_ways(problem, exact), GainBounds(problem, exact)
    for group in solvers:
        bound = bounds.rounding()

        def error() -> float:
            nonlocal bound
            K, Z = solved(group, problem)  # noqa: B023  (at once)
            if group == "low rank":  # noqa: B023
                undecided, residual = bounds.of_factor(Z)
                bound += undecided
                if not residual <= TOLERANCE:
                    return math.inf
            return worst_part_error(K, exact, problem.layout.n_s)

        answer = here(error)
        case, reason = f"{name}, {group}", REASONS[group] + note
        yield HardCase(case, x, answer, scipy_, bound, reason, may_refuse=bool(note), group=group)


# --- weights


def weight_rows(quick: bool) -> Iterator[HardCase]:
    """Input weights R from 1e-8 to 1e12; at 1e-12 sums of absolute values stay five decades above the error."""
    problem = problem_of()
    for power in thin([-8, -4, -2, 0, 2, 4, 8, 12], quick):
        r = 10.0**power
        yield from gain_rows(f"R = {r:.0e}", r, replace(problem, R=r * problem.R), HEAVY if r > 1e10 else "")


def output_rows(quick: bool) -> Iterator[HardCase]:
    """Outputs that are weighted hugely, singularly or not at all, that see little, or nothing of what moves."""
    problem, undamped = problem_of(), problem_of(beta=0.0)
    hand = problem_of("control.outputs=[{kind='hand'}]")
    hand_undamped = problem_of("control.outputs=[{kind='hand'}]", beta=0.0)
    cases: list[tuple[str, RiccatiProblem, bool]] = [
        ("Q = 1e8", replace(problem, Q=1e8 * problem.Q), False),
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
    return float(np.linalg.norm(solved(way, problem)[0]))


# --- damping


def lqr_damping_rows(quick: bool) -> Iterator[HardCase]:
    """Kelvin-Voigt damping down to none: the gain must be right, or the modes that are lost must be named."""
    for beta in [2e-3, 2e-6] if quick else [0.2, 0.02, 2e-3, 2e-4, 2e-5, 2e-6, 2e-8, 2e-10, 2e-14]:
        ways = tuple(SOLVERS) if beta > 1e-9 else ("dense",)  # below, a residual says four digits less than is right
        note = WEAK if beta < 1e-5 else ""
        yield from gain_rows(f"beta = {beta:.0e} s", beta, problem_of(beta=beta), note, ways)
    reason = "without damping X is not of low rank and high modes are lost to rounding"
    undamped = [("undamped", problem_of(beta=0.0))]
    if not quick:
        undamped.append(("paper_lqr_undamped, 880 states", make_problem(make("paper_lqr_undamped"))))
    for name, case in undamped:
        answer = here(gain_size, "low rank", case)
        yield HardCase(name, 0.0, answer, textbook(scipy_error, case, None), None, reason, group="low rank")


FAMILIES = (
    Family("carex", "Riccati equations with known solutions", "example", "relative error of X", "SciPy's solver",
           "Balancing and two Newton steps keep what the Schur method alone loses when scales differ.", carex_rows,
           axis="listed"),
    Family("reach", "A mode that the input hardly reaches", "share of the input that reaches the unstable mode",
           "relative error of X", "SciPy's solver",
           "As the input loses the mode, X grows like 2 / e^2; a wrong X is worse than none.", reach_rows),
    Family("weights", "Input weights from 1e-8 to 1e12", "R", "relative error of the gain",
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
