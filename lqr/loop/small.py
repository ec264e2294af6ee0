"""A small plant under feedback: the same midpoint rule, the same actuation, dense matrices in numpy."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.loop.cost import accumulated_cost
from softgrasp.lqr.loop.small_plant import SmallPlant
from softgrasp.lqr.plant.checks import ControlError


@dataclass(frozen=True)
class ReducedLoopTrajectory:
    """What a reduced run returns."""

    times: Array  # grid [s], (steps + 1,)
    states: Array  # (steps + 1, N)
    q_s: Array  # hand, (steps + 1, n_s)
    inputs: Array  # u of each step [N, N m], (steps, n_s)
    outputs: Array  # (steps + 1, p)
    cost: Array  # J up to each grid point, (steps + 1,)
    saturated: float  # share of the steps in which an input sat at its limit
    seconds: dict[str, float] = field(default_factory=dict)  # prepare, steps


class ReducedLoop:
    """E x' = A x + B u + f with u = u_bar + K (x - x_bar), implicit midpoint.

    x_mid = P x_n + Y u + b with P = S^{-1} E, Y = dt/2 S^{-1} B, b = dt/2 S^{-1} f, S = E - dt/2 A, and
    x_{n+1} = 2 x_mid - x_n; at the midpoint u = u_0 + K Y u is solved for the few inputs. Not collective: every rank
    may run its own. Raises ControlError: dt is not positive, or E - dt/2 A is singular.
    """

    def __init__(self, plant: SmallPlant, dt: float) -> None:
        if not (np.isfinite(dt) and dt > 0):
            raise ControlError(f"dt = {dt} s must be a positive number")
        self.plant, self.dt = plant, dt
        self.seconds = time.perf_counter()
        try:
            columns = np.linalg.solve(
                plant.E - dt / 2 * plant.A,
                np.hstack([plant.E, dt / 2 * plant.B, dt / 2 * plant.f[:, None]]),
            )
        except np.linalg.LinAlgError as error:
            raise ControlError(f"E - dt/2 A of the reduced plant is singular for dt = {dt:g} s") from error
        self.P, self.Y, self.b = columns[:, : plant.N], columns[:, plant.N : -1], columns[:, -1]
        self.seconds = time.perf_counter() - self.seconds

    def run(
        self,
        K: Array,
        rest: tuple[Array, Array],
        steps: int,
        weights: tuple[Array, Array],
        actuation: Actuation | None = None,
        start: Array | None = None,
    ) -> ReducedLoopTrajectory:
        """Run for some steps.

        Args:
            K: gain, (n_s, N).
            rest: x_bar and u_bar, see :meth:`SmallPlant.rest_at`.
            weights: Q and R of the cost.
            start: x(0), default the state of rest with the hand at 0.

        Raises:
            ControlError: gain or actuation do not fit the plant.
            SolverError: the loop diverged.
        """
        plant, actuation = self.plant, actuation or Actuation()
        n_s = plant.B.shape[1]
        if K.shape != (n_s, plant.N):
            raise ControlError(f"the gain has the shape {K.shape}; this plant needs ({n_s}, {plant.N})")
        begin = time.perf_counter()
        x_bar, u_bar = rest
        x = plant.rest_at(np.zeros(n_s))[0] if start is None else np.asarray(start, dtype=np.float64)
        bound, every = actuation.bound(n_s), actuation.ticks(self.dt)
        states, inputs = np.empty((steps + 1, plant.N)), np.empty((steps, n_s))
        states[0] = x
        offset = u_bar - K @ x_bar
        with np.errstate(over="ignore", invalid="ignore"):  # a loop that diverges is reported below
            if every:
                self._held(states, inputs, K, offset, u_bar, actuation)
            elif bound is None:
                self._affine(states, inputs, K, offset)
            else:
                self._limited(states, inputs, K, offset, bound)
        bad = ~(np.abs(states).max(axis=1) < 1e100)  # far above any state of use
        if bad.any():
            raise SolverError(
                f"the reduced closed loop diverged before t = {self.dt * int(np.argmax(bad)):.6g} s; this gain does "
                "not stabilise the plant at this rate, delay and limit"
            )
        outputs = states @ plant.C.T
        saturated = 0.0 if bound is None else float((np.abs(inputs) >= bound).any(axis=1).mean())
        cost = accumulated_cost(outputs - plant.C @ x_bar, inputs - u_bar, *weights, self.dt)
        return ReducedLoopTrajectory(
            times=np.asarray(self.dt * np.arange(steps + 1), dtype=np.float64),
            states=states,
            q_s=states @ plant.S_q.T,
            inputs=inputs,
            outputs=outputs,
            cost=cost,
            saturated=saturated,
            seconds={"prepare": self.seconds, "steps": time.perf_counter() - begin},
        )

    def _affine(self, states: Array, inputs: Array, K: Array, offset: Array) -> None:
        """Without limits a step is one product with a small matrix."""
        law = ImplicitInput(K @ self.Y, None)
        L, c = law.inverse @ (K @ self.P), law.inverse @ (offset + K @ self.b)
        step, shift = 2 * (self.P + self.Y @ L), 2 * (self.b + self.Y @ c)
        step[np.diag_indices(len(step))] -= 1.0
        for n in range(len(inputs)):
            states[n + 1] = step @ states[n] + shift
        inputs[:] = states[:-1] @ L.T + c

    def _limited(self, states: Array, inputs: Array, K: Array, offset: Array, bound: Array) -> None:
        law = ImplicitInput(K @ self.Y, bound)
        for n in range(len(inputs)):
            free = self.P @ states[n] + self.b
            inputs[n] = law.solve(offset + K @ free)
            states[n + 1] = 2 * (free + self.Y @ inputs[n]) - states[n]

    def _held(self, states: Array, inputs: Array, K: Array, offset: Array, u_bar: Array, actuation: Actuation) -> None:
        bound, every = actuation.bound(len(u_bar)), actuation.ticks(self.dt)
        limit = np.full(len(u_bar), np.inf) if bound is None else bound
        held = waiting = np.clip(u_bar, -limit, limit)
        step, shift = 2 * self.P - np.eye(len(self.P)), 2 * self.b
        drive = shift + 2 * self.Y @ held
        for n in range(len(inputs)):
            if n % every == 0:
                new = np.clip(offset + K @ states[n], -limit, limit)
                held, waiting = (waiting, new) if actuation.delay else (new, new)
                drive = shift + 2 * self.Y @ held
            inputs[n] = held
            states[n + 1] = step @ states[n] + drive
