"""Friction of many nodes, whose factors are in single precision, against sweeps of Gauss-Seidel alone."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.obstacles.coulomb import SINGLE, Coulomb


@pytest.mark.parametrize("twice", [False, True])
def test_factors_in_single_precision_lead_to_forces_in_double(twice: bool) -> None:
    """Also where every node meets two equal tables, so that W is singular and its factor rounding alone."""
    rng, k = np.random.default_rng(3), 2 * (SINGLE // 2 + 5)
    m = k // 2 if twice else k
    A, q = rng.standard_normal((3 * m + 2, 3 * m)), rng.standard_normal(3 * m) - 0.5
    W = A.T @ A / m + 0.5 * np.eye(3 * m)
    if twice:
        W, q = np.ascontiguousarray(np.tile(W, (2, 2))), np.tile(q, 2)
    coulomb, mu = Coulomb(2, "C"), np.full(k, 0.3)
    for load in (q, 0.9 * q + 0.01):
        moved = W @ coulomb.solve(k, W, load, mu, 1e-13).ravel()
        swept = Coulomb(2, "NumPy")
        swept.fit(k)
        swept._sweep(W, load, mu, 3000)
        assert np.abs(moved - W @ swept.x.ravel()).max() < 1e-10 * np.abs(moved).max()  # sweeps end at 1e-14
    assert twice or coulomb.f.single
