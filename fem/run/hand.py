"""The equation of the hand in one step of hand and tissue, with the tissue seen through its responses S^{-1} G."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.inexact import InexactMidpoint
from softgrasp.fem.run.midpoint import Feedback, TissueMidpoint, TissueState
from softgrasp.fem.system import BlockSystem


class HandStep:
    """One step under a force u that is known before it; forward runs and closed loops share it.

    With x = S^{-1} h, Y = S^{-1} G, c = kappa a + c_0, c_0 = alpha v - g and kappa = 1 + alpha dt/2 (alpha = 0 unless
    damping drags in space) the tissue moves by w = x - Y c in half a step, and the hand by

        L a = u + f,   L = M_hand [+ kappa (M_rigid - theta G'Y)],
        f = weight [- M_rigid c_0 - G'(theta (x - Y c_0) - s v_z)],   theta = s^2 + alpha s

    ([...] two-way only). With finite strain w is no linear function of c; the hand's equation
    M_hand a + M_rigid c = u + weight - G'(theta w - s v_z) then turns the load of the tissue into
    -G c = G (c_1 + C G'w) with C = kappa theta (M_hand + kappa M_rigid)^-1, and the tissue's step is solved under it.

    Making one is collective.

    Args:
        midpoint: factored step, before its start: its vectors are used as scratch.
        responses: make Y of a one-way hand too.
    """

    def __init__(self, system: BlockSystem, midpoint: TissueMidpoint, responses: bool = False) -> None:
        self.system, self.midpoint, self.comm = system, midpoint, system.layout.comm
        self.dt, self.s = midpoint.dt, midpoint.s
        self.g, self.alpha = system.fall, system.damping.drag
        self.weight = system.weight + (system.own_wrench if system.two_way else 0.0)
        self.kappa = 1 + self.alpha * self.dt / 2
        self.theta = self.s**2 + self.alpha * self.s
        self.inexact = midpoint if isinstance(midpoint, InexactMidpoint) else None
        self.GY, L = np.zeros(system.M_hand.shape), system.M_hand
        finite = system.two_way and system.points is not None
        if system.two_way or responses:
            self.Y = midpoint.make_responses()  # which the midpoint keeps: corrections of finite strain need it
        if system.two_way:
            GY = total(self.comm, system.G.T @ self.Y)
            self.GY = GY if self.inexact else (GY + GY.T) / 2
            L = system.M_hand + self.kappa * (system.M_rigid - (0.0 if finite else self.theta * self.GY))
        self.inverse = np.linalg.inv(L)
        # chosen once, not in every step
        two_way = self._inexact if self.inexact else self._two_way
        self.push = self._finite if finite else two_way if system.two_way else self._one_way

    def _one_way(self, v: Array, u: Array, state: TissueState) -> Array:
        """Solve the tissue under u (n_s,) and the velocity v of the hand; its acceleration. Collective."""
        a = self.inverse @ (u + self.weight)
        self.midpoint.solve_midpoint(-(self.kappa * a + self.alpha * v - self.g))
        return np.asarray(a)

    def _two_way(self, v: Array, u: Array, state: TissueState) -> Array:
        """One solve and one small reduction. Collective."""
        system, c_0 = self.system, self.alpha * v - self.g
        relative = self.theta * self.midpoint.respond() - self.s * state.array[system.layout.n_local :]
        pull = total(self.comm, system.G.T @ relative) - self.theta * (self.GY @ c_0)
        a = self.inverse @ (u + self.weight - system.M_rigid @ c_0 - pull)
        self.midpoint.accelerate(self.kappa * a + c_0)
        return np.asarray(a)

    def feel_before(self) -> None:
        """Let a two-way hand feel the tissue by G'S^-1 h = Y'h, before the solve, which may then end later."""
        self.push = self._two_way_before

    def _two_way_before(self, v: Array, u: Array, state: TissueState) -> Array:
        """As `_two_way`, where every rank has all rows. Collective."""
        system, midpoint, c_0 = self.system, self.midpoint, self.alpha * v - self.g
        pull = self.theta * (midpoint.Y.T @ midpoint.r_array + self.GY @ (midpoint.pending - c_0))
        pull -= self.s * total(self.comm, system.G.T @ state.array[system.layout.n_local :])
        a = self.inverse @ (u + self.weight - system.M_rigid @ c_0 - pull)
        midpoint.solve_midpoint(-(self.kappa * a + c_0))
        return np.asarray(a)

    def _inexact(self, v: Array, u: Array, state: TissueState) -> Array:
        """As `_two_way`, where w is scaled so that its residual does no work. Collective."""
        system, c_0 = self.system, self.alpha * v - self.g
        assert self.inexact is not None
        known = np.column_stack([self.inexact.respond(), state.array[system.layout.n_local :]])
        pull, momentum = total(self.comm, system.G.T @ known).T
        return self.inexact.push_hand(
            system.M_hand + self.kappa * system.M_rigid,
            self.kappa * self.theta * self.GY,
            u + self.weight - system.M_rigid @ c_0 + self.s * momentum,
            self.theta * (pull - self.GY @ c_0),
            self.kappa,
            c_0,
        )

    def _finite(self, v: Array, u: Array, state: TissueState) -> Array:
        """The hand's equation is part of the tissue's. Collective."""
        system, midpoint, c_0 = self.system, self.midpoint, self.alpha * v - self.g
        pull = -self.s * total(self.comm, system.G.T @ state.array[system.layout.n_local :])
        a = self.inverse @ (u + self.weight - system.M_rigid @ c_0 - pull)
        feedback = Feedback(self.kappa * self.theta * self.inverse, midpoint.G, np.array(self.s**2 / self.theta))
        midpoint.solve_midpoint(-(self.kappa * a + c_0), feedback)
        return np.asarray(-(midpoint.c + c_0) / self.kappa)
