"""The laws of finite strain against differences, closed forms, linear elasticity, and the identity of a step."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
from numpy.typing import NDArray

from softgrasp.fem.strain.laws import LAWS, Law, stretches

Array = NDArray[np.float64]
pytestmark = pytest.mark.serial
EVERY = [pytest.param(law, d, id=f"{law.name}-{d}d") for law in LAWS.values() for d in (2, 3)]
Q = 40


def state(d: int, size: float = 0.2, seed: int = 1) -> tuple[Array, Array, Array]:
    """Gradients that do not invert, and materials that differ from point to point."""
    rng = np.random.default_rng(seed)
    H = size * rng.uniform(-1, 1, (d, d, Q))
    return H, rng.uniform(1, 90, Q), rng.uniform(1, 50, Q)


def plane(H: Array) -> Array:
    return np.pad(H, ((0, 1), (0, 1), (0, 0))) if len(H) == 2 else H


@pytest.mark.parametrize(("law", "d"), EVERY)
def test_stress_and_tangent_are_derivatives(law: Law, d: int) -> None:
    """Central differences: the error of the step 1e-6 is 1e-12, rounding leaves 1e-10 of the largest number."""
    H, lam, mu = state(d)
    P, A, step = law.stress(H, lam, mu), law.tangent(H, lam, mu), 1e-6
    for k in range(d):
        for L in range(d):
            e = np.zeros((d, d, 1))
            e[k, L] = step
            slope = (law.energy(H + e, lam, mu) - law.energy(H - e, lam, mu)) / (2 * step)
            change = (law.stress(H + e, lam, mu) - law.stress(H - e, lam, mu)) / (2 * step)
            assert np.abs(slope - P[k, L]).max() < 1e-9 * np.abs(P).max()
            assert np.abs(change - A[:, :, k, L]).max() < 1e-8 * np.abs(A).max()
    assert np.allclose(A, A.transpose(2, 3, 0, 1, 4), rtol=1e-13, atol=1e-12 * np.abs(A).max())


@pytest.mark.parametrize(("law", "d"), EVERY)
def test_tangent_at_rest_is_hookes(law: Law, d: int) -> None:
    H, lam, mu = state(d, 0.0)
    one = np.eye(d)
    hooke = np.einsum("q,iJ,kL->iJkLq", lam, one, one)
    hooke += np.einsum("q,ik,JL->iJkLq", mu, one, one) + np.einsum("q,iL,Jk->iJkLq", mu, one, one)
    assert np.abs(law.tangent(H, lam, mu) - hooke).max() <= 1e-15 * np.abs(hooke).max()
    assert np.abs(law.stress(H, lam, mu)).max() <= 1e-15 * mu.max()
    assert np.all(law.energy(H, lam, mu) == 0)


@pytest.mark.parametrize(("law", "d"), EVERY)
def test_energy_keeps_its_digits_at_small_strain(law: Law, d: int) -> None:
    """W -> mu eps:eps + lam/2 tr(eps)^2; the next term is of third order, and rounding of W has no part of order 1."""
    H, lam, mu = state(d, 1e-6)
    eps = (H + H.swapaxes(0, 1)) / 2
    linear = mu * (eps**2).sum((0, 1)) + lam / 2 * np.einsum("iiq->q", eps) ** 2
    assert np.abs(law.energy(H, lam, mu) / linear - 1).max() < 1e-3


@pytest.mark.parametrize(("law", "d"), EVERY)
@pytest.mark.parametrize("size", [0.15, 1e-3, 1e-7, 0.0])
def test_step_changes_the_energy_by_the_work_of_its_stress(law: Law, d: int, size: float) -> None:
    """P : (F_1 - F_0) = W_1 - W_0 in every point, to rounding in the two energies, for steps large, small and none."""
    H, lam, mu = state(d)
    half = size * state(d, 1.0, 2)[0] / 2
    P, J = law.step(law.start(H), half, lam, mu)
    before, after = law.energy(H, lam, mu), law.energy(H + 2 * half, lam, mu)
    assert P is not None
    work = 2 * (P * half).sum((0, 1))
    assert np.abs(work - (after - before)).max() <= 2e-14 * np.abs(before + after + lam + mu).max()
    assert np.allclose(J, np.linalg.det((np.eye(d)[:, :, None] + H + 2 * half).transpose(2, 0, 1)), rtol=1e-13)
    if size == 0.0:
        assert np.abs(P - law.stress(H, lam, mu)).max() <= 1e-14 * np.abs(P).max()


@pytest.mark.parametrize(("law", "d"), EVERY)
def test_stress_of_a_step_is_the_midpoints_to_second_order(law: Law, d: int) -> None:
    H, lam, mu = state(d)
    G = state(d, 1.0, 2)[0]

    def gap(h: float) -> float:
        P = law.step(law.start(H), h * G, lam, mu)[0]
        return float(np.abs(P - law.stress(H + h * G, lam, mu)).max())

    assert 1.9 < np.log2(gap(2e-3) / gap(1e-3)) < 2.1


@pytest.mark.parametrize(("law", "d"), EVERY)
def test_turned_body_has_the_turned_stress(law: Law, d: int) -> None:
    """Frame indifference: W(Q F) = W(F), P(Q F) = Q P(F); and S = F^-1 P is symmetric."""
    H, lam, mu = state(d)
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((d, d)))[0]
    turn[0] *= np.linalg.det(turn)
    F = H + np.eye(d)[:, :, None]
    R = np.einsum("ij,jkq->ikq", turn, F) - np.eye(d)[:, :, None]
    P = law.stress(H, lam, mu)
    assert np.allclose(law.energy(R, lam, mu), law.energy(H, lam, mu), rtol=1e-12)
    assert np.allclose(law.stress(R, lam, mu), np.einsum("ij,jkq->ikq", turn, P), rtol=1e-12, atol=1e-12)
    S = np.linalg.solve(F.transpose(2, 0, 1), P.transpose(2, 0, 1))
    assert np.allclose(S, S.transpose(0, 2, 1), atol=1e-12 * np.abs(S).max())


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
@pytest.mark.parametrize("stretch", [0.8, 1.5])
def test_uniaxial_and_shear_closed_forms(law: Law, stretch: float) -> None:
    """Free sides: the stretch across from P_22 = 0, then the pull; shear by hand."""
    lam, mu = 60.0, 25.0

    def pull(s: float, t: float) -> tuple[float, float]:
        """P_11 and P_22 = P_33 of diag(s, t, t), from the principal stretches."""
        J = s * t * t
        if law.name == "stvk":
            E = np.array([s * s - 1, t * t - 1, t * t - 1]) / 2
            return s * (2 * mu * E[0] + lam * E.sum()), t * (2 * mu * E[1] + lam * E.sum())
        p = lam * np.log(J) if law.name == "neo-hooke" else lam * J * (J - 1)
        return mu * (s - 1 / s) + p / s, mu * (t - 1 / t) + p / t

    t = scipy.optimize.brentq(lambda t: pull(stretch, t)[1], 0.3, 2.0, xtol=1e-15, rtol=1e-14)
    H = np.diag([stretch - 1, t - 1, t - 1])[:, :, None]
    P = law.stress(H, np.array([lam]), np.array([mu]))[:, :, 0]
    assert np.abs(P - np.diag([pull(stretch, t)[0], 0, 0])).max() < 1e-12 * lam
    g = stretch - 1
    H = np.array([[0.0, g], [0.0, 0.0]])[:, :, None]
    P = law.stress(H, np.array([lam]), np.array([mu]))[:, :, 0]
    if law.name == "stvk":
        p = lam / 2 * g * g
        S = np.array([[p, mu * g], [mu * g, mu * g * g + p]])
        expected = np.array([[1, g], [0, 1]]) @ S
    else:  # J = 1: the Cauchy stress is mu (B - one)
        expected = mu * np.array([[0.0, g], [g, 0.0]])
    assert np.abs(P - expected).max() < 1e-13 * lam


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
def test_plane_strain_is_the_plane_of_three_dimensions(law: Law) -> None:
    H, lam, mu = state(2)
    assert np.allclose(law.energy(H, lam, mu), law.energy(plane(H), lam, mu), rtol=1e-13)
    assert np.allclose(law.stress(H, lam, mu), law.stress(plane(H), lam, mu)[:2, :2], rtol=1e-13, atol=1e-12)


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
def test_inverting_step_is_seen(law: Law) -> None:
    """Through the barrier no stress comes back; St. Venant-Kirchhoff goes through and tells J and the stretch."""
    for d in (2, 3):
        half = np.zeros((d, d, 3))
        half[0, 0] = [0.0, -0.4, -0.6]
        P, J = law.step(law.start(np.zeros_like(half)), half, np.ones(3), np.ones(3))
        assert (P is None) == law.barrier
        assert np.allclose(J, [1.0, 0.2, -0.2], rtol=1e-14)
        assert np.allclose(stretches(2 * half), [1.0, 0.2, 0.2])
