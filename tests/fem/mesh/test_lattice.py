"""Coarser copies of large mesh files: what a pass over the cells measures, and the body on lattice cells."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softgrasp.fem.mesh.check import signed_volumes, sizes_of
from softgrasp.fem.mesh.file import Body
from softgrasp.fem.mesh.lattice import LatticeCopy, lattice_copy

pytestmark = pytest.mark.serial


def cut_box(counts: list[int]) -> tuple[Any, Any]:
    """Nodes and simplices of a unit box of so many cells, without the mesh generator that the program uses."""
    d = len(counts)
    lattice = np.stack(np.meshgrid(*(np.arange(n + 1) for n in counts), indexing="ij"), axis=-1).reshape(-1, d)
    lowest = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, d)
    shape, cells = [n + 1 for n in counts], []
    orders = ([0, 1], [1, 0]) if d == 2 else ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2])
    for order in orders:
        steps = np.cumsum(np.vstack([np.zeros((1, d), dtype=int), np.eye(d, dtype=int)[order]]), axis=0)
        cells.append(np.stack([np.ravel_multi_index(tuple((lowest + step).T), shape) for step in steps], axis=1))
    points, simplices = lattice / np.array(counts), np.concatenate(cells)
    turned = signed_volumes(points, simplices) < 0
    simplices[np.ix_(turned, [d - 1, d])] = simplices[np.ix_(turned, [d, d - 1])]
    return points, simplices


def body(points: Any, cells: Any, tags: Any = None, facets: Any = None) -> Body:
    d = points.shape[1]
    marked = np.zeros((0, d), dtype=np.int64) if facets is None else facets
    marks = None if facets is None else np.zeros(len(facets), dtype=np.int32)
    return Body(Path("a.msh"), points, cells, tags, marked, marks, {}, {1: (0,)} if facets is not None else {}, ())


def copied(given: Body, most: int, boxes: Any = ()) -> LatticeCopy:
    copy = lattice_copy(given, most, boxes)
    assert copy is not None
    assert (signed_volumes(copy.arrays.points, copy.arrays.cells) > 0).all()
    return copy


@pytest.mark.parametrize("counts", [[13, 9], [7, 5, 9]])
def test_a_box_is_copied_exactly(counts: list[int]) -> None:
    """Lattice cells fill a box; the nodal normals of its nodes name those on the sides and add up to the surface."""
    points, cells = cut_box(counts)
    d = len(counts)
    copy = copied(body(points, cells), 40)
    on_side = ((points == 0) | (points == 1)).any(axis=1)
    np.testing.assert_array_equal(copy.ends, on_side)
    flat = ((points == 0) | (points == 1)).sum(axis=1) == 1  # at edges normals of two sides add up as vectors
    inner = np.prod([(n - 1) / n for n in counts]) * sum(2 * n / (n - 1) for n in counts)  # their share of the sides
    assert copy.area[flat].sum() == pytest.approx(inner, rel=1e-12)
    assert copy.volume == pytest.approx(0, abs=1e-12)  # rounding
    assert sizes_of(copy.arrays.points, copy.outer).sum() == pytest.approx(2.0 * d, rel=1e-12)


@pytest.mark.parametrize(("counts", "most"), [([40, 40], 150), ([16, 16, 16], 300)])
def test_a_round_body_keeps_its_volume(counts: list[int], most: int) -> None:
    """A disc and a ball made of a box; lattice cells whose corners do not move have 27 % and 50 % more surface."""
    points, cells = cut_box(counts)
    x = 2 * points - 1
    longest = np.abs(x).max(axis=1, keepdims=True)
    x *= longest / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    cells = cells[signed_volumes(x, cells) > 0]
    copy = copied(body(x, cells), most)
    assert abs(copy.volume) < 0.02  # measured 0.1 % and 0.4 %
    assert abs(copy.surface) < 0.15  # measured 4 % and 13 %


def test_tags_and_notes_pass_to_the_copy() -> None:
    """Two materials that meet between lattice lines at the nearest of them, and the facets of one side."""
    points, cells = cut_box([8, 8, 8])
    tags = (points[cells].mean(axis=1)[:, 0] > 0.5).astype(np.int32)
    sides = np.sort(np.concatenate([np.delete(cells, i, axis=1) for i in range(4)]), axis=1)
    facets = np.unique(sides[(points[sides][:, :, 2] == 0).all(axis=1)], axis=0)
    straightened = ("straightened cells change the volume by 0.1 %",)
    copy = copied(replace(body(points, cells, tags, facets), notes=straightened), 64)
    assert copy.arrays.known["notes"] == straightened
    _, own, marks = copy.arrays.marks["cell_tags"]
    volumes = signed_volumes(copy.arrays.points, own)
    assert marks is not None
    assert volumes[marks == 1].sum() == pytest.approx(0.5, rel=1e-12)
    _, tagged, _ = copy.arrays.marks["facet_tags"]
    assert (copy.arrays.points[tagged][:, :, 2] == 0).all()
    assert sizes_of(copy.arrays.points, tagged).sum() == pytest.approx(1.0, rel=1e-12)


def test_no_copy_of_inverted_cells_or_without_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    points, cells = cut_box([6, 6])
    assert lattice_copy(body(points, cells[:, [0, 2, 1]]), 16, ()) is None
    monkeypatch.setattr("softgrasp.fem.mesh.lattice.functions", lambda *_: None)
    assert lattice_copy(body(points, cells), 16, ()) is None


def test_no_copy_of_a_thin_body_across_the_box_around_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rod along the diagonal, of 1e-3 of its length: 2e8 lattice cells, all but a few hundred of them empty."""
    points, cells = cut_box([2, 2, 40])
    points = points * [1e-3, 1e-3, 1.0]
    monkeypatch.setattr("softgrasp.fem.mesh.lattice._measured", lambda *_: pytest.fail("they are filled"))
    assert lattice_copy(body(points + points[:, 2:] * [1, 1, 0], cells), 250, ()) is None
