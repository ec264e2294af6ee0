"""What gains cost, compared on the modes kept: no solve with the full plant, one small product a step for all gains.

The midpoint rule keeps quadratic balances, so that with the gain K of the Riccati equation

    J(K_hat) - J(K) = dt sum_n |u_n - K x_mid|_R^2    for every dt and any inputs u_n,

which has none of the cancellation of J(K_hat) - J(K).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.reduced import midpoint_map
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from softgrasp.lqr.spectrum.sampled import Sampling

MOST = 4000  # steps of a sampled loop; a finer tick differs little from the continuous law, which takes
STEPS = 600  # of the continuous law, of a twentieth of the time to settle
LONG = 5  # times to settle of a sampled loop


def modal_excess(
    loop: ModalLoop, gains: Sequence[Block], best: Block, start: Block, law: Sampling | None, settle: float
) -> Array:
    """Excess dt sum |u - K x_mid|_R^2 of every gain, as the loop is sampled, held and late, without limits. Collective.

    Args:
        gains: K_hat, transposed, hand-relative.
        best: the optimal gain.
        start: x(0) minus target, one column.
        law: instants of the loop; None: the continuous law.
        settle: time after which the hand is at its target [s].

    Returns (gains,); infinite where the loop diverges.
    """
    if law is None or not law.every or LONG * settle > MOST * law.dt:
        law = Sampling(settle / 20)
    steps = int(np.ceil(LONG * settle / law.dt)) if law.every else STEPS
    k, k_best, x = np.stack([loop.gain(K) for K in gains]), loop.gain(best), loop.state(start)

    def march() -> Array:
        with np.errstate(over="ignore", invalid="ignore"):  # of a gain that does not stabilise
            cost = _march(loop, k, k_best, np.repeat(x, len(k), axis=1), law, steps)
        return np.where(np.isfinite(cost), cost, np.inf)

    return on_root(loop.comm, march)


def _march(loop: ModalLoop, k: Array, k_best: Array, X: Array, law: Sampling, steps: int) -> Array:
    """All loops side by side, (2 n_s + 2 modes, gains)."""
    n, m = loop.B.shape
    P, Y = np.split(midpoint_map(np.eye(n), loop.A, loop.B, law.dt), [n], axis=1)
    R = loop.problem.R
    implicit = np.linalg.solve(np.eye(m) - k @ Y / 2, k @ (P + np.eye(n)) / 2)
    waiting = deque([np.zeros((m, len(k)))] * (law.delay + 1), law.delay + 1)
    cost = np.zeros(len(k))
    for n_step in range(steps):
        if not law.every:
            waiting.append(np.einsum("gij,jg->ig", implicit, X))
        elif n_step % law.every == 0:
            waiting.append(np.einsum("gij,jg->ig", k, X))
        u = waiting[0]
        new = P @ X + Y @ u
        off = u - k_best @ (X + new) / 2
        cost += law.dt * np.einsum("ig,ij,jg->g", off, R, off)
        X = new
    return cost
