"""Rows that stand for others: the others hold wherever they do, and not without what they keep for them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from softgrasp.lqr.constrained.thin import Thinned, coarse_to_fine, thinned

pytestmark = pytest.mark.serial
PLACES = {
    "plane": np.array([(x, y) for x, y in product(range(13), range(25)) if x in (0, 12) or y in (0, 24)]) / 12.0,
    "space": np.array([p for p in product(range(7), repeat=3) if not all(0 < x < 6 for x in p)]) / 6.0,
}


def example(places: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gaps v at three instants of a body that is bent, smooth modes n.S, r and the largest z."""
    n, waves = np.eye(places.shape[1])[0], rng.normal(size=(5, places.shape[1]))
    seen = 0.2 * np.sin(places @ waves.T + rng.uniform(0, 6, 5))
    still = 0.02 * rng.normal(size=(3, 5)) @ seen.T
    v = (places @ n) + still
    v += 0.003 - v.min(axis=1, keepdims=True)
    whole = 0.02 * rng.uniform(0.5, 1, (3, 5))
    return v, seen, 0.05 * whole, whole


def least_left(found: Thinned, v: np.ndarray, seen: np.ndarray, reach: np.ndarray, e: np.ndarray) -> float:
    """Least gap of all nodes where the hand is so near that a row that stays has just what it keeps, modes off by e."""
    left = v + e @ seen.T
    beyond = np.maximum(np.abs(e) - reach, 0.0)
    keeps = found.least + np.einsum("iak,ik->ia", found.spread, beyond)
    room = np.where(found.stays, left[:, found.nodes] - keeps, np.inf).min(axis=1)
    return float((left - room[:, None]).min())


@pytest.mark.parametrize("kind", PLACES)
def test_rows_that_are_left_out_hold_where_those_that_stay_do(kind: str) -> None:
    rng, count = np.random.default_rng(0), []
    near, far = [], []  # least gaps with nothing kept for others, near to the plan and in the whole box
    order = coarse_to_fine(PLACES[kind])
    for _ in range(3):
        v, seen, reach, whole = example(PLACES[kind], rng)
        found = thinned(order, v, seen, reach, whole, 0.2 * v.min(axis=1))
        count.append(found.stays.sum() / v.size)
        assert (found.least[found.stays] <= 0.2 * v.min() + 1e-15).all()
        none = Thinned(found.nodes, found.stays, np.zeros_like(found.least), np.zeros_like(found.spread))
        flat = Thinned(found.nodes, found.stays, found.least, np.zeros_like(found.spread))
        for _ in range(100):
            e = rng.choice([-1.0, 1.0], (3, 5)) * whole * (1.0 if rng.random() < 0.5 else rng.random((3, 5)))
            assert least_left(found, v, seen, reach, e) >= -1e-15  # rounding of gaps of a metre
            assert least_left(found, v, seen, reach, e * reach / whole) >= -1e-15
            near.append(least_left(none, v, seen, reach, e * reach / whole))
            far.append(least_left(flat, v, seen, reach, e))
    assert max(count) < 0.3
    assert min(near) < -1e-6  # what is kept is needed
    assert min(far) < -1e-5  # and what is kept beyond r


def test_a_single_node_stands_for_itself() -> None:
    order = coarse_to_fine(np.array([[2.0, 1.0]]))
    found = thinned(order, np.ones((3, 1)), np.ones((1, 2)), np.ones((3, 2)), np.ones((3, 2)), np.ones(3))
    assert found.stays.all()
    assert not found.least.any()


def test_a_held_node_that_is_farther_off_needs_nothing() -> None:
    """Between two that are nearer, with no mode at any of them: 0 / 0 would drop the rows of both."""
    order, none = coarse_to_fine(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])), np.zeros((3, 2))
    found = thinned(order, np.tile([1.0, 1.5, 0.9], (3, 1)), none, none + 0.1, none + 1.0, np.zeros(3))
    assert found.nodes.tolist() == [0, 2]
    assert found.stays.all()
    assert (found.least == 0).all()
    assert (found.spread == 0).all()


def test_nodes_come_from_coarse_to_fine_between_others() -> None:
    for places in PLACES.values():
        order = coarse_to_fine(places)
        assert sorted(order.nodes.tolist()) == list(range(len(places)))
        seen, late = set[int](), 0
        for node, about, means in zip(order.nodes.tolist(), order.about, order.means, strict=True):
            assert seen.issuperset(about.tolist())
            if len(about):
                assert means[0].min() >= 0
                assert means.sum(axis=1) == pytest.approx(1.0, abs=1e-14)  # rounding of a sum of three
                late += np.linalg.norm(means[0] @ places[about] - places[node]) > 1e-9
            seen.add(node)
        assert late < len(places) / 4  # the others lie between earlier ones
