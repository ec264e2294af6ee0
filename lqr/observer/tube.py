"""Feedback around a plan: the plan runs from its own nominal state, the optimal gain keeps the plant near to it.

    u = u_nom + K (x^ - x_nom),    x_nom: what the filter's own plant does under u_nom

Noise and disturbances never enter the plan, so that they cannot take its feasibility away: behind the horizon u_nom is
that of the gain of the grid, which the plan has followed to its safe end. What the plant deviates from its way under
u_nom has the covariance of the loop with observer, wherever the plan leads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.plan import Plan
from softgrasp.lqr.constrained.tissue import ModalTissue
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.loop.filter import Estimate
from softgrasp.lqr.observer.judge import Judged, Ticks
from softgrasp.lqr.plant.checks import ControlError

ROUNDING = 1e-15  # of the largest entry of a tick's matrix
CUT = 3.0  # standard deviations at which noise and disturbances of a run are cut


@dataclass(frozen=True)
class Tube:
    """A plan and the feedback around it."""

    controller: Controller  # optimal gain, filter and limits
    inputs: Array  # u_nom of every interval of the horizon [N], (H, n_s)
    end: Array  # state of the plan's plant at the end of the horizon, from the target, (k,)
    closed: Array  # the state an interval later under its gain, (k, k)
    K: Array  # gain of the grid, (n_s, k)
    start: Array  # x_nom at t = 0, (N,)
    each: int  # ticks of an interval


def make_tube(plan: Plan, controller: Controller) -> Tube:
    """The tube of a plan. Raises ControlError: an interval is no multiple of the tick, or there is no observer."""
    plant, task = plan.horizon.plant, plan.task
    each = round(plant.grid / controller.period)
    if controller.observer is None or abs(each * controller.period - plant.grid) > 1e-9 * plant.grid:
        raise ControlError(
            f"control.constraints.grid = {plant.grid:g} s must be a multiple of the tick of {controller.period:g} s of "
            "a loop with observer"
        )
    start = controller.x_bar.copy()
    start[: plant.n_s] += task.start[: plant.n_s]
    end = plan.horizon.state(task.start, plan.c)[-1, -1]
    return Tube(controller, plan.inputs, end, plant.closed, plant.K, start, each)


class TubeRun:
    """What the tube of a plan carries from tick to tick."""

    def __init__(self, tube: Tube) -> None:
        own = tube.controller.observer
        assert own is not None
        self.tube, self.filter, self.tick = tube, own, 0
        self.nominal, self.behind = tube.start, tube.end
        self.estimate = Estimate(own, tube.start)
        limits = tube.controller.limits
        self.limits = np.full(len(tube.K), np.inf) if limits is None else limits

    def step(self, q_s: Array, v_s: Array, y: Array | None = None) -> Array:
        """One tick: the load [N, N m] from the samples, see :meth:`softgrasp.lqr.loop.controller.Controller.step`."""
        tube, (interval, begun) = self.tube, divmod(self.tick, self.tube.each)
        if interval < len(tube.inputs):
            planned = tube.inputs[interval]
        else:
            if begun == 0 and interval > len(tube.inputs):
                self.behind = tube.closed @ self.behind
            planned = tube.controller.u_bar + tube.K @ self.behind
        off = self.estimate.correct(q_s, v_s, y) - self.nominal
        u: Array = np.clip(planned + tube.controller.K @ off, -self.limits, self.limits)
        self.estimate.apply(u)
        self.nominal = self.filter.A @ self.nominal + self.filter.B @ planned + self.filter.f
        self.tick += 1
        return u


def node_rows(tissue: ModalTissue, n_s: int) -> Array:
    """Displacement of every node of the body of a state [q_s, v_s, omega eta, eta'], (nodes, d, n)."""
    nodes, d, k = tissue.seen.shape
    rows = np.zeros((nodes, d, 2 * n_s + 2 * k))
    rows[:, :, :n_s] = np.eye(d, n_s)
    rows[:, :, 2 * n_s : 2 * n_s + k] = tissue.seen / tissue.omega
    return rows


def node_covariance(rows: Array, judged: Judged) -> Array:
    """Covariance of the place of every node around its way [m2], (nodes, d, d)."""
    return np.asarray(np.einsum("jdn,nm,jem->jde", rows, judged.covariance, rows, optimize=True))


@dataclass(frozen=True)
class TubeTrajectory:
    """The full plant in a tube, with noise and disturbances."""

    times: Array  # [s], (count,)
    moved: Array  # of the nodes from their places at the target [m], (count, nodes, d)
    inputs: Array  # [N], (count, n_s)


def run_tube(tube: Tube, plant: Ticks, rows: Array, ticks: int, every: int, seed: int | None = 0) -> TubeTrajectory:
    """The full plant from the start of the plan, one exact step a tick. Not collective.

    Noise and disturbances are normal, cut at :data:`CUT` standard deviations.

    Args:
        rows: see :func:`node_rows`.
        every: ticks between two places that are kept.
        seed: of the noise; None: there is none.
    """
    own, run = tube.controller, TubeRun(tube)
    n_s, generator = own.n_s, np.random.default_rng(seed)
    A = scipy.sparse.csr_array(np.where(np.abs(plant.A) > ROUNDING * np.abs(plant.A).max(), plant.A, 0.0))
    target = own.x_bar[:n_s]
    x = np.zeros(len(plant.A))
    x[:n_s] = tube.start[:n_s] - target
    held = own.observer.C @ own.x_bar if own.observer is not None else np.zeros(0)  # samples at the target
    first = len(held) - (own.observer.others if own.observer is not None else 0)
    count, size, sampled = -(-ticks // every), plant.W.shape[1], len(plant.C)
    moved, inputs = np.empty((count, *rows.shape[:2])), np.empty((count, n_s))
    for tick in range(ticks):
        noise = np.zeros(size + sampled)
        if seed is not None:
            noise = np.clip(generator.standard_normal(size + sampled), -CUT, CUT)
        sample = plant.C @ x + held + plant.sd * noise[size:]
        u = run.step(sample[:n_s], sample[n_s:first], sample[first:])
        if tick % every == 0:
            moved[tick // every], inputs[tick // every] = rows @ x, u
        x = A @ x + plant.B @ (u - own.u_bar) + plant.W @ noise[:size]
    times: Array = np.arange(count, dtype=np.float64) * (every * plant.period)
    return TubeTrajectory(times, moved, inputs)
