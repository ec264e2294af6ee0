"""One midpoint step of hand and tissue under feedback, with the factor of the open loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.target import Target

if TYPE_CHECKING:
    from softgrasp.lqr.loop.finite import FiniteDrive


class PlantStep:
    """What every gain shares: factor of S, responses Y = S^{-1} G and the hand seen through them.

    With x = S^{-1} h, c = kappa a + c_0, c_0 = alpha v - g and kappa = 1 + alpha dt/2 (alpha = 0 unless damping drags
    in space) the tissue moves by w = x - Y c in half a step, and the hand by

        L a = u + f,   L = M_hand [+ kappa (M_rigid - theta G'Y)],
        f = weight [- M_rigid c_0 - G'(theta (x - Y c_0) - s v_z)],   theta = s^2 + alpha s

    ([...] two-way only). No matrix of the closed loop is ever factored.

    ``midpoint``: factored step, before its start: its vectors are used as scratch.
    """

    def __init__(self, system: BlockSystem, midpoint: TissueMidpoint) -> None:
        self.system, self.midpoint = system, midpoint
        self.comm, self.dt, self.s = system.layout.comm, midpoint.dt, midpoint.s
        n_s = system.layout.n_s
        self.g = np.zeros(n_s) if system.gravity is None else system.gravity
        self.weight = system.M_hand @ self.g if system.hand_weight else np.zeros(n_s)
        self.alpha = system.damping.alpha if system.damping.in_space else 0.0
        self.kappa = 1 + self.alpha * self.dt / 2
        self.theta = self.s**2 + self.alpha * self.s
        self.Y = midpoint.make_responses()
        self.GY = np.zeros((n_s, n_s))
        self.L = system.M_hand
        if system.two_way:
            GY = total(self.comm, system.G.T @ self.Y)
            self.GY = (GY + GY.T) / 2
            self.L = system.M_hand + self.kappa * (system.M_rigid - self.theta * self.GY)
        self.inverse = np.linalg.inv(self.L)
        self.finite: FiniteDrive | None = None  # of a pushed hand that feels a tissue of finite strain


class LoopDrive:
    """Solves one step for hand and tissue; ``q``, ``v`` and ``u`` are the histories."""

    def __init__(self, plant: PlantStep, steps: int) -> None:
        self.plant, n_s = plant, plant.system.layout.n_s
        self.q, self.v, self.u = np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s)), np.zeros((steps, n_s))

    def solve(self, n: int, state: TissueState) -> None:
        """Leave w and load of step n in the midpoint; fill row n of u, row n + 1 of q and v. Collective."""
        raise NotImplementedError

    def move(self, n: int, u: Array, a: Array) -> None:
        """Midpoint rule of the hand."""
        dt = self.plant.dt
        self.u[n], self.v[n + 1] = u, self.v[n] + dt * a
        self.q[n + 1] = self.q[n] + dt * (self.v[n] + self.v[n + 1]) / 2

    def finish(self, n: int, u: Array, a: Array) -> None:
        """Turn S^{-1} h into w for the acceleration a, set load and right-hand side, move the hand."""
        self.plant.midpoint.accelerate(self.plant.kappa * a + self.plant.alpha * self.v[n] - self.plant.g)
        self.move(n, u, a)

    def push(self, n: int, u: Array, state: TissueState) -> None:
        """One step of hand and tissue under an input that is known before it. Collective."""
        plant, midpoint, system = self.plant, self.plant.midpoint, self.plant.system
        c_0 = plant.alpha * self.v[n] - plant.g
        if system.two_way and system.points is not None:
            if plant.finite is None:
                from softgrasp.lqr.loop.finite import FiniteDrive  # only plants of finite strain pay for it

                plant.finite = FiniteDrive(plant, None, None, None, 0)
            plant.finite.v = self.v
            self.move(n, u, plant.finite.respond(n, u, np.zeros(len(u), dtype=bool), state)[0])
            return
        if not system.two_way:
            a = plant.inverse @ (u + plant.weight)
            midpoint.solve_midpoint(-(plant.kappa * a + c_0))
            self.move(n, u, a)
            return
        x = midpoint.respond()
        relative = plant.theta * x - plant.s * state.array[system.layout.n_local :]
        pull = total(plant.comm, system.G.T @ relative) - plant.theta * (plant.GY @ c_0)
        self.finish(n, u, plant.inverse @ (u + plant.weight - system.M_rigid @ c_0 - pull))


class ImplicitDrive(LoopDrive):
    """u = clip(u_bar + K (x_mid - x_bar)), the law at the midpoint of every step.

    x_mid is [q + dt/2 v + dt^2/4 a, v + dt/2 a, z + w, s w], so with N = K_z + s K_v

        u = u_0 + F a,   F = dt^2/4 K_q + dt/2 K_v - kappa N'Y,
        u_0 = u_bar + K_q (q + dt/2 v - q_bar) + K_v v + K_z'(z - z_bar) + N'(x - Y c_0),

    and a = L^{-1} (u + f) leaves an equation of n_s unknowns: Sherman-Morrison-Woodbury with columns made once, one
    tissue solve and one small reduction a step.
    """

    def __init__(self, plant: PlantStep, gain: Gain, target: Target, bound: Array | None, steps: int) -> None:
        super().__init__(plant, steps)
        self.gain, n_s, dt = gain, plant.system.layout.n_s, plant.dt
        self.K_q, self.K_v = gain.K_s[:, :n_s], gain.K_s[:, n_s:]
        self.N = gain.K_z + plant.s * gain.K_v
        self.NY = total(plant.comm, self.N.T @ plant.Y)
        F = dt**2 / 4 * self.K_q + dt / 2 * self.K_v - plant.kappa * self.NY
        self.FL = F @ plant.inverse
        self.input = ImplicitInput(self.FL, bound)
        self.offset = target.u - self.K_q @ target.state.q_s - total(plant.comm, gain.K_z.T @ target.state.z)
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


class HeldDrive(LoopDrive):
    """u = clip(u_bar + K (x - x_bar)) sampled at the start of a tick and held, if asked for one tick later.

    ``target``: x_bar and u_bar; u_bar acts until the first command arrives.
    """

    def __init__(self, plant: PlantStep, gain: Gain, target: Target, actuation: Actuation, steps: int) -> None:
        super().__init__(plant, steps)
        self.gain, n_s = gain, plant.system.layout.n_s
        self.bound, self.every, self.delay = actuation.bound(n_s), actuation.ticks(plant.dt), actuation.delay
        self.K = np.vstack([gain.K_z, gain.K_v])
        state = target.state
        self.offset = target.u - gain.K_s[:, :n_s] @ state.q_s - total(plant.comm, gain.K_z.T @ state.z)
        self.held = self.waiting = self._clip(target.u)

    def _clip(self, u: Array) -> Array:
        return np.array(u) if self.bound is None else np.clip(u, -self.bound, self.bound)

    def command(self, n: int, state: TissueState) -> Array:
        """The input that the law asks for at step n. Collective."""
        tissue = total(self.plant.comm, self.K.T @ state.array)
        hand = self.gain.K_s @ np.concatenate([self.q[n], self.v[n]])
        return self._clip(self.offset + hand + tissue)

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective."""
        if n % self.every == 0:
            new = self.command(n, state)
            self.held, self.waiting = (self.waiting, new) if self.delay else (new, new)
        self.push(n, self.held, state)


class OpenDrive(LoopDrive):
    """Input that is given for every step. ``inputs``: u of each step [N, N m], (steps, n_s)."""

    def __init__(self, plant: PlantStep, inputs: Array) -> None:
        super().__init__(plant, len(inputs))
        self.u = inputs

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective."""
        self.push(n, self.u[n], state)
