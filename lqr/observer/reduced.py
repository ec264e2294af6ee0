"""A Kalman filter of hand and few shapes of the tissue, from tick to tick, with the gain that acts on its estimate.

    x_{n+1} = A x_n + B u_n + f + w_n,   s_n = C x_n + v_n,   M = P C' (C P C' + V)^{-1}

and P from the discrete Riccati equation. What the shapes leave of the tissue is seen by the sensors too: its variance
times its memory is taken as noise of theirs. This keeps the filter from taking a mode that it does not have for one
that it has (spillover), but proves nothing: :mod:`softgrasp.lqr.observer.judge` decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.fem.reduced import ReducedSystem
from softgrasp.lqr.constrained.tissue import static_shapes
from softgrasp.lqr.dense.modal import ModalPlant
from softgrasp.lqr.loop.filter import Filter
from softgrasp.lqr.loop.small import Shapes, galerkin
from softgrasp.lqr.observer.sensors import Disturbance, Sensors
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem


@dataclass(frozen=True)
class ReducedFilter:
    """A filter with the plant and the noise that it was made for."""

    filter: Filter  # what runs
    plant: ReducedSystem  # hand and shapes
    shapes: Shapes  # of the tissue
    V: Array  # variance of the samples, that of what the shapes leave out included, (p, p)
    left_out: Array  # part of V that the shapes leave out, its diagonal, (p,)
    P: Array  # covariance of the estimate before a sample, by the reduced plant, (N, N)
    mixed: Array  # shapes by the modes of the tissue, (n, k)
    kept: NDArray[np.int64]  # numbers of the modes among the shapes, (k - n_s,)


def reduced_filter(
    problem: RiccatiProblem,
    modes: ModalPlant,
    sensors: Sensors,
    disturbance: Disturbance,
    N: int,
    period: float,
    delay: int = 0,
    weight: float = 1.0,
    kept: NDArray[np.int64] | None = None,
) -> ReducedFilter:
    """The filter of N states, sampled every ``period`` [s]. Collective.

    Args:
        modes: all modes of the plant, local rows.
        N: states, those of the hand included, even.
        delay: ticks that samples come late.
        weight: factor of the noise that stands for what the shapes leave out.
        kept: numbers of the modes among the shapes; None: those of :func:`kept_modes`.

    Raises ControlError: there are no N states, the tissue has no damping, or no filter exists.
    """
    n_s, n, comm = problem.layout.n_s, len(modes.omega), problem.layout.comm
    k = N // 2 - n_s
    if not n_s < k <= n:
        raise ControlError(f"control.observer.N is {N}; this plant has observers of {4 * n_s + 2} to {2 * (n_s + n)}")
    delta = np.diag(modes.D) / 2
    if not delta.min() > 0:
        raise ControlError(f"the mode at {modes.omega[int(delta.argmin())]:.4g}/s has no damping; an observer needs it")
    kept = kept_modes(modes, k - n_s) if kept is None else kept
    mixed = np.hstack([np.eye(n)[:, kept], static_shapes(modes.omega, modes.g, kept)])
    plant, shapes = galerkin(problem, modes.Phi @ mixed)
    seen, moved = (total(comm, part) for part in sensors.of(modes.Phi))
    C = np.hstack([sensors.C.hand.T, seen @ mixed, moved @ mixed])
    factor = disturbance.factor
    loads = total(comm, modes.Phi.T @ factor.parts[3])  # of every mode
    rest = np.eye(n) - mixed @ mixed.T
    power = np.sum((loads - modes.g @ np.linalg.solve(problem.M_s, factor.hand[n_s:])) ** 2, axis=1) / (4 * delta**2)
    left = np.sum(((seen @ rest) / modes.omega) ** 2 * power + (moved @ rest) ** 2 * power, axis=1)
    V = np.diag(sensors.sd**2 + weight * left / period)
    noise = np.vstack([factor.hand, np.zeros((k, factor.columns)), mixed.T @ loads])
    A, B, f, P, M = on_root(comm, lambda: _stationary(plant, C, noise, V, period))
    own = Filter(A, B, f, C, M, sensors.names, sensors.speed, delay)
    return ReducedFilter(own, plant, shapes, V, left / period, P, mixed, kept)


def kept_modes(modes: ModalPlant, count: int) -> NDArray[np.int64]:
    """The modes of largest |c|^2 |g|^2 / (delta omega^2), what each adds to the cost."""
    cost = np.sum(modes.c**2, axis=0) * np.sum(modes.g**2, axis=1) / (np.diag(modes.D) / 2 * modes.omega**2)
    return np.argsort(-cost, kind="stable")[:count]


def _stationary(plant: ReducedSystem, C: Array, noise: Array, V: Array, period: float) -> tuple[Array, ...]:
    """A, B and f of a tick, covariance P before a sample and the correction M."""
    N, m = plant.B.shape
    solved = np.linalg.solve(plant.E, np.column_stack([plant.A, noise, plant.B, plant.f]))
    F, loads = solved[:, :N], solved[:, N:]
    w = noise.shape[1]
    whole = scipy.linalg.expm(period * np.vstack([np.column_stack([F, loads[:, w:]]), np.zeros((m + 1, N + m + 1))]))
    A, B, f = whole[:N, :N], whole[:N, N:-1], whole[:N, -1]
    # [-F W; 0 F'] of Van Loan: the covariance that a tick adds
    G = loads[:, :w]
    both = scipy.linalg.expm(period * np.block([[-F, G @ G.T], [np.zeros((N, N)), F.T]]))
    W = A @ both[:N, N:]
    try:
        P = scipy.linalg.solve_discrete_are(A.T, C.T, (W + W.T) / 2, V)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise ControlError(f"no filter of {N} states exists for these samples and disturbances ({error})") from None
    return A, B, f, P, np.linalg.solve(C @ P @ C.T + V, C @ P).T
