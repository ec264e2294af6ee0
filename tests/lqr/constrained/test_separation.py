"""Gap and separating half-plane of a body and an obstacle against a scan over all directions."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape
from softgrasp.lqr.constrained.separation import gaps, past, separate, supports

FAN = np.column_stack([f(np.linspace(0, 2 * np.pi, 20_000)) for f in (np.cos, np.sin)])


@pytest.mark.parametrize(
    "shape",
    [Ball(np.array([0.3, 0.2]), 0.4), Polytope.box(np.zeros(2), np.array([0.5, 1.0])),
     Polytope.hull(np.array([[0.0, 0.0], [1.0, 0.2], [0.3, 0.9]]))],
)  # fmt: skip
def test_gap_is_the_best_of_all_directions(shape: Shape) -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        body = rng.uniform(-1.5, 1.5, 2) + 0.6 * rng.standard_normal((12, 2))
        normal, gap = separate(shape, body)
        scanned = ((FAN @ body.T).min(axis=1) - supports(shape, FAN)).max()
        assert scanned <= gap + 1e-12  # rounding
        assert gap <= scanned + 1e-3  # the fan is 3e-4 rad wide
        assert np.isclose((body @ normal).min() - shape.support(normal), gap, atol=1e-12)


@pytest.mark.parametrize("shape", [Ball(np.array([0.3, 0.2]), 0.4), Polytope.box(np.zeros(2), np.array([0.5, 1.0]))])
def test_gaps_of_many_bodies_are_those_of_each(shape: Shape) -> None:
    rng = np.random.default_rng(0)
    bodies = rng.uniform(-2, 2, (300, 1, 2)) + 0.6 * rng.standard_normal((300, 12, 2))
    bodies[:20] = bodies[:20, :1]  # single points
    bodies[20] += shape.support(np.array([1.0, 0.0])) - bodies[20, :, 0].min()  # one that touches
    one_by_one = np.array([separate(shape, body)[1] for body in bodies[20:]])
    assert np.abs(gaps(shape, bodies[20:]) - one_by_one).max() < 1e-14  # rounding of lengths of some metres
    points = np.array([separate(shape, body[:1])[1] for body in bodies[:20]])
    assert np.abs(gaps(shape, bodies[:20])[points > 0] - points[points > 0]).max() < 1e-14
    assert 20 < (one_by_one < 0).sum() < 250  # both cases are met


def test_half_space_has_its_own_normal() -> None:
    body = np.array([[0.0, 0.0], [1.0, 0.5], [0.2, 1.0]])
    normal, gap = separate(HalfSpace(np.array([-1.0, 0.0]), -1.25), body)
    assert np.array_equal(normal, [-1.0, 0.0])
    assert gap == 0.25


def test_normals_turn_over_the_side_that_is_asked_for() -> None:
    way = np.linspace([0.0, 0.0], [10.0, 0.0], 21)
    body = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    shape = Ball(np.array([5.0, 0.0]), 1.0)
    left, right = past(shape, way, body, 1), past(shape, way, body, -1)
    assert np.allclose(left[0], [-1, 0]) and np.allclose(left[-1], [1, 0])  # noqa: PT018
    assert np.allclose(left[10], [0, 1]) and np.allclose(right[10], [0, -1])  # noqa: PT018


@pytest.mark.parametrize(
    "shape",
    [Ball(np.array([0.3, 0.2, 0.1]), 0.4), Polytope.box(np.zeros(3), np.array([0.5, 1.0, 0.7])),
     Polytope.hull(np.array([[0.0, 0, 0], [1.0, 0.2, 0.1], [0.3, 0.9, 0.2], [0.2, 0.3, 1.0]]))],
)  # fmt: skip
def test_gap_in_space_is_the_best_of_all_directions(shape: Shape) -> None:
    rng = np.random.default_rng(0)
    fan = rng.standard_normal((20_000, 3))
    fan /= np.linalg.norm(fan, axis=1)[:, None]
    overlap = 0
    for _ in range(30):
        body = rng.uniform(-1.2, 1.2, 3) + 0.5 * rng.standard_normal((9, 3))
        normal, gap = separate(shape, body)
        scanned = ((fan @ body.T).min(axis=1) - supports(shape, fan)).max()
        assert scanned <= gap + 1e-12  # rounding
        assert gap <= scanned + 0.08  # directions are some 0.03 rad apart, points up to 3 m
        assert np.isclose((body @ normal).min() - shape.support(normal), gap, atol=1e-12)
        overlap += gap < 0
    assert 3 < overlap < 27  # both cases are met


def test_boxes_are_apart_by_the_distance_of_their_corners() -> None:
    body = Polytope.box(np.array([1.3, 1.4, 0.5]), np.array([2.0, 2.0, 2.0])).corners
    normal, gap = separate(Polytope.box(np.zeros(3), np.ones(3)), body)
    assert np.allclose(normal, [0.6, 0.8, 0.0], atol=1e-12)
    assert gap == pytest.approx(0.5, rel=1e-12)  # of a 3, 4, 5 triangle
    _, deep = separate(Polytope.box(np.zeros(3), np.ones(3)), body - [0.4, 0.5, 0.25])
    assert deep == pytest.approx(-0.1, rel=1e-12)  # out through the nearest face
    assert separate(Ball(np.zeros(3), 0.25), np.array([[0.0, 3.0, 4.0]]))[1] == pytest.approx(4.75, rel=1e-12)


def test_in_space_an_obstacle_is_passed_on_four_sides() -> None:
    way = np.linspace([0.0, 0.0, 0.0], [10.0, 0.0, 0.0], 21)
    body = Polytope.box(np.full(3, -0.5), np.full(3, 0.5)).corners
    shape = Ball(np.array([5.0, 0.0, 0.0]), 1.0)
    for side, across in ((1, [0, 1, 0]), (-1, [0, -1, 0]), (2, [0, 0, 1]), (-2, [0, 0, -1])):
        normals = past(shape, way, body, side)
        assert np.allclose(normals[[0, 10, 20]], [[-1, 0, 0], across, [1, 0, 0]])
