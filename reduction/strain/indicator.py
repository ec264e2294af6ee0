"""Estimate of the error of a reduced run, from its residual in more columns of its basis and on other cells.

The run (a, v) is put into the finer equation, whose first columns are its own; with e the coordinates of its error,

    e'' + D e' + K(t) e = r,   r = -G (a_s - g) - v' - D a' - dW/da,   e(0) = K(0)^-1 r(0) from an equilibrium, else 0

K(t) is the finer tangent along the run. Midpoint steps of e span many steps of the run: r is evaluated in the
middle of each, K(t) in some of them, in between it is linear. The estimate is |E|_F / |A + E|_F of z.

No bound: e is of first order, and what no training run moved is in none of the columns. Inside the training box it came
within 0.38 and 1.8 times the true error (`docs/guide/finite_strain.md`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.reduction.strain.cells import Cells
from softgrasp.reduction.strain.stepper import StrainProblem

COLUMNS = 2  # times those of the model, where the snapshots carry them: 3 come no closer
INTERVALS = 30  # of a run at least: 60 cost twice as much and come closer by a tenth
PHASE = 0.6  # of the lowest oscillation in an interval at most [rad]: ten intervals a period
TANGENTS = 12  # along a run: its body bends more slowly than its error oscillates


@dataclass(frozen=True)
class Finer:
    """The space in which answers are checked: K >= k columns that begin with the model's, on cells of their own."""

    cells: Cells  # sampled for K columns
    K_mu: Array  # linear stiffness of every layer at mu = 1 Pa, lambda = 0, (layers, K, K)
    K_lambda: Array  # linear stiffness of every layer at lambda = 1 Pa, mu = 0, (layers, K, K)
    G: Array  # Phi' G at the densities of the projection, (K, n_s)
    gram: Array  # Phi' Phi, (K, K)


Turning = Callable[[np.ndarray], tuple[Array, Array, Array]]
"""In the frame of a hand, at steps (m,): inertia instead of v' (m, K), what is added to D and to K(t), (m, K, K)."""


def estimated_error(
    problem: StrainProblem, gram: Array, load: Array, weight: Array, run: tuple[Array, Array],
    turning: Turning | None = None,
) -> float:  # fmt: skip
    """|E|_F / |A + E|_F of a run in the finer problem; infinite where the run folds its cells.

    Args:
        problem: finer one, of K columns.
        gram: Phi' Phi, (K, K).
        load: of the finer problem at the midpoints, (steps, K).
        weight: of the body, (K,); the run starts in equilibrium with it unless a[0] = 0.
        run: a, v, coordinates and their rates, (steps + 1, k) each.
        turning: see :data:`Turning`; None where the hand does not turn.
    """
    a, v = run
    K, k, dt, potential = len(gram), a.shape[1], problem.dt, problem.potential
    edges = _edges(len(load), dt, problem.K)
    middle = (edges[1:] + edges[:-1] - 1) // 2
    more = [(0, 0), (0, K - k)]
    at, half = (np.pad(x, more) for x in (a[middle], (a[middle + 1] - a[middle]) / 2))
    change, gyro, spun = np.pad((v[middle + 1] - v[middle]) / dt, more), np.zeros((1, K, K)), np.zeros((1, K, K))
    if turning is not None:
        change, gyro, spun = turning(middle)
    with np.errstate(invalid="ignore", divide="ignore"):
        r = load[middle] - change - 2 / dt * half @ problem.D - potential.discrete_forces(at, half)
        tangents = _between(potential.tangents, at + half) + spun
        e = np.zeros(K)
        if a[0].any():
            start = np.pad(a[:1], more)
            e = np.linalg.solve(potential.tangents(start)[0], weight - potential.forces(start)[0])
    if not (np.isfinite(r).all() and np.isfinite(tangents).all() and np.isfinite(e).all()):
        return float("inf")
    s = 2 / (np.diff(edges) * dt)
    inverse = np.linalg.inv(s[:, None, None] ** 2 * np.eye(K) + s[:, None, None] * (problem.D + gyro) + tangents)
    # w = response [e; e'] + pushed, all intervals at once
    response = np.concatenate([-inverse @ tangents, s[:, None, None] * inverse], axis=2)
    pushed = (inverse @ r[:, :, None])[:, :, 0]
    state = np.concatenate([e, np.zeros(K)])
    E = np.empty((len(edges), K))
    E[0] = e
    for i, rate_of in enumerate(s):
        w = response[i] @ state + pushed[i]
        state[:K] += 2 * w
        state[K:] = 2 * rate_of * w - state[K:]
        E[i + 1] = state[:K]
    whole = E.copy()
    whole[:, :k] += a[edges]
    error, size = (float(np.vdot(x, x @ gram)) for x in (E, whole))
    return (error / size) ** 0.5 if size > 0 else 0.0


def _edges(steps: int, dt: float, K: Array) -> np.ndarray:
    """Steps of the run at which the intervals begin and end."""
    lowest = float(np.sqrt(max(np.linalg.eigvalsh(K)[0], 0.0)))
    count = max(INTERVALS, int(np.ceil(min(steps, steps * dt * lowest / PHASE))))
    return np.unique(np.linspace(0, steps, min(count, steps) + 1).round().astype(int))


def _between(tangents: Callable[[Array], Array], at: Array) -> Array:
    """K(t) at all states (m, K), linear between some of them, (m, K, K)."""
    knots = np.unique(np.linspace(0, len(at) - 1, TANGENTS).round().astype(int))
    T = tangents(at[knots])
    place = np.interp(np.arange(len(at)), knots, np.arange(len(knots)))
    low = np.minimum(place.astype(int), max(len(knots) - 2, 0))
    share = (place - low)[:, None, None]
    return np.asarray((1 - share) * T[low] + share * T[np.minimum(low + 1, len(knots) - 1)])
