"""Contact at finite strain: forces x on the boundary are one more load of the step.

    R(w) = (s^2 M + s D) w + f_alg(z_n, w) - s pi_n - G c - N'x = 0,   0 <= x,  g_{n+1} >= 0,  x'g_{n+1} = 0.

A round solves the small problem with W = N S^-1 N' of the tangent S that the step has, from the gaps of the last round,
and the step under the new forces; the responses are made anew where the tangent was. Forces do the work 2 x'Nw, as in
the linear step. At the end of the rounds w is scaled to w'R = 0, so that the balance of energy closes: of all changes
of w that do so, that is the smallest in the norm of S, and no larger there than the error that R leaves.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.general import MOST, Contact, unsettled
from softgrasp.fem.run.contact.rows import Rows
from softgrasp.fem.run.contact.touching import Touching
from softgrasp.fem.run.finite_strain import BENDS, MOST_BALANCED, FiniteStrainMidpoint
from softgrasp.fem.run.midpoint import Feedback
from softgrasp.fem.run.motion import Driven
from softgrasp.fem.strain.newton import EPS

SHARE = EPS**0.5  # of w, over which the change of R is found: small are both its rounding and its bend along w [1]
MOST_SCALED = 1e-3  # of w: near rest w is an error of the step as R is, and w'R no work to speak of [1]
CLOSE = 1e-13  # of the body: gaps of pressed nodes at the end of the rounds [1]


class FiniteContactMidpoint(Touching, FiniteStrainMidpoint):
    """The step of finite strain; ``contact`` acts at its end."""

    def solve_midpoint(self, c: Array, feedback: Feedback | None = None) -> None:
        """See :meth:`FiniteStrainMidpoint.solve_midpoint`. Collective."""
        super().solve_midpoint(c, feedback)
        self.free_load = self.right

    def press(self, pressing: Array, change: Array) -> None:
        """Solve the step anew from w + change under further forces on the rows here. Collective.

        Raises SolverError: no convergence.
        """
        if self.jump is not None:
            raise SolverError(
                "contact at finite strain cannot act in a step that is divided into substeps; raise time.steps"
            )
        self.right = self.free_load + pressing
        root = self._find(self.w_array + change, balanced=False)
        if root.iterations < 0:
            raise SolverError(
                f"contact at finite strain ({self.body.law.name}): the step does not converge under the forces of the "
                "obstacles; raise time.steps or use a slower motion"
            )
        counts = self.counts
        counts.iterations += root.iterations
        counts.most = max(counts.most, root.iterations)
        self.w.array_w[:], self.R = root.x, root.R

    def balance(self) -> bool:
        """Scale w to w'R = 0 and say whether that changed it. Collective."""
        w, R, scaled = self.w_array, self.R, False
        for _ in range(MOST_BALANCED):
            if self.is_workless(w, R):
                break
            work, change = self.dot(w, R), self.dot(w, R - self._residual((1 - SHARE) * w)[0]) / SHARE
            if abs(work) > MOST_SCALED * change:
                break
            self.w.array_w[:] = w - work / change * w
            scaled = True
            if self.last <= BENDS:
                break
            R = self._residual(w)[0]
        return scaled


class FiniteContact(Contact):
    """`Contact` of one run at finite strain, under a hand that feels no tissue."""

    midpoint: FiniteContactMidpoint

    def _settle(self, n: int, x0: Array, free: Array) -> tuple[Array, Rows]:
        """See :meth:`Contact._settle`. Collective."""
        midpoint, tol = self.midpoint, max(self.tolerance(free), CLOSE * self.layout.extent)
        known, before = self.after < 0, self._make_rows(np.zeros((0, 2), dtype=int))
        known[self.rows.obstacle, self.rows.node] = True
        active, self.planes.kept = known & False, known & False
        active[self.rows.obstacle, self.rows.node] = True
        x1, pressing = free, np.zeros_like(midpoint.r_array)
        for count in range(MOST):
            self._refresh()
            rows = self._make_rows(np.argwhere(known))
            at = rows.obstacle, rows.node
            q = self._look_along(rows, n, x0, x1, x1)
            C = self.select(self.responses, np.argwhere(known), rows.normal)
            m = C.shape[1]
            W = C @ self.responses.G[:m, :m] @ C.T
            self.small.restart(W, np.flatnonzero(active[at]))
            f0 = self._strengths(before, m)
            rows.x = self.small.solve(len(q), W, q - C @ self.responses.G[:m, :m] @ f0, tol / 4).copy()
            f = C.T @ rows.x
            pressing[self.places] = self.surface.on_nodes(self.responses.forces(f))[self.order]
            midpoint.press(pressing, self.responses.columns[:, :m] @ (f - f0))
            before, pressed = rows, rows.x > 0
            active[:] = False
            active[rows.obstacle[pressed], rows.node[pressed]] = True
            x1, left = self._end(rows, n, x0)
            if self._reached(left[pressed]) <= tol and midpoint.balance():
                x1, left = self._end(rows, n, x0)
            if self._reached(left[pressed]) <= tol:
                return f, rows.take(pressed)
            known |= self.after < -tol
            self.planes.keep(rows, np.where(pressed, np.abs(left), -left) > tol, count)
        raise unsettled(self._reached(left[pressed]))

    def _end(self, rows: Rows, n: int, x0: Array) -> tuple[Array, Array]:
        """Boundary nodes at the end of a step, (p, d), and gaps of rows there, (k,) [m]; sets ``after``. Collective."""
        x1 = x0 + self._way(n)
        self.after = self._gaps(x1, n + 1)
        return x1, self.planes.left(rows, n, x0, x1, self.gaps, self.after)

    def _reached(self, left: Array) -> float:
        """Largest depth of any node, or gap ``left`` of a pressed one [m]."""
        return float(max(np.abs(left).max(initial=0.0), -self.after.min()))

    def _strengths(self, rows: Rows, m: int) -> Array:
        """Strengths (m,) of the responses in the forces of rows."""
        if not len(rows.node):
            return np.zeros(m)
        C = self.select(self.responses, np.stack([rows.obstacle, rows.node], axis=1), rows.normal)
        return np.asarray(C.T @ rows.x)

    def _way(self, n: int) -> Array:
        """Motion of the boundary nodes in the step, hand included, (p, d) [m]. Collective."""
        assert self.drive is not None
        z = 2 * self._take(self.midpoint.w_array) + self.surface.T @ (self.drive.q[n + 1] - self.drive.q[n])
        return np.asarray(z.reshape(self.p, self.d))

    def _refresh(self) -> None:
        """Make all responses anew where the tangent is another one. Collective."""
        if self.factors != (count := self.midpoint.counts.factors):
            keys = [(int(i), int(k)) for i, k in self.responses.keys[: self.responses.count]]
            self.responses, self.factors = self._make_responses(), count
            self.responses.enter(keys)

    factors = 0  # tangents factored when the responses were made

    def _add(self, n: int, f: Array, drive: Driven) -> None:
        """See :meth:`Contact._add`; the step has the forces already. Collective."""
        self.forces = self.responses.forces(f)
        self.moved = self._take(self.midpoint.w_array)

    def _carry(self) -> None:
        """See :meth:`Contact._carry`: r is the momentum alone here, which w has taken on."""

    def restore(self, rows: Array, numbers: Array) -> None:
        """See :meth:`Contact.restore`. Collective."""
        self.factors = self.midpoint.counts.factors
        super().restore(rows, numbers)
