"""Exponents of corners and where a body has them."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest

from softgrasp.fem.mesh.grading import STEEPEST, SizeField, graded_line
from softgrasp.fem.mesh.singular import Ends, exponents, singular_ends

pytestmark = pytest.mark.serial  # numpy only


def grid(counts: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Points and Kuhn simplices of a box of unit cells, made without DOLFINx."""
    d = len(counts)
    points = np.array(list(product(*(range(n + 1) for n in counts))), dtype=float)
    strides = np.array([np.prod([n + 1 for n in counts[i + 1 :]], dtype=int) for i in range(d)])
    cells = []
    for corner in product(*(range(n) for n in counts)):
        for order in permutations(range(d)):
            path = [np.array(corner)]
            for axis in order:
                path.append(path[-1] + np.eye(d, dtype=int)[axis])
            cells.append([int(node @ strides) for node in path])
    return points, np.array(cells)


def boundary(cells: np.ndarray) -> np.ndarray:
    facets = np.sort(np.concatenate([np.delete(cells, i, axis=1) for i in range(cells.shape[1])]), axis=1)
    unique, count = np.unique(facets, axis=0, return_counts=True)
    return unique[count == 1]


@pytest.mark.parametrize(
    ("degrees", "nu", "held", "alpha"),
    [
        # clamped to free at a flat side: 1/2 for every nu; at a right angle from tables of [W52]'s equation
        (180, 0.25, 1, 0.5), (180, 0.49, 1, 0.5), (90, 0.25, 1, 0.745), (90, 0.4, 1, 0.650), (90, 0.49, 1, 0.600),
        # free: the L-shape's 0.5445 and the crack's 1/2, nothing below 180 degrees
        (270, 0.3, 0, 0.5445), (360, 0.3, 0, 0.5), (120, 0.3, 0, 1.0), (270, 0.1, 0, 0.5445),
        # both sides held at a crack: 1/2 again
        (360, 0.3, 2, 0.5),
    ],
)  # fmt: skip
def test_exponents_are_those_of_the_literature(degrees: float, nu: float, held: int, alpha: float) -> None:
    (found,) = exponents(np.deg2rad([degrees]), np.array([nu]), np.array([held]))
    assert found == pytest.approx(alpha, abs=6e-4)  # digits of the tables


def test_block_has_its_four_ends() -> None:
    points, cells = grid((2, 4))
    sides = np.array(
        [f for f in boundary(cells) if np.isin(points[f][:, 0], (0, 2)).all() and points[f][:, 1].min() >= 3]
    )
    sides = np.array([f for f in sides if np.ptp(points[f][:, 0]) == 0])
    ends = singular_ends(points, cells, sides, np.full(len(cells), -1), np.full(len(cells), 0.25))
    places = sorted((*map(float, at[0]), round(float(a), 2)) for at, a in zip(ends.at, ends.alpha, strict=True))
    assert places == [(0.0, 3.0, 0.5), (0.0, 4.0, 0.74), (2.0, 3.0, 0.5), (2.0, 4.0, 0.74)]
    assert set(ends.kind) == {"contact end"}


def test_re_entrant_corner_and_layer_ends() -> None:
    points, cells = grid((4, 4))
    middle = points[cells].mean(axis=1)
    kept = ~((middle[:, 0] > 2) & (middle[:, 1] > 2))  # an L, held at its foot
    cells = cells[kept]
    foot = np.array([f for f in boundary(cells) if points[f][:, 1].max() == 0])
    layers = np.where(points[cells].mean(axis=1)[:, 1] < 1, 0, -1)
    ends = singular_ends(points, cells, foot, layers, np.full(len(cells), 0.3))
    where = {(float(at[0, 0]), float(at[0, 1])): kind for at, kind in zip(ends.at, ends.kind, strict=True)}
    assert where == {
        (2.0, 2.0): "re-entrant", (0.0, 0.0): "contact end", (4.0, 0.0): "contact end",
        (0.0, 1.0): "layer end", (4.0, 1.0): "layer end",
    }  # fmt: skip


def test_edges_of_a_cube_held_on_top() -> None:
    points, cells = grid((2, 2, 2))
    top = np.array([f for f in boundary(cells) if points[f][:, 2].min() == 2])
    ends = singular_ends(points, cells, top, np.full(len(cells), -1), np.full(len(cells), 0.3))
    length = np.linalg.norm(ends.at[:, 1] - ends.at[:, 0], axis=1).sum()
    assert len(ends.at) == 8  # two a side
    assert length == pytest.approx(8.0)  # the rim of the top
    assert ends.distance(np.array([[1.0, 1.0, 2.0], [0.5, 0.0, 1.0]])) == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("mu", [1.0, 0.45, 0.3])
def test_lines_meet_cuts_and_crowd_at_ends(mu: float) -> None:
    line = graded_line([0.0, 1.5, 2.0], [1.5, 2.0], 30, mu, 0.5)
    h = np.diff(line)
    assert len(line) == 31
    assert {0.0, 1.5, 2.0} <= set(line)
    assert (h > 0).all()
    assert h.max() / h.min() < 1.01 * STEEPEST
    assert np.argmin(h) in {np.searchsorted(line, 1.5) - 1, np.searchsorted(line, 1.5), 29} or mu == 1.0


def test_sizes_follow_the_distance() -> None:
    end = Ends(np.array([[[0.0, 0.0]]]), np.array([np.pi]), np.array([0.5]), ("contact end",))
    h = SizeField(end, 0.1, 0.5, 0.2, 1e-4)
    r = np.array([1.0, 0.5, 0.05, 1e-9])
    assert h(np.column_stack([r, 0 * r])) == pytest.approx([0.1, 0.1, 0.1 * 0.1**0.8, 1e-4])
