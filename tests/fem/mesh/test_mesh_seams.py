"""Meshes that are open although their cells touch: doubled and hanging nodes; and tags of any size."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from scipy.sparse import coo_array, csgraph

from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh import check
from softgrasp.fem.mesh.check import doubled_nodes, outer_facets, place_text, quality, sort_facets
from softgrasp.fem.mesh.file import read_mesh
from softgrasp.fem.model.contact import cells_in, contact_facets, held_check
from tests.fem.mesh.test_mesh import COMM, WIDE, area, grid, volume, write, zone

BOX = {2: 6.0, 3: 10.0}  # boundary of (0,1) x (0,2) (x (0,1)): 2 (1 + 2), and 2 (1 2 + 1 1 + 1 2)


def torn(dimension: int, n: int, tip: float, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`grid` with a node of its own for the cells above y = 1 wherever x > tip, moved by `shift`; facets as there."""
    points, cells, facets = grid(dimension, n)
    seam = np.flatnonzero((points[:, 1] == 1) & (points[:, 0] > tip))
    number = np.arange(len(points))
    number[seam] = len(points) + np.arange(len(seam))
    upper = points[cells].mean(axis=1)[:, 1] > 1
    cells[upper] = number[cells[upper]]
    above = points[facets].mean(axis=1)[:, 1] > 1
    facets[above] = number[facets[above]]
    return np.vstack([points, points[seam] + shift]), cells, facets


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("tip", [-1.0, 0.25])
def test_a_seam_of_doubled_nodes_is_named_and_joined(mpi_tmp_path: Path, dimension: int, tip: float) -> None:
    """Open, the boundary has both sides of the crack more than the box; joined, it is that of the box."""
    n, d = 4, dimension
    doubled = (5 if tip < 0 else 3) * 5 ** (d - 2)
    path = write(mpi_tmp_path / "a.vtu", *torn(d, n, tip, shift=1e-7))
    tissue = read_mesh(COMM, path)
    (note,) = tissue.notes
    low, high = [0.0 if tip < 0 else 0.5, 1.0, 0.0], [1.0, 1.0, 1.0]
    ends = " and ".join(place_text(np.array(x[:d])) for x in (low, high))
    assert f"has {doubled} doubled nodes between {ends}, closer" in note
    assert "tissue.repair = true" in note
    whole = zone(box=[[-1] * d, [3] * d])
    crack = 2 * (1.0 - max(tip, 0.0))
    assert area(tissue, contact_facets(tissue, whole)) == pytest.approx(BOX[d] + crack, rel=1e-6)  # the shift is 1e-7
    joined = read_mesh(COMM, path, repair=True)
    assert f"{path} had {doubled} doubled nodes between {ends}" in joined.notes[0]
    assert "tissue.repair joined them" in joined.notes[0]
    assert joined.parts is None
    assert joined.mesh.geometry.index_map().size_global == (n + 1) ** d
    assert area(joined, contact_facets(joined, whole)) == pytest.approx(BOX[d], rel=WIDE)
    assert area(joined, contact_facets(joined, zone(facet_tag=5))) == pytest.approx(2.0, rel=WIDE)
    assert read_mesh(COMM, path, seam=1e-8).notes == ()
    held_check(joined, contact_facets(joined, zone(["y-"])))
    if tip < 0:
        with pytest.raises(MeshError, match=r"tissue\.repair = true joins doubled nodes"):
            held_check(tissue, contact_facets(tissue, zone(["y-"])))


@pytest.mark.parametrize("dimension", [2, 3])
def test_hanging_nodes_are_named(mpi_tmp_path: Path, dimension: int) -> None:
    """Below y = 1 cells of 1/2, above of 1/4: every node of the finer side that the other has not hangs."""
    coarse, fine = grid(dimension, 2), grid(dimension, 4)
    low = coarse[1][coarse[0][coarse[1]].mean(axis=1)[:, 1] < 1]
    high = fine[1][fine[0][fine[1]].mean(axis=1)[:, 1] > 1]
    every = np.vstack([coarse[0], fine[0]])
    points, number = np.unique(every, axis=0, return_inverse=True)
    cells = number.ravel()[np.vstack([low, high + len(coarse[0])])]
    path = write(mpi_tmp_path / "a.vtu", points, cells)
    (note,) = read_mesh(COMM, path, repair=True).notes
    hanging = 5 ** (dimension - 1) - 3 ** (dimension - 1)
    assert f"{hanging} hanging nodes between" in note
    middle = ", 1, " if dimension == 3 else ", 1) "
    assert middle in note


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_conforming_mesh_warns_of_nothing(mpi_tmp_path: Path, dimension: int) -> None:
    points, cells, _ = grid(dimension, 4)
    points[:, 0] = points[:, 0] ** 6  # cells of width 2e-4 beside cells of 0.8
    assert read_mesh(COMM, write(mpi_tmp_path / "a.vtu", points, cells)).notes == ()


