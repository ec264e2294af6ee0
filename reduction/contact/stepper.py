"""Runs of a reduced model with contact: the impulse step in coordinates a with V'M V = I and V'K V diagonal.

With s = 2/dt and gaps g = N a + F mu + g_s that the hand's motion and the obstacles' shift by g_s,

    S w_0 = s v_n - Lambda a_n + l_n,   S = s^2 + s D + Lambda,   0 <= x,  W x + q >= 0,  x'(W x + q) = 0,
    q = g_s,n+1 / 2 + N (a_n / 2 + w_0) + F k mu_n / 2,   W = N S^-1 N' + f F / 2,   w = w_0 + S^-1 N'x,
    a_n+1 = a_n + 2 w,   v_n+1 = 2 s w - v_n + N'y,   mu_n+1 = k mu_n + f x,
    (N N' + FIRM f F / dt^2)_AA y = -(N v + g_s')_A on the pressed rows A.

F mu is what V lacks of the static answers to the forces x, without mass: theta mu_n+1 + (1 - theta) mu_n
+ lag (mu_n+1 - mu_n) / dt = x, with f = 1 / (theta + lag / dt), k = 1 - f and the least theta >= 1/2 with k >= 0, so
that a force that ends leaves no oscillation [MacN71]. It is the step of the full model (`fem/run/contact`) otherwise:
no row is in an obstacle at the end of a step, the balance of energy closes to rounding with

    1/2 mu'F mu   stored,   (lag / dt + theta - 1/2) (mu_n+1 - mu_n)'F (mu_n+1 - mu_n)   dissipated in a step,

and the impulse takes energy from rows before obstacles that rest. `stepper.c` runs all steps; without a compiler NumPy
runs the same ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles.compiled import RIDGE, compiled, contact_library
from softgrasp.fem.obstacles.small import SmallProblem
from softgrasp.fem.petsc import Array

SOURCE = Path(__file__).with_name("stepper.c")
DECLARATION = """int softgrasp_contact_march(void *complement, int k, int p, int steps, const double *inverse,
  const double *stiffness, const double *N, const double *Y, const double *W, const double *U, const double *F,
  double follow, double keep, const double *load, const double *gap, const double *rate, double s, double tol,
  double still, double *A, double *V, double *X, double *J, double *M, int *sets, double *room, long *tally);"""
STILL = 1e-12  # normal velocity of pressed rows over the largest one, which is rounding [1]
# Weight of what V lacks in the matrix of an impulse [1]; from 8 to 64 errors hardly change, at 1 that of z doubles.
FIRM = 16.0


@dataclass(frozen=True)
class ContactSteps:
    """One reduced model at one step."""

    stiffness: Array  # Lambda, (k,) [1/s^2]
    D: Array  # V'D V, (k, k) [1/s]
    N: Array  # rows of the nodes that may touch, (p, k) [kg^-1/2]
    F: Array  # answers of these rows to forces on them that V lacks, symmetric, >= 0, (p, p) [m/N]
    lag: float  # Kelvin-Voigt time of those [s]
    dt: float  # step [s]

    def march(
        self, start: Array, load: Array, gap: Array, rate: Array, tol: float, engine: str = ""
    ) -> tuple[Array, Array, Array, Array, Array]:
        """States a and v (steps + 1, k), forces x and impulses y of the rows (steps, p), mu. Not collective.

        Forces are in N, impulses in N s; mu (steps + 1, p) in N.

        Args:
            start: a at rest at the start, (k,) [kg^1/2 m].
            load: V'l in each step, (steps, k).
            gap: g_s of the rows, (steps + 1, p) [m], and its ``rate`` [m/s].
            tol: rounding of a gap [m].
            engine: "C" or "NumPy"; empty takes C where there is a compiler.

        Raises SolverError: the contact problem of a step has no solution, or there is no compiled code.
        """
        (steps, k), p, s = load.shape, len(self.N), 2 / self.dt
        inverse = np.linalg.inv(s * s * np.eye(k) + s * self.D + np.diag(self.stiffness))
        Y = np.ascontiguousarray(self.N @ inverse)
        follow, keep = self.fading
        W, U = Y @ self.N.T, self.N @ self.N.T + FIRM * follow / self.dt**2 * self.F
        W = np.ascontiguousarray((W + W.T + follow * self.F) / 2)
        a, v = np.zeros((2, steps + 1, k))
        x, y = np.zeros((2, steps, p))
        mu = np.zeros((steps + 1, p))
        a[0] = start
        codes = None if engine == "NumPy" else (contact_library(), compiled(SOURCE, DECLARATION))
        if codes is None or None in codes:
            if engine == "C":
                raise SolverError("compiled contact is not available here; leave the engine out")
            self._in_numpy(inverse, Y, W, U, (load, gap, rate), tol, (a, v, x, y, mu))
            return a, v, x, y, mu
        (other, small), (ffi, code) = codes

        def at(values: Array) -> object:
            return ffi.from_buffer("double[]", values)

        complement = ffi.cast("void *", int(other.cast("intptr_t", other.addressof(small, "softgrasp_complement"))))
        room, sets = np.zeros(2 * p * p + 10 * p + 3 * k), np.zeros(4 * p, np.intc)
        ends: int = code.softgrasp_contact_march(
            complement, k, p, steps, at(inverse), at(self.stiffness), at(self.N), at(Y), at(W), at(U), at(self.F),
            follow, keep, at(load), at(gap), at(rate), s, tol / 4, STILL, at(a), at(v), at(x), at(y), at(mu),
            ffi.from_buffer("int[]", sets), at(room), ffi.new("long[2]"),
        )  # fmt: skip
        if ends >= 0:
            raise _unsolved(ends, self.dt)
        return a, v, x, y, mu

    @property
    def fading(self) -> tuple[float, float]:
        """Shares f and k, by which mu follows forces."""
        slow = self.lag / self.dt
        follow = 1 / (max(0.5, 1 - slow) + slow)
        return follow, max(0.0, 1 - follow)

    def _in_numpy(
        self, inverse: Array, Y: Array, W: Array, U: Array, given: tuple[Array, Array, Array], tol: float,
        result: tuple[Array, Array, Array, Array, Array],
    ) -> None:  # fmt: skip
        """The same steps."""
        (load, gap, rate), (a, v, x, y, mu) = given, result
        small, s, N, fastest = SmallProblem("NumPy"), 2 / self.dt, self.N, 0.0
        follow, keep = self.fading
        for n in range(len(load)):
            w = inverse @ (s * v[n] - self.stiffness * a[n] + load[n])
            mu[n + 1] = keep * mu[n]
            q = gap[n + 1] / 2 + N @ (a[n] / 2 + w) + self.F @ mu[n + 1] / 2
            if (q < 0).any():
                try:
                    x[n] = small.solve(len(q), W, q, tol / 4)
                except SolverError:
                    raise _unsolved(n, self.dt) from None
                w += x[n] @ Y
                mu[n + 1] += follow * x[n]
            a[n + 1], v[n + 1] = a[n] + 2 * w, 2 * s * w - v[n]
            rows = np.flatnonzero(x[n] > 0)
            b = -(N[rows] @ v[n + 1] + rate[n + 1, rows])
            fastest = max(fastest, float(np.abs(b).max(initial=0.0)))
            if np.abs(b).max(initial=0.0) > STILL * fastest:
                block = U[np.ix_(rows, rows)]
                y[n, rows] = np.linalg.solve(block + RIDGE * np.diag(block.diagonal()), b)
                v[n + 1] += y[n, rows] @ N[rows]


def _unsolved(n: int, dt: float) -> SolverError:
    return SolverError(
        f"the contact problem of the step from t = {n * dt:.6g} s has no solution; obstacles that leave the tissue no "
        "room are the usual reason: move one, or use smaller steps"
    )
