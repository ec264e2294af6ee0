"""Margins are where the sampled loop really loses stability; python-control finds the same on a single input."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.linalg

from softgrasp.fem.reduced import ReducedSystem
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.loop.margins import loop_margins, sampled

Array = np.ndarray
M, C_D, K_T = 2.0, 0.05, 30.0  # hand mass, damping and stiffness of a tissue of one shape


def plant(n_s: int = 2) -> ReducedSystem:
    """A hand with a tissue of two masses on springs; axis 2 is stiffer."""
    k = n_s
    E, A = np.eye(2 * n_s + 2 * k), np.zeros((2 * n_s + 2 * k,) * 2)
    q, v, e, r = (slice(i * n_s, (i + 1) * n_s) for i in range(4))
    stiff = np.diag(K_T * (1 + np.arange(k)))
    A[q, v], A[e, r], A[r, e], A[r, r] = np.eye(n_s), np.eye(k), -stiff, -C_D * stiff
    E[r, v] = 0.4 * np.eye(k)  # inertia of the tissue against the hand
    B = np.zeros((len(E), n_s))
    B[v] = np.eye(n_s) / M
    C = np.hstack([np.eye(n_s), np.zeros((n_s, n_s)), np.eye(k), np.zeros((k, k))])
    one = np.eye(2 * n_s, len(E))
    return ReducedSystem(E, A, B, C, np.zeros(len(E)), one[:n_s], one[n_s:], ("tip_x", "tip_y")[:n_s])


def controller(p: ReducedSystem, period: float) -> Controller:
    A, B = np.linalg.solve(p.E, p.A), np.linalg.solve(p.E, p.B)
    P = scipy.linalg.solve_continuous_are(A, B, 50 * p.C.T @ p.C + 1e-3 * np.eye(p.N), np.eye(len(B.T)))
    return Controller(-B.T @ P, np.zeros(p.N), np.zeros(len(B.T)), p, period)


def radius(c: Controller, scale: Array, delay: int) -> float:
    """Spectral radius of the loop with the gains of the inputs scaled, and the load some ticks late."""
    A, B = sampled(c.plant, c.period)
    n_s, N = c.n_s, c.plant.N
    whole = np.zeros((N + delay * n_s,) * 2)
    whole[:N, :N] = A
    K = np.diag(scale) @ c.K
    if delay == 0:
        whole += B @ K
    else:
        whole[:N, N : N + n_s] = B
        whole[N : N + (delay - 1) * n_s, N + n_s :] = np.eye((delay - 1) * n_s)
        whole[N + (delay - 1) * n_s :, :N] = K
    return float(np.abs(np.linalg.eigvals(whole)).max())


@pytest.mark.parametrize("delay", [0, 1])
def test_gain_margins_are_the_edge_of_stability(delay: int) -> None:
    c = controller(plant(), 0.1)
    margins = loop_margins(c, delay)
    assert radius(c, np.ones(2), delay) < 1
    for i, axis in enumerate(margins.axes):
        assert np.isfinite(axis.gain_up)
        scale = np.ones(2)
        for factor, stable in ((0.999, True), (1.001, False)):  # interpolated between frequencies 0.3 % apart
            scale[i] = axis.gain_up * factor
            assert (radius(c, scale, delay) < 1) is stable
    low, high, _ = margins.together
    rng = np.random.default_rng(3)
    for scale in rng.uniform(1.001 * low, 0.999 * high, (200, 2)):
        assert radius(c, scale, delay) < 1


def test_delay_margin_is_the_edge_of_stability() -> None:
    """All inputs are late together in a test of whole ticks; the axes of this plant are not coupled."""
    c = controller(plant(), 0.01)
    ticks = min(axis.delay for axis in loop_margins(c).axes) / c.period
    assert ticks > 5
    assert radius(c, np.ones(2), int(np.floor(ticks))) < 1
    assert radius(c, np.ones(2), int(np.ceil(ticks))) > 1


def test_continuous_limit_is_the_guarantee_of_lqr() -> None:
    """With R a multiple of I every singular value of I + L is at least 1: gains from 1/2 on, 60 degrees (Kalman)."""
    margins = loop_margins(controller(plant(), 1e-4))
    assert 0.99 < margins.distance <= 1.001  # the hold costs h w/2 of phase
    low, high, phase = margins.together
    assert low == pytest.approx(0.5, rel=0.01)
    assert high > 90
    assert phase == pytest.approx(60.0, rel=0.01)


def test_python_control_finds_the_same() -> None:
    c = controller(plant(1), 0.1)
    (axis,) = loop_margins(c, delay=1).axes
    A, B = sampled(c.plant, c.period)
    loop = control.ss(A, B, -c.K, 0, c.period, remove_useless_states=False) * control.tf([1], [1, 0], c.period)
    gains, phases, _, _, at, _ = control.stability_margins(loop, returnall=True)
    assert axis.gain_up == pytest.approx(min(gain for gain in gains if gain > 1), rel=1e-3)  # interpolated, see above
    assert axis.phase == pytest.approx(phases[0], rel=1e-3)
    assert axis.crossover == pytest.approx(at[0], rel=1e-3)
    assert axis.delay == pytest.approx(np.radians(axis.phase) / axis.crossover, rel=1e-9)  # one crossing
