"""One midpoint step of hand and tissue under feedback, with the factor of the open loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from typing import Any, cast

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.midpoint import Feedback, TissueState
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.target import Target


class LoopDrive(ABC):
    """Solves one step for hand and tissue.

    Attributes:
        plant: equation of the hand L a = u + f and its numbers dt, s, kappa, alpha, theta, g, Y, see `HandStep`.
        q: displacement of the hand at each time, (steps + 1, n_s) [m, rad].
        v: velocity of the hand at each time, (steps + 1, n_s) [m/s, rad/s].
        u: input of each step, (steps, n_s) [N, N m].
    """

    def __init__(self, plant: HandStep, steps: int) -> None:
        self.plant, n_s = plant, plant.system.layout.n_s
        self.q, self.v, self.u = np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s)), np.zeros((steps, n_s))

    @abstractmethod
    def solve(self, n: int, state: TissueState) -> None:
        """Leave w and load of step n in the midpoint; fill row n of u, row n + 1 of q and v. Collective."""

    def move(self, n: int, u: Array, a: Array) -> None:
        """Midpoint rule of the hand under the acceleration a (n_s,): row n of u, n + 1 of q and v."""
        dt = self.plant.dt
        self.u[n], self.v[n + 1] = u, self.v[n] + dt * a
        self.q[n + 1] = self.q[n] + dt * (self.v[n] + self.v[n + 1]) / 2

    def finish(self, n: int, u: Array, a: Array) -> None:
        """Turn S^{-1} h into w for the acceleration a, set load and right-hand side, move the hand."""
        self.plant.midpoint.accelerate(self.plant.kappa * a + self.plant.alpha * self.v[n] - self.plant.g)
        self.move(n, u, a)

    def push(self, n: int, u: Array, state: TissueState) -> None:
        """One step of hand and tissue under an input that is known before it. Collective."""
        self.move(n, u, self.plant.push(self.v[n], u, state))


class GainDrive(LoopDrive):
    """The input is u_bar + K (x - x_bar) = offset + K x, with or without limits. Making one is collective.

    Attributes:
        gain: K of hand and tissue, local rows.
        bound: largest |u| by degree of freedom, (n_s,) [N, N m]; None without limits.
        K_q: columns of K for the hand's displacement, (n_s, n_s).
        K_v: columns of K for the hand's velocity, (n_s, n_s).
        offset: u_bar - K x_bar, (n_s,).
    """

    def __init__(self, plant: HandStep, gain: Gain, target: Target, actuation: Actuation, steps: int) -> None:
        super().__init__(plant, steps)
        self.gain, n_s = gain, plant.system.layout.n_s
        self.bound = actuation.bound(n_s)
        self.K_q, self.K_v = gain.K_s[:, :n_s], gain.K_s[:, n_s:]
        rest = target.state
        self.offset = target.u - self.K_q @ rest.q_s - total(plant.comm, gain.K_z.T @ rest.z)


class ImplicitDrive(GainDrive):
    """u = clip(u_bar + K (x_mid - x_bar)), the law at the midpoint of every step.

    x_mid is [q + dt/2 v + dt^2/4 a, v + dt/2 a, z + w, s w], so with N = K_z + s K_v

        u = u_0 + F a,   F = dt^2/4 K_q + dt/2 K_v - kappa N'Y,
        u_0 = u_bar + K_q (q + dt/2 v - q_bar) + K_v v + K_z'(z - z_bar) + N'(x - Y c_0),

    and a = L^{-1} (u + f) leaves an equation of n_s unknowns: Sherman-Morrison-Woodbury with columns made once, one
    tissue solve and one small reduction a step.
    """

    def __init__(self, plant: HandStep, gain: Gain, target: Target, actuation: Actuation, steps: int) -> None:
        super().__init__(plant, gain, target, actuation, steps)
        n_s, dt = plant.system.layout.n_s, plant.dt
        self.N = gain.K_z + plant.s * gain.K_v
        self.NY = total(plant.comm, self.N.T @ plant.Y)
        F = dt**2 / 4 * self.K_q + dt / 2 * self.K_v - plant.kappa * self.NY
        self.FL = F @ plant.inverse
        self.input = ImplicitInput(self.FL, self.bound)
        self.sums = np.zeros(3 * n_s if plant.system.two_way else 2 * n_s)

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective."""
        plant, midpoint = self.plant, self.plant.midpoint
        system, q, v, n_s = plant.system, self.q[n], self.v[n], len(self.K_q)
        x, n_local = midpoint.respond(), system.layout.n_local
        sums = self.sums
        sums[:n_s] = self.gain.K_z.T @ state.array[:n_local]
        sums[n_s : 2 * n_s] = self.N.T @ x
        if system.two_way:
            sums[2 * n_s :] = system.G.T @ (plant.theta * x - plant.s * state.array[n_local:])
        sums = total(plant.comm, sums)
        c_0 = plant.alpha * v - plant.g
        f = plant.weight
        if system.two_way:
            f = f - system.M_rigid @ c_0 - sums[2 * n_s :] + plant.theta * (plant.GY @ c_0)
        u_0 = self.offset + self.K_q @ (q + plant.dt / 2 * v) + self.K_v @ v
        u_0 += sums[:n_s] + sums[n_s : 2 * n_s] - self.NY @ c_0 + self.FL @ f
        u = self.input.solve(u_0)
        self.finish(n, u, plant.inverse @ (u + f))

    def law(self, n: int, state: TissueState) -> Array:
        """clip(u_bar + K (x_mid - x_bar)) of the step that the midpoint and row n + 1 of q and v have. Collective."""
        n_local = self.plant.system.layout.n_local
        sums = self.gain.K_z.T @ state.array[:n_local] + self.N.T @ self.plant.midpoint.owned()
        q, v = (self.q[n] + self.q[n + 1]) / 2, (self.v[n] + self.v[n + 1]) / 2
        u = np.asarray(self.offset + self.K_q @ q + self.K_v @ v + total(self.plant.comm, sums))
        return u if self.bound is None else np.clip(u, -self.bound, self.bound)


