"""The momenta of a free hand and its tissue over a midpoint step, whatever the tissue did in it.

In the hand's axes the momenta mu = [P; L] obey mu' = ad*(xi) mu + F. The step takes the midpoint rule with the mean
velocity xi = (xi_n + xi_{n+1}) / 2, and turns the hand by the Cayley transform,

    mu_{n+1} - mu_n = h ad*(xi) (mu_n + mu_{n+1}) / 2 + h F,   Q_{n+1} = Q_n cay(h Omega),   p_{n+1} = p_n + h cof(Qm) V

with Qm = (Q_n + Q_{n+1}) / 2. Seen from space it is Q_{n+1} P_{n+1} = Q_n P_n + h Qm F_P, and without load the angular
momentum about any fixed point is kept as well: both momenta are exact, and ad* does no work, so that the energy changes
by what the tissue's own step and the loads do [HLW06].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.frame.integrals import Sums, coadjoint, turned_momentum
from softgrasp.fem.frame.rotation import cayley, cross_matrix, rotation_matrix, rotation_vector
from softgrasp.fem.petsc import Array

MOST = 20  # largest number of iterations [1]
ROUNDING = 8 * float(np.finfo(float).eps)  # change of the velocity at which they end, over what its terms add up to [1]


@dataclass(frozen=True)
class HandPlace:
    """A turning hand at an instant; vectors in space."""

    q: Array  # [p; theta], (6,) [m, rad]
    Q: Array  # rotation, (3, 3) [1]
    xi: Array  # velocity [V; Omega] in its own axes, (6,) [m/s, rad/s]

    @staticmethod
    def of(q: Array, v: Array) -> HandPlace:
        """From [p; theta] and [p'; omega], (6,) each."""
        Q = rotation_matrix(q[3:])
        return HandPlace(q, Q, np.concatenate([v[:3] @ Q, v[3:] @ Q]))

    @property
    def v(self) -> Array:
        """Velocity [p'; omega] in the axes of space, (6,) [m/s, rad/s]."""
        return np.concatenate([self.Q @ self.xi[:3], self.Q @ self.xi[3:]])

    def moved(self, xi: Array, dt: float) -> HandPlace:
        """After a step with the mean velocity xi."""
        Q = self.Q @ cayley(dt * xi[3:])
        mean = (self.Q + Q) / 2
        p = self.q[:3] + dt * np.linalg.det(mean) * np.linalg.solve(mean.T, xi[:3])
        return HandPlace(np.concatenate([p, rotation_vector(Q, self.q[3:])]), Q, 2 * xi - self.xi)


@dataclass(frozen=True)
class Travel:
    """What the tissue does in a step of w = z_mid - z_n, summed over all nodes; vectors in space."""

    work: Array  # G'w, (6,) [kg m, kg m2]
    B: Array  # int rho w_k r_l, (3, 3) [kg m2]
    turning: Array  # int rho z_1 x (2 s w - y_n), (3,) [kg m2/s]
    C: Array  # int rho z_1 z_mid', (3, 3) [kg m2]


@dataclass(frozen=True)
class HandBalance:
    """Momenta of hand and tissue; matrices in space, zero where the plane has no such freedom."""

    M: Array  # M_hand + M_rigid, M_hand alone where the tissue does not act on the hand, (6, 6) [kg, kg m, kg m2]
    heavy: Array  # part of M that has weight, (6, 6)
    g: Array  # gravity in space, (3,) [m/s2]
    free: list[int]  # places of the hand's degrees of freedom
    dt: float  # step [s]

    def velocity(self, hand: HandPlace, sums: Sums, travel: Travel, load: Array, guess: Array) -> Array:
        """Mean velocity xi of the step, (6,) [m/s, rad/s], by Newton's method.

        Args:
            hand: at the start of the step.
            sums: the tissue there.
            travel: the tissue in the step.
            load: force and torque about the reference point in the axes of space, (6,) [N, N m].
            guess: where to begin, (6,).

        Raises SolverError: the hand turns too far in a step.
        """
        A, b = self._map(hand, sums, travel)
        before, free, h, inverse = sums.momenta(self.M, hand.xi), self.free, self.dt, np.zeros((6, 6))
        weight, slope = self._load(hand.Q, sums.first + travel.work[:3], load)
        right, here, xi = before - b + h * weight, np.ix_(free, free), np.array(guess)
        sizes, terms = np.abs(A), np.abs(b) + np.abs(before)
        for _ in range(MOST):
            after = A @ xi + b
            both = h / 2 * turned_momentum(after + before)
            both[:, 3:] += h * slope
            J = A - h / 2 * coadjoint(xi) @ A - both
            R = A @ xi - right - both @ xi  # mu_{n+1} - mu_n - h ad*(xi) (mu_n + mu_{n+1}) / 2 - h F
            if not (np.isfinite(J).all() and np.isfinite(R).all()):
                break
            inverse[here] = np.linalg.inv(J[here])
            change = inverse @ R
            xi -= change
            left = h / 2 * (coadjoint(change) @ (A @ change))  # R is quadratic: what this correction leaves
            size = sizes @ np.abs(xi) + terms  # of what R is a difference of
            if (np.abs(inverse @ left) <= ROUNDING * (np.abs(inverse) @ size)).all():
                return xi
        raise SolverError(
            f"the hand's velocity in a step does not converge, where it turns by {h * np.linalg.norm(xi[3:]):.2g} rad; "
            "use more time.steps"
        )

    def _load(self, Q: Array, m: Array, load: Array) -> tuple[Array, Array]:
        """Mean load in the hand's axes, Qm^-1 of that in space, with the weight of hand and tissue: F = a + B Omega.

        Shapes are (6,) and (6, 3).
        """
        axes = np.stack([load[:3], load[3:], self.g]) @ Q
        force, torque, g = axes
        slopes = self.dt / 2 * cross_matrix(axes)  # x - h/2 Omega x x = x + h/2 x x Omega
        lever, heavy = cross_matrix(m), self.heavy[:, :3]
        value, slope = np.concatenate([force, torque]) + heavy @ g, slopes[:2].reshape(6, 3) + heavy @ slopes[2]
        value[3:] += lever @ g
        slope[3:] += lever @ slopes[2]
        return value, slope

    def _map(self, hand: HandPlace, sums: Sums, travel: Travel) -> tuple[Array, Array]:
        """A and b with mu_{n+1} = A xi + b for a known travel of the tissue."""
        eye, s = np.eye(3), 2 / self.dt
        first, B = sums.first + 2 * travel.work[:3], sums.B + 2 * travel.B
        middle, between = sums.first + travel.work[:3], sums.B + travel.B
        lever = np.trace(B) * eye - B.T
        A = 2 * self.M
        A[:3, 3:] -= 2 * cross_matrix(middle)
        A[3:, :3] += 2 * cross_matrix(first)
        A[3:, 3:] += 2 * (lever + np.trace(between) * eye - between + np.trace(travel.C) * eye - travel.C.T)
        b = 2 * s * travel.work - sums.drift - self.M @ hand.xi
        b[3:] += travel.turning - cross_matrix(first) @ hand.xi[:3] - lever @ hand.xi[3:]
        return A, b


def still() -> Sums:
    """A tissue that does not act on the hand."""
    return Sums(np.zeros(6), np.zeros(3), np.zeros((3, 3)), np.zeros(3))


def no_travel() -> Travel:
    """A tissue that does not act on the hand, in a step."""
    return Travel(np.zeros(6), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)))
