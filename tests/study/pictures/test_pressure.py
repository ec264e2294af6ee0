"""Arrows of the pressure of contact in pictures of 3D scenes."""

from __future__ import annotations

import softgrasp.fem

# isort: split
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.quiver import Quiver

import softgrasp as sg
from softgrasp.fem import HalfSpace, Obstacle
from softgrasp.fem.fields.picture import PictureMesh
from softgrasp.study.pictures.body import draw_surroundings, legend, make_view
from softgrasp.study.pictures.obstacles import ARROWS, far_apart
from softgrasp.study.pictures.shapes import ELEVATION
from tests.study.pictures.test_plots import cube

pytestmark = pytest.mark.serial  # no communication here

TABLE = Obstacle("table", "halfspace", HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0), None)


def plane(n: int = 21) -> PictureMesh:
    """The unit cube held above, with more vertices below than get arrows; no cells between."""
    i, j = (a.ravel() / (n - 1) for a in np.meshgrid(np.arange(n), np.arange(n)))
    below = np.column_stack([i, j, np.zeros(n * n)])
    body = cube()
    facets = body.facets[(body.points[body.facets][..., 2] == 1.0).all(axis=1)]
    return replace(body, points=np.vstack([body.points, below]), contact=facets, obstacles=(TABLE,))


def test_arrows_in_space_are_few_far_apart_and_as_long_as_the_pressure_seen_from_the_side() -> None:
    picture = plane()
    below = picture.points[:, 2] == 0.0
    tractions = np.zeros((2, *picture.points.shape))
    tractions[0, below, 2] = 1e3 * (1.0 + picture.points[below, 0])  # [Pa], at most 2 kPa
    tractions[1, below, 2] = np.where(picture.points[below, 0] < 0.5, 500.0, 0.0)
    order = far_apart(picture, tractions)
    assert picture.points[order[0], 0] == 1.0  # where the pressure is largest
    first = picture.points[order[:ARROWS]]
    apart = np.linalg.norm(first[:, None] - first, axis=2)[np.triu_indices(ARROWS, 1)].min()
    gaps = np.linalg.norm(picture.points[below][:, None] - first, axis=2).min(axis=1)
    assert gaps.max() <= apart + 1e-12  # no place is farther from an arrow than two arrows from each other; rounding
    states, times = np.zeros_like(tractions), np.array([0.0, 1.0])
    move = make_view(picture, states, times, np.zeros((2, 4)), None, tractions)
    lengths = []
    for k in (0, 1):
        _, ax = plt.subplots()
        draw_surroundings(ax, move, [k])
        (arrows,) = [each for each in ax.collections if isinstance(each, Quiver)]
        assert np.abs(arrows.U).max() < 1e-15  # upright; rounding of the projection
        lengths.append(np.array(arrows.V))
        plt.close("all")
    assert [len(v) for v in lengths] == [ARROWS, ARROWS]
    assert lengths[0].max() == pytest.approx(0.3 * np.cos(np.radians(ELEVATION)))  # of the smallest side, 1 m
    np.testing.assert_allclose(lengths[1], lengths[0].max() / 4)  # 500 Pa of 2 kPa


@pytest.mark.parametrize(("way", "seen"), [([0.0, 0.0, -0.1], False), ([0.0, 0.0, -3.0], True)])
def test_the_legend_has_the_pressure_and_the_path_where_it_shows(way: list[float], seen: bool) -> None:
    """A cube of 1 m hides what lies within it and its plate, not the 3 m it comes down."""
    picture = plane()
    table = np.column_stack([[0.0, 1.0], np.outer([0.0, 1.0], way)])
    states = np.repeat(table[:, None, 1:], len(picture.points), axis=1)
    tractions = np.zeros_like(states)
    tractions[1, picture.points[:, 2] == 0.0, 2] = 2e3
    figure = plt.figure(layout="compressed")
    legend(figure, make_view(picture, states, np.array([0.0, 1.0]), table, None, tractions))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    plt.close(figure)
    assert "pressure, at most 2 kPa" in words
    assert ("path of the hand" in words) is seen


def test_a_run_draws_force_gap_and_nodes_of_its_obstacles() -> None:
    run = sg.simulate(sg.build("set_down", ["tissue.cells=[6, 4]", "time.steps=60"]))
    force, gap, nodes = run.plot_contact().axes
    assert run.contact is not None
    gaps = gap.lines[0].get_ydata()
    assert gaps[0] / gaps.max() == pytest.approx(1.0)  # the block comes down from there
    np.testing.assert_allclose(gaps, 1e3 * run.contact.gap[:, 0])  # [mm]
    assert force.lines[0].get_ydata()[-1] == pytest.approx(run.contact.force_end[0, 1])
    assert nodes.patches[0].get_data().values[-1] == 7  # all vertices of the bottom
    free = sg.simulate(sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=6"]))
    with pytest.raises(sg.fem.SoftgraspError, match="no obstacles"):
        free.plot_contact()
