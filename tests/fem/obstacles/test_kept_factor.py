"""Friction step by step, from forces and factors of earlier steps."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.obstacles.coulomb import Coulomb
from softgrasp.fem.obstacles.inverse import Inverse


@pytest.mark.parametrize("tangents", [1, 2])
def test_few_other_sets_leave_the_factor(tangents: int) -> None:
    """Loads that change step by step: first forces, then slips are found from the factor of earlier sets."""
    rng, k, s = np.random.default_rng(2), 40 // tangents, 1 + tangents
    A = rng.standard_normal((s * k + 2, s * k))
    W, q, mu = A.T @ A / k + 3 * np.eye(s * k), rng.standard_normal(s * k) - 2.0, np.full(k, 0.4)
    kept = Coulomb(tangents, "C")
    kept.solve(k, W, q, mu, 1e-13)
    factored, sides = list[int](), list[int]()
    kept._factor = lambda call=kept._factor: (factored.append(1), call())[1]  # type: ignore[method-assign]
    for step in range(30 // tangents):
        q = q + 0.03 * rng.standard_normal(s * k)
        x = kept.solve(k, W, q, mu, 1e-13).copy()
        assert np.abs(kept.y.ravel() - W @ x.ravel() - q).max() < 1e-13
        sides.append(int(kept.f.slips))
        fresh = Coulomb(tangents, "NumPy").solve(k, W, q, mu, 1e-13)
        assert np.abs(x - fresh).max() < 1e-11 * np.abs(fresh).max(), step  # condition number 1e2
    assert kept.inverse.error < 1e-13
    assert sides == sorted(sides)
    assert 0 < sum(sides) < len(sides)
    assert len(factored) < 0.8 * len(sides)  # 17 of 30 and 4 of 15 seen


@pytest.mark.parametrize("least", [0.1, 1e-4])  # eigenvalue over the largest
def test_an_inverse_tells_its_error(least: float) -> None:
    k, inverse, rng = 60, Inverse(), np.random.default_rng(3)
    Q = np.linalg.qr(rng.standard_normal((k, k)))[0]
    W = Q * np.geomspace(least, 1.0, k) @ Q.T
    inverse.of(W, k)
    inverse.make()
    b = rng.choice([-1.0, 1.0], (k, 20))
    error = np.abs(W @ (inverse.made @ b) - b).max()
    assert error < inverse.error < 1e4 * error  # 3 and 14 times seen: a bound, if no sharp one
