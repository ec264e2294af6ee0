"""Bases against dense oracles, which do not depend on the rank count."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.reduction.bases.inner import INNERS, InnerName
from softgrasp.reduction.bases.registry import METHODS, make_basis
from tests.helpers.models import Array
from tests.helpers.snapshots import (
    Case,
    basis_halves,
    case,
    gap,
    halves,
    root_of,
)


@pytest.mark.parametrize("inner", INNERS)
@pytest.mark.parametrize("key", ["global_pod", "pod_fixed", "global_pod_relative", "pod_fixed_relative"])
def test_pod_spans_the_leading_singular_vectors(key: str, inner: InnerName) -> None:
    c = case()
    q, v = halves(c, key)
    L_q, L_v = root_of(c, key, inner, 0), root_of(c, key, inner, 1)
    U, s, _ = np.linalg.svd(np.vstack([L_q.T @ q, L_v.T @ v]), full_matrices=False)
    basis = make_basis(key, c.states, 10, inner)
    k = 10 - (2 * c.model.system.layout.n_s if basis.fixed_solid else 0)
    strong = s > 1e-7 * s[0]
    assert basis.sigma[0][: len(s)][strong] == pytest.approx(s[strong], rel=1e-7)  # eps * 1e7, times sqrt cond W ~ 1e2
    found = np.vstack([np.linalg.solve(L_q.T, U[: len(q), :k]), np.linalg.solve(L_v.T, U[len(q) :, :k])])
    assert gap(np.vstack(basis_halves(basis)), found) < 1e-8  # rounding over the gap (s_k - s_k+1) / s_1 > 1e-4


@pytest.mark.parametrize("inner", INNERS)
@pytest.mark.parametrize("key", ["componentwise_pod", "componentwise_pod_fixed", "componentwise_pod_fixed_relative"])
def test_componentwise_pod_is_two_pods(key: str, inner: InnerName) -> None:
    c = case()
    basis = make_basis(key, c.states, 12, inner)
    q, p = basis_halves(basis)
    hand = 2 * c.model.system.layout.n_s if basis.fixed_solid else 0
    count = [int(np.sum(np.abs(x).max(axis=0) > 0)) for x in (q, p)]
    assert sum(count) == 12 - hand
    assert not q[:, count[0] :].any()
    assert not p[:, : count[0]].any()
    for half, (X, V, k) in enumerate(zip(halves(c, key), (q[:, : count[0]], p[:, count[0] :]), count, strict=True)):
        L = root_of(c, key, inner, half)
        U = np.linalg.svd(L.T @ X, full_matrices=False)[0]
        assert gap(L.T @ V, U[:, :k]) < 1e-8  # rounding over the gap of the spectrum
    assert count[0] == count[1]  # a displacement needs its velocity, whatever the singular values say


@pytest.mark.parametrize("key", ["psd", "psd_fixed", "psd_qv", "psd_fixed_qv", "psd_relative", "psd_fixed_relative"])
def test_complex_svd_spans_the_leading_vectors_of_x_and_jx(key: str) -> None:
    c = case()
    q, p = halves(c, key)
    U, s, _ = np.linalg.svd(np.block([[q, p], [p, -q]]), full_matrices=False)  # Y = [X, J X] [SBRH21]
    basis = make_basis(key, c.states, 12, "euclidean")
    k = 12 - (2 * c.model.system.layout.n_s if basis.fixed_solid else 0)
    assert s[0] == pytest.approx(s[1], rel=1e-12)  # every value twice
    assert basis.sigma[0][: k // 2] == pytest.approx(s[:k:2], rel=1e-10)  # eps over s_k / s_1 > 1e-3
    assert gap(np.vstack(basis_halves(basis)), U[:, :k]) < 1e-8  # rounding over the gap


def canonical(c: Case, key: str, inner: InnerName) -> tuple[Array, Array, Array, float]:
    """L and snapshots (L' q sqrt(c), L^-1 p / sqrt(c)), in which the weighted product is the plain one, and c."""
    q, p = halves(c, key)
    L = root_of(c, key, inner, 0)
    q, p = L.T @ q, np.linalg.solve(L, p)
    rate = float(np.linalg.norm(p) / np.linalg.norm(q))
    return L, q * rate**0.5, p / rate**0.5, rate


@pytest.mark.parametrize("inner", ["mass", "energy"])
@pytest.mark.parametrize("key", ["psd", "psd_fixed_relative", "psd_cotangent_lift_fixed"])
def test_weighted_psd_is_the_plain_one_in_canonical_coordinates(key: str, inner: InnerName) -> None:
    c = case()
    L, q, p, rate = canonical(c, key, inner)
    lift = "cotangent" in key
    U, s, _ = np.linalg.svd(np.hstack([q, p]) if lift else q + 1j * p, full_matrices=False)
    basis = make_basis(key, c.states, 12, inner)
    k = (12 - (2 * c.model.system.layout.n_s if basis.fixed_solid else 0)) // 2
    assert basis.rate == pytest.approx(rate, rel=1e-9)  # one solve with a condition below 1e4
    assert basis.sigma[0][:k] == pytest.approx(s[:k], rel=1e-8)  # eps cond(L) over s_k / s_1
    V_q, V_p = basis_halves(basis)
    found = np.vstack([rate**0.5 * L.T @ V_q, np.linalg.solve(L, V_p) / rate**0.5])
    E = U[:, :k]
    assert gap(found, np.block([[E.real, -E.imag], [E.imag, E.real]])) < 1e-7  # rounding over the gap, cond(L) ~ 1e2


def test_svd_like_bases_project_better_than_complex_svd() -> None:
    c = case()
    q, p = halves(c, "psd_fixed")

    def error(key: str) -> float:
        V_q, V_p = basis_halves(make_basis(key, c.states, 14))
        V, k = np.vstack([V_q, V_p]), V_q.shape[1] // 2
        form = V_q.T @ p - V_p.T @ q
        X = np.vstack([q, p])
        return float(np.linalg.norm(X - V @ np.vstack([form[k:] * -1, form[:k]])) / np.linalg.norm(X))

    # symplectic projection, V (J' V' J): a factor of 20 is measured on the paper's mesh
    assert error("psd_svd_like_fixed") < error("psd_fixed") / 3


def test_canonical_bases_beyond_the_papers_are_built_in_the_energy_product() -> None:
    c = case()
    for key, inner in (
        ("psd", "euclidean"), ("psd_fixed", "euclidean"), ("pod_fixed_relative", "euclidean"),
        ("psd_fixed_relative", "energy"), ("psd_cotangent_lift_fixed", "energy"), ("psd_svd_like_fixed", "euclidean"),
    ):  # fmt: skip
        default = make_basis(key, c.states, 10)
        assert default.inner == METHODS[key].inner == inner
        assert np.array_equal(default.V_q, make_basis(key, c.states, 10, inner).V_q)  # type: ignore[arg-type]
