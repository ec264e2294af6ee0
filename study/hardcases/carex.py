"""Hard cases of the dense Riccati solver: examples with known solutions from the benchmark collection CAREX.

The numbering is that of the SLICOT subroutine BB01AD (Abels, Benner, SLICOT Working Note 1999-14).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.care import care
from softgrasp.study.hardcases.cases import EPS, Family, HardCase, here, textbook, thin

Solve = Callable[[Array, Array, Array, Array, Array], Array]  # X from A, B, C, Q, R
BYERS = "as many roundings as the Hamiltonian matrix has rows, times the condition of the equation [B85]"


@dataclass(frozen=True)
class Example:
    """A'X + XA - XBR^{-1}B'X + C'QC = 0 with its stabilising solution X [BLM95]."""

    A: Array
    B: Array
    C: Array
    Q: Array
    R: Array
    X: Array

    @property
    def bound(self) -> float:
        """Backward error of a Schur method, as many roundings as the Hamiltonian matrix has rows, times condition."""
        return 2 * len(self.A) * EPS * self.condition

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
    return float(np.linalg.norm(solve(x.A, x.B, x.C, x.Q, x.R) - x.X) / np.linalg.norm(x.X))


def _chain(solve: Solve, n: int = 21) -> float:
    """CAREX [BLM95] 4.1: n integrators in a row, pushed at the last, seen at the first; x_1n = 1."""
    X = solve(np.eye(n, k=1), np.eye(n)[:, -1:], np.eye(n)[:1], np.eye(1), np.eye(1))
    return abs(float(X[0, -1]) - 1)


def carex_rows(quick: bool) -> Iterator[HardCase]:
    """Relative error of X against the known solution."""
    place = count(1)
    for number, make, parameters in EXAMPLES:
        for e in parameters[:1] + parameters[-1:] if quick and len(parameters) > 1 else parameters:
            x = make(e)
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


FAMILIES = (
    Family("carex", "Riccati equations with known solutions", "example", "relative error of X", "SciPy's solver",
           "Balancing and two Newton steps keep what the Schur method alone loses when scales differ.", carex_rows,
           axis="listed"),
    Family("reach", "A mode that the input hardly reaches", "share of the input that reaches the unstable mode",
           "relative error of X", "SciPy's solver",
           "As the input loses the mode, X grows like 2 / e^2; a wrong X is worse than none.", reach_rows),
)  # fmt: skip
