"""Which node an output takes, and what the mean of a region counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.run.simulate import simulate
from tests.helpers.models import CUBE, gather_rows, make_scene

pytestmark = pytest.mark.ranks


def outputs(*entries: dict[str, Any]) -> dict[str, Any]:
    return {"control": {"outputs": list(entries)}}


@pytest.mark.parametrize(
    ("point", "place"),
    [
        ([0.25, 0.25], "node (0.25, 0.25)"),
        ([0.375, 0.25], "node (0.25, 0.25), one of 2 equally near to (0.375, 0.25)"),
        ([0.375, 0.375], "node (0.25, 0.25), one of 4 equally near to (0.375, 0.375)"),
        ([0.3, 0.25], "node (0.25, 0.25), nearest to (0.3, 0.25)"),
        ([0.0, 2.0], "node (0.25, 2), nearest to (0, 2); a nearer one is bonded to the hand"),
    ],
)
def test_the_node_that_is_taken_is_named(comm: MPI.Intracomm, point: list[float], place: str) -> None:
    (output,) = make_outputs(
        make_scene(outputs({"kind": "node", "point": point})), build(make_scene(), comm=comm).system
    )
    assert output.place == place


def test_the_free_end_taken_without_outputs_says_what_it_ties_with(comm: MPI.Intracomm) -> None:
    """Held on its left side, the body is farthest at its lower right corner alone; held on two, at both corners."""
    places = []
    for sides in (["left"], ["left", "right"]):
        scene = make_scene({"contact": {"sides": sides}})
        places.append(make_outputs(scene, build(scene, comm=comm).system)[0].place)
    assert places == [
        "node (1, 0), the free one farthest from the hand",
        "node (0, 0), one of the 2 free ones farthest from the hand",
    ]


TURN = {"effects": {"rotation": True}, "motion": {"target": [0.3, 0.2, 0.1]}}
TURN_3D = CUBE | {"effects": {"rotation": True}}


@pytest.mark.parametrize(
    ("tables", "box", "held", "count"),
    [
        ({}, [[0.0, 1.0], [1.0, 2.0]], 6, 25),  # two sides from y = 1.5 up
        (TURN, [[0.0, 1.0], [1.0, 2.0]], 6, 25),
        (TURN_3D, [[0.0, 0.0, 0.2], [1.0, 0.8, 0.6]], 9, 27),  # the top
        ({}, [[0.0, 0.0], [1.0, 0.5]], 0, 15),
    ],
)
def test_nodes_of_a_region_that_the_hand_holds_count(
    comm: MPI.Intracomm, tables: dict[str, Any], box: list[list[float]], held: int, count: int
) -> None:
    """The mean of all nodes of the box, from the absolute displacements of the tissue and of the hand."""
    scene = make_scene(tables, outputs({"kind": "region", "box": box, "name": "part"}), time={"steps": 40})
    model = build(scene, comm=comm)
    (output,) = make_outputs(scene, model.system)
    assert output.place == f"mean of {count} nodes" + (f", {held} of them bonded to the hand" if held else "")
    run = simulate(model)
    assert run.snapshots is not None
    layout, d = model.system.layout, model.system.layout.dimension
    u = gather_rows(layout, run.snapshots.displacement(model.system.T)).T.reshape(41, -1, d)
    nodes = gather_rows(layout, layout.nodes.ravel()).reshape(-1, d)
    low, high = np.array(box[0]) - 1e-9, np.array(box[1]) + 1e-9
    total = u[:, ((nodes >= low) & (nodes <= high)).all(axis=1)].sum(axis=1)
    every = np.concatenate(comm.allgather(layout.held))
    for x in every[((every >= low) & (every <= high)).all(axis=1)]:
        r = np.pad(x - layout.reference, (0, 3 - d))
        turned = np.zeros((41, 3))
        if d == 2 and layout.n_s == 3:
            turned[:, 2] = run.q_s[:, 2]
        elif layout.n_s == 6:
            turned = run.q_s[:, 3:]
        total += run.q_s[:, :d] + np.cross(turned, r)[:, :d]
    np.testing.assert_allclose(run.outputs, total / count, rtol=0, atol=1e-12)  # a few dozen sums of lengths near 1 m
