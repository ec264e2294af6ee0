"""The full plant from tick to tick under a controller with a plan, with noise and disturbances.

What it deviates from its way under u_nom, see :mod:`softgrasp.lqr.program.replan`, has the covariance of the loop with
observer wherever the plan leads, and less right after a new plan from the estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.tissue import ModalTissue
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.observer.judge import Judged, Ticks
from softgrasp.lqr.program.replan import Replanned

ROUNDING = 1e-15  # of the largest entry of a tick's matrix
CUT = 3.0  # standard deviations at which noise and disturbances of a run are cut


def node_rows(tissue: ModalTissue, n_s: int) -> Array:
    """Displacement of every node of the body of a state [q_s, v_s, omega eta, eta'], (nodes, d, n)."""
    nodes, d, k = tissue.seen.shape
    rows = np.zeros((nodes, d, 2 * n_s + 2 * k))
    rows[:, :, :n_s] = np.eye(d, n_s) if tissue.rigid is None else tissue.rigid
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
    log: tuple[Replanned, ...]  # how every interval began


def run_tube(
    controller: Controller,
    plant: Ticks,
    rows: Array,
    ticks: int,
    every: int,
    seed: int | None = 0,
    again: bool = True,
    push: Callable[[int], Array | float] = lambda tick: 0.0,
) -> TubeTrajectory:
    """The full plant from the start of the plan, one exact step a tick. Not collective.

    Noise and disturbances are normal, cut at :data:`CUT` standard deviations.

    Args:
        controller: of a plan; a copy of it runs.
        rows: see :func:`node_rows`.
        every: ticks between two places that are kept.
        seed: of the noise; None: there is none.
        again: whether plans are made again at every interval, else the first one is followed.
        push: unknown load on the hand at each tick [N], (n_s,).
    """
    own, generator = deepcopy(controller), np.random.default_rng(seed)
    own.reset()
    program, n_s, filter_ = own.planner, own.n_s, own.observer
    assert program is not None
    own.replanner.again = again
    A = scipy.sparse.csr_array(np.where(np.abs(plant.A) > ROUNDING * np.abs(plant.A).max(), plant.A, 0.0))
    x = np.zeros(len(plant.A))
    x[:n_s] = (program.rest - own.x_bar)[:n_s]
    held = own.x_bar[: 2 * n_s] if filter_ is None else filter_.C @ own.x_bar
    first = len(held) - (0 if filter_ is None else filter_.others)
    count, size, sampled = -(-ticks // every), plant.W.shape[1], len(plant.C)
    moved, inputs = np.empty((count, *rows.shape[:2])), np.empty((count, n_s))
    for tick in range(ticks):
        noise = np.zeros(size + sampled)
        if seed is not None:
            noise = np.clip(generator.standard_normal(size + sampled), -CUT, CUT)
        sample = plant.C @ x + held + plant.sd * noise[size:]
        v = sample[n_s:first] if first > n_s else np.zeros(n_s)  # not measured
        u = own.step(sample[:n_s], v, None if filter_ is None else sample[first:])
        if tick % every == 0:
            moved[tick // every], inputs[tick // every] = rows @ x, u
        x = A @ x + plant.B @ (u - own.u_bar + push(tick)) + plant.W @ noise[:size]
    times: Array = np.arange(count, dtype=np.float64) * (every * plant.period)
    return TubeTrajectory(times, moved, inputs, tuple(own.replanner.log))