@pytest.mark.serial
@pytest.mark.parametrize("pairs", [check.MOST_PAIRS, 0])
def test_many_copies_of_a_node_are_one_place(pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Triangles that share nothing: every corner has as many copies as cells meet there, as pairs or a tree find."""
    monkeypatch.setattr(check, "MOST_PAIRS", pairs)
    points, cells, _ = grid(2, 3)
    apart = np.arange(cells.size).reshape(cells.shape)
    first = doubled_nodes(points[cells.ravel()], apart, sort_facets(apart), 1e-4)
    assert len(np.unique(first)) == len(points)
    assert np.array_equal(points[cells.ravel()], points[cells.ravel()][first])


@pytest.mark.serial
@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("tip", [-1.0, 0.25, 2.0])
def test_the_boundary_is_found_without_sorting_all_facets(dimension: int, tip: float) -> None:
    """Against all facets sorted: a box torn apart, half or whole; and one facet of three cells, which is no end."""
    points, cells, _ = torn(dimension, 6, tip)
    everything, few = sort_facets(cells), outer_facets(cells, len(points))
    assert np.array_equal(few.nodes[few.outer], everything.nodes[everything.outer])
    assert np.array_equal(few.cells[few.outer], everything.cells[everything.outer])
    assert len(few.nodes) < len(everything.nodes)
    inner = np.flatnonzero(everything.same)[0]
    third = np.append(everything.nodes[inner], len(points))
    crowded = outer_facets(np.vstack([cells, third]), len(points) + 1)
    assert not (crowded.nodes[crowded.outer] == everything.nodes[inner]).all(axis=1).any()


@pytest.mark.serial
@pytest.mark.parametrize("dimension", [2, 3])
def test_shapes_of_cells_are_those_of_determinants(dimension: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled, against NumPy's determinants; nan where a corner is, zero where all are one."""
    random = np.random.default_rng(3)
    points, cells = random.normal(size=(60, dimension)), random.integers(1, 60, (500, dimension + 1))
    points[0] = np.nan
    cells[0], cells[1, 0] = 5, 0
    shape = quality(points, cells)
    monkeypatch.setattr(check, "_compiled", lambda: None)
    with np.errstate(invalid="ignore"):
        expected = quality(points, cells)
    np.testing.assert_allclose(shape, expected, rtol=0, atol=1e-14)  # sums of three products
    assert (shape[0], np.isnan(shape[1])) == (0, True)


@pytest.mark.serial
def test_linked_items_have_the_smallest_number_of_their_part() -> None:
    """Against SciPy's graphs: a path in random order, which the numbers pass along, and links at random."""
    n, random = 2000, np.random.default_rng(7)
    path = random.permutation(n)
    for one, other in ((path[:-1], path[1:]), random.integers(0, n, (2, n // 2))):
        graph = coo_array((np.ones(len(one)), (one, other)), shape=(n, n))
        _, parts = csgraph.connected_components(graph, directed=False)
        _, first = np.unique(parts, return_index=True)
        assert np.array_equal(check.linked(one, other, n), first[parts])


@pytest.mark.parametrize("tags", [(2**32 + 3, 3), (2**63 + 1, 2**63 + 2), (-(2**40), 2**40)])
def test_tags_beyond_32_bit_stay_apart(mpi_tmp_path: Path, tags: tuple[int, int]) -> None:
    points, cells, _ = grid(2, 4)
    upper = points[cells].mean(axis=1)[:, 1] > 1
    kind = np.uint64 if max(tags) >= 2**63 else np.int64
    path = mpi_tmp_path / "a.vtu"
    if COMM.rank == 0:
        values = np.where(upper, np.array(tags[0], dtype=kind), np.array(tags[1], dtype=kind))
        meshio.write(
            path, meshio.Mesh(np.pad(points, ((0, 0), (0, 1))), [("triangle", cells)], cell_data={"a": [values]})
        )
    COMM.barrier()
    tissue = read_mesh(COMM, path)
    for tag, chosen in zip(tags, (upper, ~upper), strict=True):
        found = cells_in(tissue, SimpleNamespace(tag=tag, box=None))
        assert COMM.allreduce(len(found)) == chosen.sum()
    assert volume(tissue) == pytest.approx(2.0, rel=WIDE)
