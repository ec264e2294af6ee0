"""Feedback on a plant of finite strain: the law becomes part of the equation of the tissue's step.

With w = z_mid - z_n, p = [K_z'w; s K_v'w; G'w], N'w the sum of the first two and F = dt^2/4 K_q + dt/2 K_v the law at
the midpoint is

    u = u_bar + K_q (q + dt/2 v - q_bar) + K_v v + K_z'(z - z_bar) + F a + N'w,

and the hand's equation (M_hand [+ kappa M_rigid] - F) a = .. + N'w [- theta G'w] turns the load -G c of the tissue, c =
kappa a + c_0, into G (c_1 + C p). Inputs beyond their limits are fixed there, and the step is solved once more.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.midpoint import Feedback, TissueState
from softgrasp.lqr.loop.drive import LoopDrive, PlantStep
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.target import Target


class FiniteDrive(LoopDrive):
    """u = clip(u_bar + K (x_mid - x_bar)) on a plant of finite strain."""

    def __init__(
        self, plant: PlantStep, gain: Gain | None, target: Target | None, bound: Array | None, steps: int
    ) -> None:
        super().__init__(plant, steps)
        system, dt, n_s = plant.system, plant.dt, plant.system.layout.n_s
        self.gain, self.bound = gain, bound
        self.midpoint = cast(Any, plant.midpoint)  # that of finite strain
        self.inertia = system.M_hand + (plant.kappa * system.M_rigid if system.two_way else 0.0)
        K_z = K_v = np.zeros_like(system.G)
        self.offset, self.F = np.zeros(n_s), np.zeros((n_s, n_s))
        if gain is not None and target is not None:
            self.K_q, self.K_v, K_z, K_v = gain.K_s[:, :n_s], gain.K_s[:, n_s:], gain.K_z, plant.s * gain.K_v
            self.F = dt**2 / 4 * self.K_q + dt / 2 * self.K_v
            self.offset = target.u - self.K_q @ target.state.q_s - total(plant.comm, gain.K_z.T @ target.state.z)
        self.N = self.midpoint.hold(np.hstack([K_z, K_v, system.G]))
        self.speed = np.repeat([0.0, 1.0, plant.s**2 / plant.theta], n_s)

    def solve(self, n: int, state: TissueState) -> None:
        """One step under the law. Collective."""
        assert self.gain is not None
        layout = self.plant.system.layout
        tissue = total(self.plant.comm, self.gain.K_z.T @ state.array[: layout.n_local])
        known = self.offset + self.K_q @ (self.q[n] + self.plant.dt / 2 * self.v[n]) + self.K_v @ self.v[n] + tissue
        free = np.ones(layout.n_s, dtype=bool)
        while True:
            a, law = self.respond(n, known, free, state)
            over_limit = free & (np.abs(law) > (np.inf if self.bound is None else self.bound))
            if not over_limit.any():
                break
            assert self.bound is not None
            free &= ~over_limit
            known[over_limit] = (np.sign(law) * self.bound)[over_limit]
        self.move(n, np.where(free, law, known), a)

    def respond(self, n: int, known: Array, free: Array, state: TissueState) -> tuple[Array, Array]:
        """The step with u = known, where ``free`` with the part F a + N'w of the law; a and the law. Collective."""
        plant, system, n_s = self.plant, self.plant.system, len(known)
        c_0 = plant.alpha * self.v[n] - plant.g
        right, C = known + plant.weight, np.zeros((n_s, 3 * n_s))
        C[:, :n_s] = C[:, n_s : 2 * n_s] = np.diag(free)
        if system.two_way:
            right = right - system.M_rigid @ c_0
            right += plant.s * total(plant.comm, system.G.T @ state.array[system.layout.n_local :])
            C[:, 2 * n_s :] = -plant.theta * np.eye(n_s)
        inverse = np.linalg.inv(self.inertia - free[:, None] * self.F)
        feedback = Feedback(-plant.kappa * inverse @ C, self.N, self.speed)
        self.midpoint.solve_midpoint(-(plant.kappa * inverse @ right + c_0), feedback)
        a = -(self.midpoint.c + c_0) / plant.kappa
        return a, known + self.F @ a + self.midpoint.sensed[:n_s] + self.midpoint.sensed[n_s : 2 * n_s]
