"""The hand of a 3D scene lies outside of the body on what it holds, and every body fills its frame."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem import PictureMesh, gather_picture
from softgrasp.fem.model.build import build
from softgrasp.study.pictures.animation import followed, render
from softgrasp.study.pictures.body import make_view
from softgrasp.study.pictures.plate import PAD, THICK, around_bodies, hand_plate
from softgrasp.study.pictures.shapes import seen
from tests.helpers.models import CUBE, make_scene

pytestmark = pytest.mark.serial


@pytest.fixture(scope="module")
def cube() -> PictureMesh:
    picture = gather_picture(build(make_scene(CUBE), comm=MPI.COMM_SELF))
    assert picture is not None
    return picture


def test_the_plate_is_a_slab_above_the_held_side_and_moves_with_the_hand(cube: PictureMesh) -> None:
    """The hand holds z = 0.6 of 1 m x 0.8 m x 0.6 m, which the viewer sees."""
    behind, before = hand_plate(cube, np.zeros(3))
    assert behind == []
    corners = np.vstack(before)
    np.testing.assert_allclose(corners.min(axis=0), [0.0, 0.0, 0.6], atol=1e-12)
    np.testing.assert_allclose(corners.max(axis=0), [1.0, 0.8, 0.6 + THICK * 0.6], atol=1e-12)
    moved = np.vstack(hand_plate(cube, np.array([0.3, -0.1, 0.2]))[1])
    np.testing.assert_allclose(moved - corners, np.tile([0.3, -0.1, 0.2], (len(corners), 1)), atol=1e-12)


def test_frames_hold_the_body_and_the_hand_and_have_one_size(cube: PictureMesh) -> None:
    hands = np.array([[0.0, 0.0, 0.0], [3.0, 2.0, 5.0]])
    states = np.array([cube.rigid(q) for q in hands])
    (low, high), (low_2, high_2) = around_bodies(cube, states, hands)
    np.testing.assert_allclose(high - low, high_2 - low_2)
    np.testing.assert_allclose(low_2 - low, seen(hands[1]), atol=1e-12)
    points = seen(np.vstack([cube.points, *hand_plate(cube, hands[0])[1]]))
    np.testing.assert_allclose(high - low, (1 + 2 * PAD) * np.ptp(points, axis=0))


def test_a_film_goes_with_a_body_that_moves_far(cube: PictureMesh) -> None:
    """Three sizes away, or along a level way, each frame shows it as large as the frame around it; nearby it rests."""
    times, u = np.linspace(0.0, 1.0, 5), np.zeros((5, *cube.points.shape))
    coloured = []
    for way, moves in (((3.0, 3.0, 3.0), True), ((4.0, 0.0, 0.0), True), ((0.2, 0.2, 0.2), False)):
        hands = times[:, None] * np.array(way)
        states = u + hands[:, None, :] + 0.05 * np.linspace(0.0, 1.0, len(cube.points))[:, None]
        move = make_view(cube, states, times, np.column_stack([times, hands]), None)
        assert len(followed(move, states)) == (5 if moves else 0)
        images = [np.asarray(image, dtype=int) for image in render(move, states, times)]
        coloured.append([float((np.ptp(image, axis=2) > 60).mean()) for image in images])
    far, level, near = coloured
    assert min(*far, *level) > 0.15  # of the picture, the colour bar included
    assert min(far) > min(near)