class HeldDrive(GainDrive):
    """u = clip(u_bar + K (x - x_bar)) sampled at the start of a tick and held, with a delay some ticks later.

    ``target``: x_bar and u_bar; u_bar acts until the first command arrives.
    """

    def __init__(self, plant: HandStep, gain: Gain, target: Target, actuation: Actuation, steps: int) -> None:
        super().__init__(plant, gain, target, actuation, steps)
        self.every = actuation.ticks(plant.dt)
        self.K = np.vstack([gain.K_z, gain.K_v])
        self.waiting = deque([self._clip(target.u)] * (actuation.delay + 1), actuation.delay + 1)

    def _clip(self, u: Array) -> Array:
        return np.array(u) if self.bound is None else np.clip(u, -self.bound, self.bound)

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective."""
        if n % self.every == 0:
            tissue = total(self.plant.comm, self.K.T @ state.array)
            hand = self.gain.K_s @ np.concatenate([self.q[n], self.v[n]])
            self.waiting.append(self._clip(self.offset + hand + tissue))
        self.push(n, self.waiting[0], state)


class OpenDrive(LoopDrive):
    """Input that is given for every step. ``inputs``: u of each step [N, N m], (steps, n_s)."""

    def __init__(self, plant: HandStep, inputs: Array) -> None:
        super().__init__(plant, len(inputs))
        self.u = inputs

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective."""
        self.push(n, self.u[n], state)


class FiniteStep:
    """The step of a plant of finite strain: the law becomes part of the equation of the tissue.

    With w = z_mid - z_n, p = [K_z'w; s K_v'w; G'w], N'w the sum of the first two and F = dt^2/4 K_q + dt/2 K_v the law
    at the midpoint is

        u = u_bar + K_q (q + dt/2 v - q_bar) + K_v v + K_z'(z - z_bar) + F a + N'w,

    and the hand's equation (M_hand [+ kappa M_rigid] - F) a = .. + N'w [- theta G'w] turns the load -G c of the tissue,
    c = kappa a + c_0, into G (c_1 + C p). Making one is collective.
    """

    def __init__(self, plant: HandStep, gain: Gain) -> None:
        system, dt, n_s = plant.system, plant.dt, plant.system.layout.n_s
        self.plant, self.midpoint = plant, cast(Any, plant.midpoint)  # that of finite strain
        self.inertia = system.M_hand + (plant.kappa * system.M_rigid if system.two_way else 0.0)
        self.F = dt**2 / 4 * gain.K_s[:, :n_s] + dt / 2 * gain.K_s[:, n_s:]
        self.N = self.midpoint.hold(np.hstack([gain.K_z, plant.s * gain.K_v, system.G]))
        self.speed = np.repeat([0.0, 1.0, plant.s**2 / plant.theta], n_s)

    def respond(self, v: Array, known: Array, free: Array, state: TissueState) -> tuple[Array, Array]:
        """The step with u = known, where ``free`` with the part F a + N'w of the law; a and the law. Collective."""
        plant, system, n_s = self.plant, self.plant.system, len(known)
        c_0 = plant.alpha * v - plant.g
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


class FiniteDrive(GainDrive):
    """u = clip(u_bar + K (x_mid - x_bar)) on a plant of finite strain.

    Inputs beyond their limits are fixed there, and the step is solved once more.
    """

    def __init__(self, plant: HandStep, gain: Gain, target: Target, actuation: Actuation, steps: int) -> None:
        super().__init__(plant, gain, target, actuation, steps)
        self.step = FiniteStep(plant, gain)
        self.limit = np.full(len(self.offset), np.inf) if self.bound is None else self.bound

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective."""
        layout, q, v = self.plant.system.layout, self.q[n], self.v[n]
        tissue = total(self.plant.comm, self.gain.K_z.T @ state.array[: layout.n_local])
        known = self.offset + self.K_q @ (q + self.plant.dt / 2 * v) + self.K_v @ v + tissue
        free = np.ones(layout.n_s, dtype=bool)
        while True:
            a, law = self.step.respond(v, known, free, state)
            over_limit = free & (np.abs(law) > self.limit)
            if not over_limit.any():
                break
            free &= ~over_limit
            known[over_limit] = (np.sign(law) * self.limit)[over_limit]
        self.move(n, np.where(free, law, known), a)
