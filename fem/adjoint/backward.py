"""The midpoint rule backwards: the costate of a full run, one solve a step with the factor of the run.

A step solves, with s = 2/dt, c = -(kappa a + alpha v_n - g), kappa = 1 + alpha dt/2 (alpha where it drags in space),

    S w - G c + K z_n - s M v_n = 0,   M_hand a [- M_rigid c + G'(theta w - s v_n)] - weight - u_n = 0

and sets z, v of the tissue and q_s, v_s of the hand. With Z, V, p, m the derivatives of J by these at step n + 1,

    S eta [+ theta G xi] = 2 Z + 2 s V,   kappa G'eta + (M_hand [+ kappa M_rigid]) xi = dt m + dt^2/2 p,
    Z_n = Z - K eta + C'r_n,   V_n = -V + s M eta [+ s G xi],
    p_n = p + C_s'r_n,         m_n = m + dt p - alpha G'eta [- alpha M_rigid xi],        r_n = dJ/dy_n,

([...] where the tissue acts on the hand). S is symmetric, so that its factor serves both ways; M eta comes from S eta.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from softgrasp.fem.adjoint.forward import KeptRun
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.solve.solvers import ITERATIVE

# entries of the costates that lie side by side, and steps: products with several columns read a matrix once, and blocks
# that stay in the cache take half of the time of larger ones
BLOCK_ENTRIES, BLOCK_STEPS = 131_072, (8, 64)
TIGHT = 1e-10  # relative tolerance of an iterative solver on the way back


class Backward:
    """The way back.

    Args:
        run: at its end.
        C: output columns, local rows (n_local, p).
        C_s: rigid part of the outputs, (p, n_s).
        r: dJ/dy, (steps + 1, p).
        driven: whether the hand is prescribed.

    Attributes:
        Z, V: derivatives of J by z and v of the tissue at the step reached, on the rows here.
        p, m: those by q_s and v_s of a hand that a force moves, (n_s,).
        xi: costate of the hand in each step, dJ/du of a force, (steps, n_s).
        pulls: G'eta of each step, (steps, n_s), over all ranks after :meth:`finish`.
    """

    def __init__(self, run: KeptRun, C: Array, C_s: Array, r: Array, driven: bool) -> None:
        self.run, self.midpoint, self.r, self.C_s, self.driven = run, run.midpoint, r, C_s, driven
        system, operators = run.model.system, run.midpoint.operators
        self.system, self.operators, self.comm = system, operators, system.layout.comm
        self.C = np.ascontiguousarray(operators.gather(C))
        self.G, self.s, self.dt = operators.G, run.midpoint.s, run.dt
        n_s, self.n = system.layout.n_s, run.steps
        self.alpha = system.damping.drag
        self.kappa, self.theta = 1 + self.alpha * self.dt / 2, self.s * (self.s + self.alpha)
        self.felt = system.two_way and not driven
        self.L = system.M_hand
        if self.felt:
            self.Y = self.midpoint.Y  # which the run made
            GY = self._over_ranks(self.G.T @ self.Y)
            self.L = system.M_hand + self.kappa * (system.M_rigid - self.theta * (GY + GY.T) / 2)
        if run.solver.name in ITERATIVE:
            ksp = run.midpoint.solver.ksp
            ksp.setTolerances(rtol=min(TIGHT, ksp.getTolerances()[0]))
        self._check = True  # the first solve of the way back
        self.Z, self.V = self.C @ r[self.n], np.zeros(len(self.C))
        self.p, self.m = C_s.T @ r[self.n], np.zeros(n_s)
        self.xi, self.pulls = np.zeros((self.n, n_s)), np.zeros((self.n, n_s))

    def _over_ranks(self, share: Array) -> Array:
        """Sum of a small array that each rank computed on its rows here. Collective."""
        return share if self.operators.whole else total(self.comm, share)

    def blocks(self) -> Iterator[tuple[int, Array, Array]]:
        """First step of some steps in a row, their states and costates, from the last on. Collective.

        States are [z; v], local rows (2 n_local, steps + 1), costates eta those of the owned rows (n_local, steps).
        Raises SolverError: a solve fails or misses its tolerance.
        """
        n_e, (least, most), Z = self.system.layout.n_e, BLOCK_STEPS, self.run.all_states.Z
        block = int(np.clip(BLOCK_ENTRIES // n_e, least, most))  # the same on every rank
        eta = np.zeros((self.system.layout.n_local, block), order="F")
        for last in range(self.n, 0, -block):
            begin = max(0, last - block)
            for n in range(last - 1, begin - 1, -1):
                eta[:, n - begin] = self._step(n)
            yield begin, Z[:, begin : last + 1], eta[:, : last - begin]

    def _solve(self, b: Array) -> Array:
        """S^-1 b on the rows here, a view that the next solve overwrites; the first is checked. Collective."""
        midpoint = self.midpoint
        midpoint.r.array_w[:] = b
        midpoint.solver.solve(midpoint.r, midpoint.w)
        if self._check:
            self._check = False
            with self.operators.raise_on_all_ranks():
                midpoint.solver.check(midpoint.r, midpoint.w, "the adjoint")
        result: Array = midpoint.w_array
        return result

    def _step(self, n: int) -> Array:
        """Go back over one step; eta on the owned rows. Collective."""
        s, r, system = self.s, self.r[n], self.system
        b = 2 * (self.Z + s * self.V)
        eta = self._solve(b)
        if self.driven:
            self.pulls[n] = self.G.T @ eta
        else:
            self._hand(n, b, eta)
        K_eta, M_eta = self._products(b, eta)
        self.V *= -1.0
        self.V += s * M_eta
        if self.felt:
            self.V += self.G @ (s * self.xi[n])
        self.Z -= K_eta
        self.Z += self.C @ r
        if not self.driven:
            self.m = self.m + self.dt * self.p - self.alpha * self.pulls[n]
            self.m -= self.alpha * (system.M_rigid @ self.xi[n]) if self.felt else 0.0
            self.p = self.p + self.C_s.T @ r
        return eta[self.operators.rows]

    def _hand(self, n: int, b: Array, eta: Array) -> None:
        """Costate of a hand that a force moves; turns b and eta into those beside it. Collective."""
        known = self.dt * self.m + self.dt**2 / 2 * self.p
        pull = self._over_ranks(self.G.T @ eta)
        self.xi[n] = np.linalg.solve(self.L, known - self.kappa * pull)
        if self.felt:
            load = self.theta * self.xi[n]
            w = self.midpoint.w.array_w
            w -= self.Y @ load
            b -= self.G @ load
            pull = self._over_ranks(self.G.T @ eta)
        self.pulls[n] = pull

    def _products(self, b: Array, eta: Array) -> tuple[Array, Array]:
        """K eta and M eta, where S eta = b. Collective."""
        midpoint, s = self.midpoint, self.s
        midpoint.K2.mult(midpoint.w, midpoint.k)
        K_eta = midpoint.k.array_r / -2
        if midpoint.operators.M is not None:  # layers that differ in their damping
            midpoint.operators.M.mult(midpoint.w, midpoint.y)
            return K_eta, midpoint.y.array_r.copy()
        return K_eta, (b - (1 + s * midpoint.beta) * K_eta) / (s * (s + midpoint.alpha))

    def finish(self) -> None:
        """Sum over the ranks what each computed on its rows. Collective, once, after the last block."""
        if self.driven:
            self.pulls = self._over_ranks(self.pulls)
