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


@pytest.mark.parametrize("coupled", [0.0, 1e-3])
def test_an_inverse_of_axes_is_that_of_all_rows(coupled: float) -> None:
    """Axes without each other are inverted one by one, though their conditions differ; coupled ones together."""
    k, rng = 20, np.random.default_rng(4)
    W, leasts = np.zeros((3 * k, 3 * k)), (0.5, 1e-4, 0.1)
    for a, least in enumerate(leasts):
        Q = np.linalg.qr(rng.standard_normal((k, k)))[0]
        W[a::3, a::3] = Q * np.geomspace(least, 1.0, k) @ Q.T
    W[0, 1] = W[1, 0] = coupled * W[1, 1]
    by_axes, whole = Inverse(3), Inverse()
    for inverse in (by_axes, whole):
        inverse.of(W, 3 * k)
        inverse.make()
    exact = np.linalg.inv(W)
    assert np.abs(by_axes.made - exact).max() < 1e-11 * np.abs(exact).max()  # condition 1e4 times rounding
    assert by_axes.made.flags.c_contiguous
    assert by_axes.error == pytest.approx(whole.error, rel=0.5)  # both estimate the condition of all rows
    W[2::3, 2::3] = -np.eye(k)
    by_axes.of(W.copy(), 3 * k)
    by_axes.make()
    assert by_axes.spent == -1.0  # refused
