"""Friction step by step, from forces and factors of earlier steps."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.obstacles.coulomb import Coulomb


@pytest.mark.parametrize("more", [0.3, 3.0])  # in the second case W^-1 needs no check
@pytest.mark.parametrize("tangents", [1, 2])
def test_few_other_sets_leave_the_factor(tangents: int, more: float) -> None:
    """Loads that change step by step: first forces, then slips are found from the factor of earlier sets."""
    rng, k, s = np.random.default_rng(2), 40 // tangents, 1 + tangents
    A = rng.standard_normal((s * k + 2, s * k))
    W, q, mu = A.T @ A / k + more * np.eye(s * k), rng.standard_normal(s * k) - 2.0, np.full(k, 0.4)
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
        assert np.abs(x - fresh).max() < 1e-11 * np.abs(fresh).max(), step  # condition number 1e3
    assert kept.inverse.sure == (more > 1)
    assert sides == sorted(sides)
    assert 0 < sum(sides) < len(sides)
    assert len(factored) < 0.8 * len(sides)  # 17 of 30 and 4 of 15 seen
