"""Plans for some nodes of the boundary: what keeps the gaps, what is proved, what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.obstacles.shapes import Ball
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained.separation import gaps, separate
from softgrasp.lqr.constrained.tissue import modal_tissue
from softgrasp.lqr.design.body import body_surface
from softgrasp.lqr.design.constrained import PlannedControl, plan_control, plan_sizes
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.scene import problem
from softgrasp.lqr.plant.checks import ControlError

SMALL = ("tissue.cells=[2,4]", "control.constraints.N=14", "control.constraints.parts=4", "control.loop.rate=100")


def planned(*changes: str) -> PlannedControl:
    model = build(load_scene("paper_obstacle", [*SMALL, *changes]))
    return plan_control(design(model), Stopwatch(model.system.layout.comm))


def test_two_nodes_keep_their_gaps_and_the_rest_need_not() -> None:
    found = planned("control.constraints.body=['tip', [0, 0]]")
    run, task, surface = found.runs.planned, found.plan.task, found.surface
    assert found.plan.certified
    assert surface.kept is not None
    assert np.allclose(
        sorted(surface.nodes[surface.kept].tolist()), [[0.0, 0.0], [0.5, 0.0]], atol=1e-12
    )  # of the mesh
    assert task.places.shape == task.error.shape == (2, 2)
    ends = run.body[:, surface.kept]
    disc = task.shapes[0]
    assert isinstance(disc, Ball)
    # nearest point of a segment to the centre, by the foot of the perpendicular
    along = ends[:, 1] - ends[:, 0]
    part = np.clip(np.einsum("td,td->t", disc.center - ends[:, 0], along) / (along**2).sum(axis=1), 0, 1)
    exact = np.linalg.norm(ends[:, 0] + part[:, None] * along - disc.center, axis=1) - disc.radius
    assert np.allclose(run.gaps[:, 0], exact, atol=1e-12)  # rounding at places of some metres
    assert exact.min() >= 0
    every = task.gaps(run.body, run.times).min(axis=0)
    assert (every < -0.1).all()  # the corner that was not named goes through
    assert found.online is not None
    assert found.online.gaps.min() >= 0


def test_all_nodes_by_their_points_are_the_boundary() -> None:
    model = build(load_scene("paper_obstacle", list(SMALL)))
    nodes = body_surface(model).nodes
    named = planned(f"control.constraints.body={np.round(nodes, 9).tolist()}")
    whole = planned()
    assert np.array_equal(named.plan.task.error, whole.plan.task.error)
    assert np.allclose(named.plan.c, whole.plan.c, rtol=0, atol=1e-12)  # rounding of the active set


@pytest.mark.parametrize("points", [[[0.5, 0.3]], [[0.5, 0.0], [0.5, 0.25], [0.5, 0.5]]])
def test_a_body_that_encloses_nothing_has_a_gap(points: list[list[float]]) -> None:
    body, disc = np.array(points), Ball(np.array([0.4, 0.2]), 0.05)
    exact = np.hypot(0.1, max(0.0, body[:, 1].min() - 0.2)) - 0.05
    normal, gap = separate(disc, body)
    assert abs(gap - exact) < 1e-14  # rounding
    assert abs(gaps(disc, body[None])[0] - exact) < 1e-14
    assert abs((body @ normal).min() - normal @ disc.center - 0.05 - exact) < 1e-14


@pytest.mark.ranks(2)
def test_ranks_pick_the_same_nodes_in_the_order_of_their_surface() -> None:
    text = "control.constraints.body=[[1, 0], 'tip', [0, 2], [0, 1]]"
    model = build(load_scene("paper_obstacle", [*SMALL, text]))
    near = body_surface(model).keeping()
    order = np.lexsort(near.nodes.T)
    assert np.allclose(near.nodes[order], [[0.5, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 2.0]], atol=1e-12)
    assert near.free == 3
    assert np.allclose(near.nodes[3], [0, 2], atol=1e-12)  # that of the hand comes last
    tissue, whole = modal_tissue(problem(model), near), modal_tissue(problem(model), body_surface(model))
    kept = body_surface(model).kept
    assert kept is not None
    assert np.allclose(np.abs(tissue.seen), np.abs(whole.seen[kept]), atol=1e-12)
    sizes = plan_sizes(model)
    assert sizes is not None
    assert sizes.rows == sizes.intervals * (2 * 5 * 4 + 8)


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ("[[9, 0]]", r"body\[0\] = \[9.0, 0.0\] lies outside the body"),
        ("['tap']", "'tap' is no output of kind node; these are tip"),
        ("['tip', [0.5, 0.01]]", r"names the node \[0.5, 0.0\] a second time"),
        ("[[0, 0, 0]]", "must have 2 entries"),
    ],
)
def test_what_is_no_node_of_the_boundary_is_refused(body: str, sentence: str) -> None:
    with pytest.raises(ControlError, match=sentence):
        body_surface(build(load_scene("paper_obstacle", [*SMALL, f"control.constraints.body={body}"])))


def test_an_output_inside_the_body_keeps_no_gap() -> None:
    inside = "control.outputs=[{kind='node', point=[0.5, 1.0], name='middle'}]"
    model = build(load_scene("paper_obstacle", [*SMALL, inside, "control.constraints.body=['middle']"]))
    with pytest.raises(ControlError, match="'middle' is a node inside the body"):
        body_surface(model)
