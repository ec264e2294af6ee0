"""The dual active set against non-negative least squares of the same problem [LH74], and its exact penalty."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.lqr.program.least_distance import InfeasibleError, _enter, nearest, nearest_soft
from tests.helpers.least_distance import least_squares


def rows(rng: np.random.Generator, m: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Random half-spaces that hold a point of size 2, most of them without the origin."""
    G = rng.standard_normal((m, n)) @ np.diag(rng.uniform(0.1, 3, n))
    return G, G @ (2 * rng.standard_normal(n) / np.sqrt(n)) + rng.uniform(0, 0.3, m)


def test_rows_that_became_dependent_by_rounding_keep_no_point() -> None:
    """An active set as it is left where x grows without end; the triangular solve has a zero pivot there."""
    G = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    with pytest.raises(InfeasibleError, match="no point keeps all rows, to rounding"):
        _enter(G, [0, 1], np.ones(2), 2, 1.0)


@pytest.mark.parametrize(("m", "n"), [(5, 1), (8, 3), (30, 10), (985, 60)])
def test_equal_to_least_squares(m: int, n: int) -> None:
    rng = np.random.default_rng(m)
    for _ in range(1 if m > 100 else 20):
        G, h = rows(rng, m, n)
        found = nearest(G, h)
        # rounding of the two methods; the oracle divides by its residual
        assert np.abs(found.x - least_squares(G, h)).max() < 1e-11
        assert (G @ found.x - h).max() < 1e-12
        assert np.abs(found.x + G.T @ found.multipliers).max() < 1e-11
        assert (found.multipliers >= 0).all()
        assert np.abs(found.multipliers * (G @ found.x - h)).max() < 1e-11


def test_start_near_the_answer_saves_steps() -> None:
    rng = np.random.default_rng(1)
    G, h = rows(rng, 300, 40)
    cold = nearest(G, h)
    warm = nearest(G, h + 1e-3 * rng.uniform(-1, 1, len(h)), cold.active)
    again = nearest(G, h, (*cold.active, *cold.active[:3], 7))  # dependent and useless rows are dropped
    assert warm.steps < cold.steps / 3
    assert np.abs(again.x - cold.x).max() < 1e-12  # rounding


def test_two_equal_walls_and_one_that_no_point_keeps() -> None:
    wall = np.array([[-1.0, 0.0], [-1.0, 0.0], [-2.0, 0.0]])
    found = nearest(wall, np.array([-1.0, -1.0, -2.0]))
    assert np.array_equal(found.x, [1.0, 0.0])
    assert len(found.active) == 1
    with pytest.raises(InfeasibleError):
        nearest(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0.0, -1e-6]))
    with pytest.raises(InfeasibleError):
        nearest(np.zeros((1, 2)), np.array([-1.0]))


def test_penalty_is_exact_above_the_multipliers_and_pays_below() -> None:
    rng = np.random.default_rng(3)
    G, h = rows(rng, 40, 6)
    group = np.repeat(np.arange(8), 5)
    hard = nearest(G, h)
    none = (np.zeros((0, 6)), np.zeros(0))
    most = np.bincount(group, hard.multipliers).max()
    exact = nearest_soft(G, h, group, none, 1.01 * most)
    assert exact.slack.max() < 1e-12  # rounding
    assert np.abs(exact.x - hard.x).max() < 1e-11
    assert nearest_soft(G, h, group, none, 0.5 * most).slack.max() > 1e-4
    # x >= 1 softly and x <= 0: all of the metre is slack
    one = nearest_soft(np.array([[-1.0]]), np.array([-1.0]), np.array([0]), (np.array([[1.0]]), np.zeros(1)), 5.0)
    assert np.allclose([one.x[0], one.slack[0]], [0.0, 1.0], atol=1e-12)
