"""The midpoint step in the frame of a turning hand on a basis z = Phi a, with the integrals of its modes.

With y = z' + Omega x z on the nodes, S_i,kl = int rho phi_i,k r_l and the pairs E_kl,ij = int rho phi_i,k phi_j,l,
a matrix H that turns all nodes alike acts as E(H) = sum_kl H_kl E_kl. The step of the full model
(`fem/run/frame/midpoint.py`), tested with Phi, reads for s = 2/dt, w = (a_{n+1} - a_n) / 2, O = (Omega x) / s

    [K + s D + s^2 (M + 2 E(O) + E(O^2))] w = s p_n + l - K a_n - s^2 (E(O) + E(O^2)) a_n,      p_n = int rho Phi . y_n
    l = -G [A - g; Omega'] - S : (Omega x)^2,       y_{n+1} = 2 s (w + O (a_n + w)) - y_n  in the integrals

Only integrals of y are carried: Y_i,kl = int rho phi_i,k y_l, G'y, and |y|^2. They are what the momenta of hand and
tissue and the energy are made of, so that a free hand keeps all three, as in the full model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.frame.balance import ROUNDING, HandBalance, HandPlace, Travel
from softgrasp.fem.frame.integrals import Sums, square
from softgrasp.fem.frame.rotation import cross_matrix, spatial
from softgrasp.fem.petsc import Array
from softgrasp.reduction.turning.compiled import FreeStep

MOST = 100  # largest number of iterations of a step with a free hand [1]
TOL = 1e-13  # of such a step, over the largest load; where that is below the rounding of its terms, that ends it


@dataclass(frozen=True)
class TurningMatrices:
    """Small matrices of tissue in the frame of a hand, at one set of materials; d is the dimension of space."""

    M: Array
    """Mass of the modes, (k, k)."""
    K: Array
    """Stiffness, (k, k)."""
    D: Array
    """Damping, (k, k)."""
    G: Array
    """Load of a unit acceleration of the hand, (k, n_s)."""
    S: Array
    """Integrals int rho phi_k r_l, column k d + l, (k, d^2)."""
    E: Array
    """Pair integrals int rho phi_i,k phi_j,l, (d, d, k, k)."""

    def turned(self, H: Array) -> Array:
        """E(H), the mass with all nodes of its second factor turned by H (d, d), (k, k)."""
        k = len(self.M)
        return np.asarray((H.ravel() @ self.E.reshape(-1, k * k)).reshape(k, k))

    def spun(self, spin: Array) -> Array:
        """K + E((Omega x)^2): the stiffness that is left in a steady spin, (k, k)."""
        d = len(self.E)
        W = cross_matrix(spin)[:d, :d]
        return self.K + self.turned(W @ W)

    def bending(self) -> float:
        """Lowest frequency of the clamped tissue [rad/s]."""
        return float(np.sqrt(scipy.linalg.eigh(self.K, self.M, eigvals_only=True, subset_by_index=[0, 0])[0]))


class TurningSteps:
    """Steps of one run.

    Attributes:
        a: coordinates reached, (k,).
        Y: integrals int rho phi_i,k y_l, (d, d, k).
        drift: G'y, (n_s,).
        kinetic: int rho |y|^2 / 2 [J].
    """

    def __init__(self, small: TurningMatrices, dt: float, a: Array, rate: Array, spin: Array) -> None:
        self.small, self.dt, self.s, self.d = small, dt, 2 / dt, len(small.E)
        self.still = small.K + self.s * small.D + self.s**2 * small.M
        self.a, self.past = np.array(a), (np.zeros_like(a), np.zeros_like(a))
        W = self._matrix(spin)
        self.Y = self._pairs(rate, W, self.a)
        self.drift = small.G.T @ rate + self._turned_drift(W, self.a)
        self.kinetic = float(self._product(rate, W, self.a, self.Y)) / 2
        self.scale, self.inverse, self.iterations = 0.0, np.zeros((0, 0)), 0
        self.code: FreeStep | None = None

    def _matrix(self, spin: Array) -> Array:
        return cross_matrix(spin)[: self.d, : self.d]

    def _pairs(self, w: Array, H: Array, z: Array) -> Array:
        """Integrals int rho phi_i,k (w + H z)_l, (d, d, k)."""
        return np.asarray(self.small.E @ w + H @ (self.small.E @ z))

    def _turned_drift(self, H: Array, z: Array) -> Array:
        """G' of H z, (n_s,): int rho H z and int rho r x H z."""
        d, first = self.d, self.small.G[:, : self.d].T @ z
        V = H @ (self.small.S.T @ z).reshape(d, d)  # int rho (H z)_k r_l
        turn = [V[1, 0] - V[0, 1]] if d == 2 else [V[2, 1] - V[1, 2], V[0, 2] - V[2, 0], V[1, 0] - V[0, 1]]
        return np.concatenate([H @ first, turn])

    @staticmethod
    def _product(w: Array, H: Array, z: Array, Y: Array) -> float:
        """Integral int rho (w + H z) . y from the integrals of y."""
        return float(w @ np.trace(Y) + np.sum(H * (Y @ z).T))

    # ---- what is known of a state

    def row(self) -> Array:
        """Numbers of :class:`softgrasp.fem.frame.integrals.Sums`."""
        d, X = self.d, self.Y @ self.a  # int rho z_k y_l
        turn = [X[0, 1] - X[1, 0]] if d == 2 else [X[1, 2] - X[2, 1], X[2, 0] - X[0, 2], X[0, 1] - X[1, 0]]
        return np.concatenate([self.drift, self.small.G[:, :d].T @ self.a, self.small.S.T @ self.a, turn])

    def rate(self, spin: Array) -> Array:
        """Rates a' of the coordinates in the frame that turns with ``spin``, (k,)."""
        turned = self.small.turned(self._matrix(spin)) @ self.a
        return np.asarray(np.linalg.solve(self.small.M, np.trace(self.Y) - turned))

    def energy(self) -> float:
        """A'K a / 2 + int rho |y|^2 / 2 [J]."""
        return float(self.a @ self.small.K @ self.a) / 2 + self.kinetic

    # ---- steps

    def known(self, turn: Array, felt: Array, squared: Array) -> Array:
        """A step under a known hand, see :class:`softgrasp.fem.frame.path.PathSteps`; its load, (k,)."""
        load = -(self.small.G @ felt) - self.small.S @ squared.ravel()
        left, right = self._system(turn, load)
        self._advance(np.linalg.solve(left, right), turn)
        return np.asarray(load)

    def free(self, balance: HandBalance, hand: HandPlace, force: Array, guess: Array) -> Array:
        """A step of a hand under a force and what the tissue does to it; its mean velocity xi, (6,).

        The iteration solves with S - s^2 G M_ss^-1 G', the matrix of a step that does not turn.

        Args:
            balance: of the hand.
            hand: at the start of the step.
            force: force and torque in space, (6,).
            guess: where to begin, (6,).

        Raises SolverError: no convergence.
        """
        small, s, d = self.small, self.s, self.d
        if not self.inverse.size:
            inertia = balance.M[np.ix_(balance.free, balance.free)]
            self.inverse = np.linalg.inv(self.still - s * s * small.G @ np.linalg.solve(inertia, small.G.T))
            self.code = FreeStep.of(self, balance, MOST, TOL)
        sums, xi = Sums.of(self.row(), small.G.shape[1]), np.array(guess)
        w = 2 * self.past[0] - self.past[1]
        if self.code is not None:
            count = self.code.solve(
                w, xi, a=self.a, Y=self.Y, Q=hand.Q, start=hand.xi, before=sums.momenta(balance.M, hand.xi),
                drift=sums.drift, first=sums.first, B=sums.B, force=force,
            )  # fmt: skip
            if count >= 0:
                self._advance(w, xi[3:])
                self.iterations += count
                return xi
            w, xi = 2 * self.past[0] - self.past[1], np.array(guess)  # NumPy states the reason
        fallen, held = hand.Q.T @ balance.g, small.E @ self.a
        for count in range(MOST):
            xi = balance.velocity(hand, sums, self._travel(w, held), force, xi)
            spin, rate = cross_matrix(xi[3:]), s * (xi - hand.xi)
            rate[:3] += spin @ xi[:3] - fallen + self.dt / 2 * spin @ fallen
            load = -(small.G @ rate[balance.free]) - small.S @ (spin @ spin)[:d, :d].ravel()
            left, right = self._system(xi[3:], load)
            R = left @ w - right
            self.scale = max(self.scale, float(np.linalg.norm(right)))
            terms = np.abs(self.still) @ np.abs(w) + s * np.abs(small.G) @ (np.abs(xi) + np.abs(hand.xi))[balance.free]
            if np.linalg.norm(R) <= max(TOL * self.scale, ROUNDING * float(np.linalg.norm(terms))):
                self._advance(w, xi[3:])
                self.iterations += count
                return xi
            w = w - self.inverse @ R
            if not np.isfinite(w).all():
                break
        raise SolverError(
            f"the step of the reduced model does not converge, where the hand turns by "
            f"{self.dt * float(np.linalg.norm(xi[3:])):.2g} rad in it; use a shorter step"
        )

    def _travel(self, w: Array, held: Array) -> Travel:
        """What the tissue does in a step of w; ``held`` is E a."""
        small, d, end = self.small, self.d, self.a + 2 * w
        moved = small.E @ w
        X = (2 * self.s * moved - self.Y) @ end
        turning = np.array([0.0, 0.0, X[0, 1] - X[1, 0]])
        if d == 3:
            turning[:2] = X[1, 2] - X[2, 1], X[2, 0] - X[0, 2]
        C = (held + moved) @ end  # int rho z_1 (z + w)'
        return Travel(spatial(small.G.T @ w), square(small.S.T @ w, d), turning, square(C.ravel(), d))

    def _system(self, spin: Array, load: Array) -> tuple[Array, Array]:
        """Matrix and right-hand side of a step."""
        small, s = self.small, self.s
        H = self._matrix(spin) / s
        once, twice = small.turned(H), small.turned(H @ H)
        left = self.still + s * s * (2 * once + twice)
        held = small.K @ self.a + s * s * ((once + twice) @ self.a)
        return left, s * np.trace(self.Y) + load - held

    def _advance(self, w: Array, spin: Array) -> None:
        """Carry on by w."""
        H, s, middle = self._matrix(spin) / self.s, self.s, self.a + w
        U = self._pairs(w, H, middle)
        self.kinetic += 2 * s * (s * self._product(w, H, middle, U) - self._product(w, H, middle, self.Y))
        self.Y = 2 * s * U - self.Y
        self.drift = 2 * s * (self.small.G.T @ w + self._turned_drift(H, middle)) - self.drift
        self.a, self.past = self.a + 2 * w, (w, self.past[0])
