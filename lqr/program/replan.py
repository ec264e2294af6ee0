"""Plans again at every interval from what is known of the state, around a nominal plan that is always there.

    u = u_nom + K (x^ - x_nom),    x_nom: what the controller's own plant does under u_nom

At the first tick of an interval the program is solved from the estimate x^, warm-started by the shifted active set. Its
plan is taken where it is certain to keep all gaps and limits for ever; x_nom is then x^. Where there is none, the last
plan goes on: shifted by an interval, with c = 0 behind it, it keeps every row again, and noise cannot take that away
(recursive feasibility). Only where x^ has left the tube about x_nom, which noise does not do, a plan from x^ is taken
that is not certain: gaps have exact l1 prices, so that it keeps them where it can, and the limits of the hand.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.program.least_distance import InfeasibleError
from softgrasp.lqr.program.program import Program


class Outcome(IntEnum):
    """What an interval began with."""

    NEW = 0
    """A plan from the estimate that keeps everything."""
    KEPT = 1
    """The last plan, shifted."""
    SOFT = 2
    """A plan from an estimate outside the tube that may give up gaps, nothing is certain of it."""


@dataclass(frozen=True)
class Replanned:
    """How one interval began."""

    outcome: Outcome
    """Which plan it follows."""
    reason: str
    """Why no plan from the estimate was adopted; empty where one was."""
    depth: float
    """How far inside clearance and margin the plan goes [m]."""
    steps: int
    """Changes of the active set in all programs."""
    seconds: float
    """Time of the programs and of their judgement [s]."""


class Replanner:
    """What a planned controller carries from tick to tick.

    Args:
        program: rows, plant and first plan.
        gain: of the controller, (n_s, N).
        x_bar: state of the controller at the target, (N,).
        u_bar: steady input there, (n_s,).
        again: whether plans are made again; else the first one is followed.
    """

    def __init__(self, program: Program, gain: Array, x_bar: Array, u_bar: Array, again: bool = True) -> None:
        self.program, self.gain, self.x_bar, self.u_bar, self.again = program, gain, x_bar, u_bar, again
        self.x, self.c, self.nominal = program.start, program.c, program.rest
        self.active: tuple[int, ...] = ()
        self.planned = u_bar
        self.tick = 0
        self.log: list[Replanned] = []

    def command(self, estimate: Array) -> Array:
        """Load of a tick for the state x^ (N,), before the limits, (n_s,)."""
        program, (interval, begun) = self.program, divmod(self.tick, self.program.every)
        if begun == 0:
            self.begin(interval, estimate)
        u = self.planned + self.gain @ (estimate - self.nominal)
        self.nominal = program.A @ self.nominal + program.B @ self.planned + program.f
        self.tick += 1
        return np.asarray(u)

    def begin(self, interval: int, estimate: Array) -> None:
        """Choose the plan of an interval, its input, and go on to the state at its end."""
        if self.again:
            self.log.append(self._replan(interval, estimate))
        program = self.program
        self.planned = self.u_bar + program.K @ self.x + program.L @ self.c[0]
        self.x = program.F @ self.x + program.D @ self.c[0]
        self.c = np.vstack([self.c[1:], np.zeros(program.n_s)])

    def state_of(self, estimate: Array) -> Array:
        """State of the plan's plant where the controller has x^; the last input stays that of the plan."""
        program = self.program
        x = program.T @ (estimate - self.x_bar)
        if len(x) < len(self.x):  # with the input of the interval before
            x = np.concatenate([x, self.x[len(x) :]])
        return np.asarray(x)

    def _replan(self, interval: int, estimate: Array) -> Replanned:
        """Choose the plan of an interval."""
        program, begin, steps = self.program, time.perf_counter(), 0
        x = self.state_of(estimate)
        left = program.T @ (estimate - self.nominal)
        off = np.abs(program.seen[:, : len(left)] @ left)
        gone = len(program.rows(interval))
        warm = self.active
        self.active = tuple(i - gone for i in warm if i >= gone)
        if not np.isfinite(estimate).all():
            return Replanned(Outcome.KEPT, "the estimate is not finite", 0.0, 0, time.perf_counter() - begin)
        try:
            c, active, steps = program.solve(interval, x, warm)
            self.active = tuple(i - gone for i in active if i >= gone)
            reason = program.judge(interval, x, c)
            if not reason:
                self.x, self.c, self.nominal = x, c, estimate
                return Replanned(Outcome.NEW, "", 0.0, steps, time.perf_counter() - begin)
        except InfeasibleError:
            reason = "no plan from the estimate keeps all rows"
        except ControlError as error:
            reason = str(error)
        depth, outcome = 0.0, Outcome.KEPT
        if (off > program.tube).any():
            try:
                c, depth, more = program.solve_soft(interval, x)
                steps += more
                self.x, self.c, self.nominal, outcome = x, c, estimate, Outcome.SOFT
            except ControlError:  # InfeasibleError too: the limits of the hand are not kept
                reason += ", and none keeps the limits of the hand"
        return Replanned(outcome, reason, depth, steps, time.perf_counter() - begin)
