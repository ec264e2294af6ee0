"""Signed distances of obstacles against quadratic programmes, finite differences and closed forms."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from softgrasp.fem.errors import SolverError
from softgrasp.fem.obstacles import Ball, HalfSpace, Obstacle, Polytope, Shape
from softgrasp.fem.obstacles.obstacle import check_passage

pytestmark = pytest.mark.ranks(1)  # geometry knows of no ranks
Array = NDArray[Any]
RNG = np.random.default_rng(5)


def tilted(d: int) -> Polytope:
    """A convex body without symmetry: the corners of a hull of random points on a sphere, stretched."""
    points = RNG.standard_normal((9, d))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return Polytope.hull(points * [1.0, 0.6, 1.4][:d])


SHAPES: dict[str, Shape] = {
    f"{name}{d}": shape
    for d in (2, 3)
    for name, shape in {
        "halfspace": HalfSpace(np.array([0.6, 0.0, 0.8][3 - d :]) / np.linalg.norm([0.6, 0.0, 0.8][3 - d :]), 0.2),
        "ball": Ball(np.array([0.1, -0.2, 0.3][:d]), 0.7),
        "box": Polytope.box(np.array([-0.5, -0.2, 0.1][:d]), np.array([0.3, 0.4, 0.9][:d])),
        "hull": tilted(d),
    }.items()
}


def dimension(name: str) -> int:
    return int(name[-1])


@pytest.mark.parametrize("name", SHAPES)
def test_normal_is_the_gradient_of_the_gap_and_of_length_one(name: str) -> None:
    shape, step = SHAPES[name], 1e-6
    x = RNG.uniform(-2, 2, (200, dimension(name)))
    gap, normal = shape.look(x)
    assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-14  # rounding
    axes = np.eye(dimension(name)) * step
    slope = np.stack([(shape.look(x + e)[0] - shape.look(x - e)[0]) / (2 * step) for e in axes], axis=1)
    smooth = gap > 0.02  # inside, where the nearest face changes, the gap has a kink
    assert smooth.sum() > 50
    # curvature of edges and corners at this distance times the square of the step, and rounding over the step
    assert np.abs(slope - normal)[smooth].max() < 1e-8


@pytest.mark.parametrize("name", [name for name in SHAPES if name[:3] in ("box", "hul")])
def test_gap_outside_is_the_distance_that_a_quadratic_programme_finds(name: str) -> None:
    shape = SHAPES[name]
    assert isinstance(shape, Polytope)
    x = RNG.uniform(-2, 2, (25, dimension(name)))
    gap, _ = shape.look(x)
    rows = {"type": "ineq", "fun": lambda y: shape.offsets - shape.normals @ y, "jac": lambda y: -shape.normals}
    for point, distance in zip(x[gap > 0], gap[gap > 0], strict=True):
        best = minimize(
            lambda y, p=point: ((y - p) ** 2).sum(),
            shape.corners.mean(axis=0),
            jac=lambda y, p=point: 2 * (y - p),
            constraints=[rows],
            method="SLSQP",
            options={"ftol": 1e-15, "maxiter": 200},
        )
        assert distance == pytest.approx(np.sqrt(best.fun), abs=1e-6)  # SLSQP stops at about the root of its tolerance


@pytest.mark.parametrize("name", [name for name in SHAPES if name[:3] in ("box", "hul")])
def test_faces_hold_all_corners_and_depth_is_that_of_the_nearest_face(name: str) -> None:
    shape = SHAPES[name]
    assert isinstance(shape, Polytope)
    slack = shape.corners @ shape.normals.T - shape.offsets
    assert slack.max() < 1e-14  # rounding: no corner beyond a face
    assert (np.abs(slack) < 1e-12).sum(axis=0).min() >= dimension(name)  # each face has its corners
    inside = RNG.dirichlet(np.ones(len(shape.corners)), 100) @ shape.corners
    gap, normal = shape.look(inside)
    assert gap.max() < 0
    assert np.abs(shape.look(inside - 1.000001 * gap[:, None] * normal)[0]).max() < 1e-5  # that way it is out


@pytest.mark.parametrize("name", SHAPES)
def test_support_bounds_the_shape_and_is_reached(name: str) -> None:
    shape, d = SHAPES[name], dimension(name)
    if isinstance(shape, HalfSpace):
        assert shape.support(3 * shape.normal) == pytest.approx(3 * shape.offset, rel=1e-15)
        assert shape.support(-shape.normal) == np.inf
        return
    x = RNG.uniform(-2, 2, (300, d))
    gap, normal = shape.look(x)
    feet = (x - gap[:, None] * normal)[gap > 0]
    for n, foot in zip(normal[gap > 0], feet, strict=True):
        assert shape.support(n) == pytest.approx(n @ foot, abs=1e-14)  # the normal at a foot supports the shape there
        assert (feet @ n).max() <= shape.support(n) + 1e-14  # rounding


def test_touching_and_corners_have_exact_values() -> None:
    box = Polytope.box(np.zeros(2), np.array([2.0, 1.0]))
    gap, normal = box.look(np.array([[2.0, 0.5], [1.0, 1.0], [5.0, 5.0], [1.0, 0.75], [3.0, 0.25]]))
    assert gap.tolist() == [0.0, 0.0, 5.0, -0.25, 1.0]
    assert normal.tolist() == [[1, 0], [0, 1], [0.6, 0.8], [0, 1], [1, 0]]
    cube = Polytope.hull(np.array([[i, j, k] for i in (0.0, 1.0) for j in (0.0, 1.0) for k in (0.0, 1.0)]))
    assert len(cube.normals) == 6  # coplanar triangles of the hull are one face
    assert cube.look(np.array([[2.0, 2.0, 0.5]]))[0] == pytest.approx(np.sqrt(2), rel=1e-15)
    ball = Ball(np.zeros(3), 1.0)
    assert ball.look(np.zeros((1, 3)))[0] == -1.0
    assert ball.look(np.zeros((1, 3)))[1].tolist() == [[1, 0, 0]]


@pytest.mark.parametrize(
    ("begin", "end", "words"),
    [
        ((-0.5, 0.05), (0.5, 0.05), "time.steps by a factor of at least 10"),  # through the ball
        ((-0.5, 0.099), (0.5, 0.099), "time.steps by a factor of at least 10"),
        ((-0.5, 0.101), (0.5, 0.101), ""),  # past it, on a line that leaves it aside
        ((0.0, 0.1), (0.3, 0.1), ""),  # along it from where it touches
        ((-0.12, 0.01), (0.05, 0.01), "time.steps by a factor of at least 2"),  # in, and on the way out
        ((-0.5, 0.4), (0.5, 0.4), ""),  # past it: the ends are farther from it than the way is long
        ((-0.12, 0.0), (-0.05, 0.0), ""),  # in: the gap shows it
        ((0.5, 0.0), (0.6, 0.0), ""),
    ],
)  # fmt: skip
def test_a_step_that_could_pass_through_an_obstacle_is_refused(
    begin: tuple[float, float], end: tuple[float, float], words: str
) -> None:
    still = Obstacle("pin", "disc", Ball(np.zeros(2), 0.1), None)
    way = np.array(end) - begin
    moving = Obstacle("pin", "disc", Ball(np.zeros(2), 0.1), lambda t, order: -t * way)  # the same seen from the point
    for obstacle, last in ((still, end), (moving, begin)):
        places = np.array([begin]), np.array([last])
        gaps = [np.array([obstacle.gap(x, t)]) for x, t in zip(places, (0.0, 1.0), strict=True)]
        with pytest.raises(SolverError, match=words) if words else nullcontext():
            check_passage((obstacle,), gaps[0], gaps[1], places, (0.0, 1.0))
