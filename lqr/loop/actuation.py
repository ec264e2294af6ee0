"""What lies between the control law and the hand: sampling, delay and limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.checks import ControlError


@dataclass(frozen=True)
class Actuation:
    """How u = u_bar + K (x - x_bar) reaches the hand."""

    rate: float | None = None
    """Samples per second, each held for one tick (a robot: 1000) [Hz]; None: continuous feedback, at the midpoints."""
    delay: int = 0
    """Ticks from a sample to its load, with u_bar before the first one; needs ``rate``."""
    limits: float | tuple[float, ...] | None = None
    """Bound on |u_i|, one number or one per input, inf for none of one [N, N m]; None for none."""

    def bound(self, inputs: int) -> Array | None:
        """Limits as an array (inputs,), or None.

        Raises ControlError: a limit is not positive, or their number does not fit.
        """
        if self.limits is None:
            return None
        given = np.atleast_1d(np.asarray(self.limits, dtype=np.float64))
        if len(given) not in (1, inputs) or not (given > 0).all():
            raise ControlError(f"limits = {self.limits} must be one positive number, or {inputs}, one per input")
        return np.broadcast_to(given, (inputs,)).copy()

    def saturated(self, inputs: Array) -> float:
        """Share of the steps in which one of the inputs, (steps, inputs), sits at its limit."""
        bound = self.bound(inputs.shape[1])
        return 0.0 if bound is None else float((np.abs(inputs) >= bound).any(axis=1).mean())

    def ticks(self, dt: float) -> int:
        """Steps of length dt in one tick; 0 for continuous feedback.

        Raises ControlError: the tick is no multiple of dt, the rate is not positive, or a delay has no rate.
        """
        if self.rate is None:
            if self.delay:
                raise ControlError(f"delay = {self.delay} needs a rate: continuous feedback has no tick to wait for")
            return 0
        if self.delay < 0:
            raise ControlError(f"delay = {self.delay} ticks must be 0 or more")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise ControlError(f"rate = {self.rate} Hz must be a positive number")
        ratio = 1.0 / (self.rate * dt)
        count = round(ratio)
        if count < 1 or abs(ratio - count) > 1e-6 * count:  # rounding of end / steps is far below
            fitting = 1.0 / (self.rate * max(1, int(np.ceil(ratio - 1e-6))))
            raise ControlError(
                f"rate = {self.rate:g} Hz means ticks of {1 / self.rate:g} s, which is no multiple of the time step "
                f"{dt:g} s; multiply time.steps by {dt / fitting:.6g}, to steps of {fitting:g} s, for example"
            )
        return count


class ImplicitInput:
    """Solve u = clip(u_0 + H u) for the input that is constant within a step.

    H is what one step turns a unit of input into, seen through the gain at the midpoint (SMW form of the implicit
    feedback). An input at its limit is fixed there, the others stay implicit: a linear complementarity problem between
    bounds for a few unknowns, whose solution is unique where I - H is a P-matrix (feedback that dissipates energy).
    Block pivoting [JP94]: all wrong inputs change sides together, after a few rounds only the last one, which ends.
    """

    max_iterations = 1000
    together = 5  # rounds in which all wrong inputs may change sides

    def __init__(self, H: Array, bound: Array | None) -> None:
        self.H, self.bound = H, bound
        self.one = np.eye(len(H))
        condition = np.linalg.cond(self.one - H)
        if not condition < 1e12:  # beyond, the input of a step would carry fewer than four digits
            raise ControlError(
                f"the implicit feedback of one step is singular (condition {condition:.1e}); use a smaller time step"
            )
        self.inverse = np.linalg.inv(self.one - H)

    def solve(self, u_0: Array) -> Array:
        """The input of the step, (inputs,). Raises SolverError: the set of saturated inputs does not settle."""
        u = self.inverse @ u_0
        if self.bound is None or (np.abs(u) <= self.bound).all():
            return np.asarray(u)
        side = np.zeros(len(u))
        for k in range(self.max_iterations):
            free = side == 0
            wish = u_0 + self.H @ u
            # a fixed input is released first: it goes to the other side, if at all, in another round
            goal = np.where(free, np.where(np.abs(u) > self.bound, np.sign(u), 0.0), side)
            goal = np.where(~free & (side * wish < self.bound), 0.0, goal)
            wrong = np.flatnonzero(goal != side)
            if not len(wrong):
                return np.asarray(np.clip(u, -self.bound, self.bound))
            change = wrong if k < self.together else wrong[-1:]
            side[change] = goal[change]
            u = self._fixed(u_0, side)
        raise SolverError(
            f"the saturated inputs did not settle in {self.max_iterations} rounds; use a smaller time step"
        )

    def _fixed(self, u_0: Array, side: Array) -> Array:
        """Inputs with side +-1 at their limits, the others from u = u_0 + H u."""
        free = side == 0
        u = np.zeros(len(side))
        if self.bound is not None:
            u[~free] = side[~free] * self.bound[~free]
        if free.any():
            right = u_0[free] + self.H[np.ix_(free, ~free)] @ u[~free]
            u[free] = np.linalg.solve((self.one - self.H)[np.ix_(free, free)], right)
        return u
