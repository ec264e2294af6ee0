"""The static residual bound of a run by the midpoint rule, exact for the discrete rule.

With any nodal residual r^ and e' = e + K^-1 r^ the error e = (z - z_r, v - v_r) obeys the same rule with the slow
forces K^-1 (r^+ - r^) / dt and r - mean r^: in the energy norm |e|^2 = e_z'K e_z + e_v'M e_v

    |e'_0| = |r^_0|_{K^-1},   |e'_+| <= |e'| + dt sqrt(|(r^+ - r^) / dt|_{K^-1}^2 + |r - mean r^|_{M^-1}^2),
    |e| <= |e'| + |r^|_{K^-1}.

Here r^ is the mean of its neighbours, which removes the ringing of steps. Damping only helps. The textbook
bound |e| <= dt sum |r|_{M^-1} charges what the basis lacks at every step anew.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from softgrasp.fem.petsc import Array

POINTS, PLACES = 400, 400  # frequencies of a kernel's maximum, and steps at which it is computed
SAFETY = 1.01  # of the kernel: its maximum is computed on a grid
GAIN = 1.0  # decay over the run, in powers of e, from which a kernel is worth its cost


def node_average(rows: Array, first: Array | None = None, nodes: Array | None = None) -> tuple[Array, Array]:
    """Node values by averaging neighbouring midpoint values, (w, steps + 1), and the remainder at the midpoints.

    Args:
        rows: values at the midpoints, (w, steps).
        first: node value at the start, (w,); None: the first midpoint value.
        nodes: array for the node values; None makes one.
    """
    nodes = np.empty((len(rows), rows.shape[1] + 1)) if nodes is None else nodes
    nodes[:, 0] = rows[:, 0] if first is None else first
    nodes[:, -1] = rows[:, -1]
    inner = np.add(rows[:, 1:], rows[:, :-1], out=nodes[:, 1:-1])
    inner *= 0.5
    left = nodes[:, 1:] + nodes[:, :-1]
    left *= -0.5
    left += rows
    return nodes, left


def lengths(columns: Array) -> Array:
    """Euclidean length of every column."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->j", columns, columns)))


Kernel = tuple[Array, Array]
"""Decay of a free error (steps + 1,) and of one that was forced (steps,), from 1."""


def static_bound(
    nodes: Array,
    rest: Array,
    dt: float,
    balanced: bool = False,
    kernel: Kernel | None = None,
) -> Array:
    """|e|_E at every step, (steps + 1,).

    Args:
        nodes: T r^ at the steps with |T r^| >= |r^|_{K^-1}, (w, steps + 1).
        rest: |r - mean r^|_{M^-1}, (steps,).
        dt: step [s].
        balanced: a start in equilibrium, where e_0 = -K^-1 r^_0; else at rest, e_0 = 0.
        kernel: see :func:`decay`; None: nothing decays.
    """
    node = lengths(nodes)
    force = np.hypot(lengths(np.diff(nodes)) / dt, rest)
    begin = 0.0 if balanced else node[0]
    steps = len(force)
    moved = np.zeros(steps + 1)
    if kernel is None:
        np.cumsum(dt * force, out=moved[1:])
        moved += begin
    else:
        from scipy.signal import convolve  # half a second to import

        free, forced = kernel
        moved[1:] = dt * convolve(force, forced[:steps])[:steps]
        moved += begin * free[: steps + 1]
    return np.asarray(moved + node)


def decay(low: float, high: float, alpha: float, beta: float, dt: float, steps: int) -> Kernel | None:
    """Decay of the error when D = alpha M + beta K, so that modes decouple; None where it would gain nothing.

        free_j = max |R^j|,   forced_j = max |R^j (1 - dt A / 2)^-1|   over low <= omega <= high,

    with the 2 x 2 matrix R of a midpoint step in (omega eta, eta'). Both fall with j: they are computed at some steps
    and held until the next, and the range is widened to powers of 1.1 so that neighbouring parameters share one kernel.
    """
    slowest = (alpha + beta * low**2) / 2 * steps * dt
    if not (slowest >= GAIN and np.isfinite(high)):
        return None
    grid = np.log(1.1)
    return _decay(np.floor(np.log(low) / grid), np.ceil(np.log(high) / grid), alpha, beta, dt, steps)


@lru_cache(maxsize=64)
def _decay(low: float, high: float, alpha: float, beta: float, dt: float, steps: int) -> Kernel:
    omega = np.geomspace(1.1**low, 1.1**high, POINTS)
    h, rate = dt / 2, alpha + beta * omega**2
    inverse = np.empty((POINTS, 2, 2))
    inverse[:, 0, 0], inverse[:, 1, 1] = 1 + h * rate, 1.0
    inverse[:, 0, 1], inverse[:, 1, 0] = h * omega, -h * omega
    inverse /= (1 + h * rate + (h * omega) ** 2)[:, None, None]
    stride = -(-(steps + 1) // PLACES)
    step = np.linalg.matrix_power(2 * inverse - np.eye(2), stride)
    free, forced, power = [], [], np.broadcast_to(np.eye(2), inverse.shape)
    for _ in range(-(-(steps + 1) // stride)):
        free.append(min(1.0, SAFETY * _spectral(power)))
        forced.append(min(1.0, SAFETY * _spectral(power @ inverse)))
        power = step @ power
    return np.repeat(free, stride)[: steps + 1], np.repeat(forced, stride)[: steps + 1]


def _spectral(A: Array) -> float:
    """Largest 2-norm of many 2 x 2 matrices."""
    square = np.einsum("nij,nij->n", A, A)
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return float(np.sqrt((square + np.sqrt(np.maximum(square**2 - 4 * determinant**2, 0.0))) / 2).max())
