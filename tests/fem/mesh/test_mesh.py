"""Meshes, mesh files and the contact zone."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import dolfinx.fem
import meshio
import numpy as np
import pytest
import ufl
from mpi4py import MPI

from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.mesh.check import check_cells, components, signed_volumes
from softgrasp.fem.mesh.file import read_mesh
from softgrasp.fem.mesh.make import make_mesh
from softgrasp.fem.mesh.tissue_mesh import TissueMesh, cell_nodes, structured_mesh
from softgrasp.fem.model.contact import cells_in, contact_blocks, contact_facets, held_check, rigid_modes
from softgrasp.fem.scene.tissue import Contact

COMM = MPI.COMM_WORLD
PILLOW = Path(__file__).parents[3] / "demos" / "scenes" / "meshes" / "pillow_small.msh"
WIDE = 1e-12  # sums of a few hundred positive terms of order one: round-off is below 1e-13


def zone(sides: Any = (), box: Any = None, facet_tag: int | None = None) -> Contact:
    return Contact.model_construct(sides=list(sides), box=box, facet_tag=facet_tag)


def integral(form: Any) -> float:
    return float(COMM.allreduce(dolfinx.fem.assemble_scalar(dolfinx.fem.form(form))))


def area(tissue: TissueMesh, facets: np.ndarray) -> float:
    tags = dolfinx.mesh.meshtags(tissue.mesh, tissue.dimension - 1, np.sort(facets), np.full(len(facets), 1, np.int32))
    ds = ufl.Measure("ds", domain=tissue.mesh, subdomain_data=tags)
    one = dolfinx.fem.Constant(tissue.mesh, 1.0)
    return integral(one * ds(1))


def volume(tissue: TissueMesh) -> float:
    return integral(dolfinx.fem.Constant(tissue.mesh, 1.0) * ufl.dx(domain=tissue.mesh))


def grid(dimension: int, n: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, cells and the facets on x = 0 of (0,1) x (0,2) (x (0,1)), made without DOLFINx."""
    from itertools import permutations, product

    shape = [n] * dimension
    size = np.array([1.0, 2.0, 1.0])[:dimension]
    index = np.arange((n + 1) ** dimension).reshape([n + 1] * dimension)
    points = np.stack(np.meshgrid(*[np.linspace(0, s, n + 1) for s in size], indexing="ij"), -1).reshape(-1, dimension)
    cells, facets = [], []
    for corner in product(*[range(k) for k in shape]):
        for order in permutations(range(dimension)):  # Kuhn's subdivision of the cube into d! simplices
            walk = [np.array(corner)]
            for axis in order:
                walk.append(walk[-1] + np.eye(dimension, dtype=int)[axis])
            cell = [int(index[tuple(p)]) for p in walk]
            if np.linalg.det(points[cell[1:]] - points[cell[0]]) < 0:
                cell[-2:] = cell[:-3:-1]
            cells.append(cell)
            left = [c for c in cell if points[c, 0] == 0]
            if len(left) == dimension:
                facets.append(left)
    return points, np.array(cells), np.array(facets)


def write(path: Path, points: np.ndarray, cells: np.ndarray, facets: np.ndarray | None = None) -> Path:
    """Write on rank 0: cells above y = 1 have tag 7, others 3; given facets have tag 5."""
    if COMM.rank == 0:
        dimension = cells.shape[1] - 1
        kinds = {2: ("triangle", "line"), 3: ("tetra", "triangle")}[dimension]
        blocks = [(kinds[0], cells)]
        tags = [np.where(points[cells].mean(axis=1)[:, 1] > 1, 7, 3).astype(np.int32)]
        if facets is not None:
            blocks.append((kinds[1], facets))
            tags.append(np.full(len(facets), 5, np.int32))
        points3 = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        data = {"gmsh:physical": tags}
        if path.suffix == ".msh":
            meshio.write(
                path,
                meshio.Mesh(points3, blocks, cell_data=data | {"gmsh:geometrical": tags}),
                "gmsh22",
                binary=False,
            )
        else:
            meshio.write(path, meshio.Mesh(points3, blocks, cell_data=data))
    COMM.barrier()
    return path


@pytest.mark.ranks
def test_paper_mesh_has_992_degrees_of_freedom() -> None:
    tissue = structured_mesh(COMM, [1.0, 2.0], [15, 30])
    space = dolfinx.fem.functionspace(tissue.mesh, ("Lagrange", 1, (2,)))
    assert 2 * space.dofmap.index_map.size_global == 992
    facets = contact_facets(tissue, zone(["left", "right"], [[0, 1.5], [1, 2]]))
    on, off = contact_blocks(space, facets)
    # n_e = 956 in the paper's forward scene; each side has 8 facets with midpoint above y = 1.5, so 9 nodes.
    assert 2 * COMM.allreduce(len(off)) == 956
    assert 2 * COMM.allreduce(len(on)) == 992 - 956


@pytest.mark.parametrize("size", [[1.0, 2.0], [1.0, 2.0, 0.5]])
def test_structured_mesh_volume_and_sides(size: list[float]) -> None:
    tissue = structured_mesh(COMM, size, [3, 4, 2][: len(size)], [-1.0, 5.0, 2.0][: len(size)])
    assert volume(tissue) == pytest.approx(np.prod(size), rel=WIDE)
    for axis, side in enumerate(("x-", "y+", "z-")[: len(size)]):
        assert area(tissue, contact_facets(tissue, zone([side]))) == pytest.approx(np.prod(size) / size[axis], rel=WIDE)
    same = [contact_facets(tissue, zone([s])) for s in ("top", "y+" if len(size) == 2 else "z+")]
    assert np.array_equal(*same)


def test_make_mesh_takes_size_or_file(mpi_tmp_path: Path) -> None:
    points, cells, facets = grid(2)
    write(mpi_tmp_path / "a.vtu", points, cells, facets)
    tissue = SimpleNamespace(
        size=None, origin=None, cells=None, mesh="a.vtu", scale=0.5, repair=False, seam=1e-4, read_limit=None
    )
    scene: Any = SimpleNamespace(tissue=tissue, directory=mpi_tmp_path, _given=None)
    assert volume(make_mesh(COMM, scene)) == pytest.approx(0.5, rel=WIDE)
    tissue.size, tissue.cells = [1.0, 1.0], [2, 2]
    assert make_mesh(COMM, scene).source == "structured"
    tissue.cells = [2, 2, 2]
    with pytest.raises(SceneError, match=r"tissue\.cells 3"):
        make_mesh(COMM, scene)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("suffix", [".msh", ".vtu", ".vtk"])
@pytest.mark.ranks
def test_file_keeps_volume_and_tags(mpi_tmp_path: Path, dimension: int, suffix: str) -> None:
    points, cells, facets = grid(dimension)
    points = np.vstack([points, np.full((2, dimension), 9.0)])  # unused nodes go
    tissue = read_mesh(COMM, write(mpi_tmp_path / f"a{suffix}", points, cells, facets))
    assert tissue.mesh.geometry.index_map().size_global == len(points) - 2
    assert tissue.dimension == tissue.mesh.geometry.dim == dimension
    assert tissue.parts is None
    assert volume(tissue) == pytest.approx(2.0, rel=WIDE)
    left = contact_facets(tissue, zone(facet_tag=5))
    assert area(tissue, left) == pytest.approx(2.0, rel=WIDE)
    assert np.array_equal(left, contact_facets(tissue, zone(["left"])))
    middle = points[cells].mean(axis=1)[:, 1]
    upper = cells_in(tissue, SimpleNamespace(tag=7, box=None))
    assert COMM.allreduce(len(upper)) == (middle > 1).sum()
    box = [[0, 1 + 1e-6, 0][:dimension], [1, 2, 1][:dimension]]
    assert np.array_equal(upper, cells_in(tissue, SimpleNamespace(tag=None, box=box)))


@pytest.mark.parametrize("dimension", [2, 3])
def test_inverted_cells_are_refused_or_turned(mpi_tmp_path: Path, dimension: int) -> None:
    points, cells, _ = grid(dimension)
    for wrong in ([4], range(len(cells))):
        bad = cells.copy()
        bad[wrong, :2] = bad[wrong, 1::-1]
        path = write(mpi_tmp_path / f"bad{len(wrong)}.vtu", points, bad)
        with pytest.raises(MeshError, match=f"{len(wrong)} inverted cells? of {len(cells)}.*tissue.repair"):
            read_mesh(COMM, path)
        assert volume(read_mesh(COMM, path, repair=True)) == pytest.approx(2.0, rel=WIDE)
        repaired = check_cells(points, bad, True, "a")
        assert (signed_volumes(points, repaired) > 0).all()
        assert np.array_equal(np.sort(repaired, axis=1), np.sort(cells, axis=1))


def test_flat_cell_is_refused_even_with_repair(mpi_tmp_path: Path) -> None:
    points, cells, _ = grid(3)
    points = np.vstack([points, points[cells[11, :3]].mean(axis=0)])
    cells[11, 3] = len(points) - 1
    with pytest.raises(MeshError, match="1 cell of zero volume, the worst is cell 11 "):
        read_mesh(COMM, write(mpi_tmp_path / "flat.vtu", points, cells), repair=True)


@pytest.mark.serial
def test_flatness_does_not_depend_on_units() -> None:
    points, cells, _ = grid(3)
    assert check_cells(1e-9 * points, cells, False, "a") is cells


def test_non_finite_point_is_refused() -> None:
    points, cells, _ = grid(2)
    points[3, 1] = np.nan
    with pytest.raises(MeshError, match=r"1 point with NaN.*first is 3"):
        check_cells(points, cells, False, "a")


def test_loose_part_is_refused(mpi_tmp_path: Path) -> None:
    points, cells, _ = grid(2)
    double = np.vstack([points, points + np.array([5.0, 0.0])])
    both = np.vstack([cells, cells + len(points)])
    assert components(both, len(double))[0] == 2
    tissue = read_mesh(COMM, write(mpi_tmp_path / "two.vtu", double, both))
    held_check(tissue, contact_facets(tissue, zone(["bottom"])))
    with pytest.raises(MeshError, match=rf"1 of 2 separate parts.*{len(cells)} cells around \(5\.5, 1\)"):
        held_check(tissue, contact_facets(tissue, zone(["left"])))


@pytest.mark.parametrize(
    ("contact", "words"),
    [
        (zone(["left"], [[0.5, 0], [1, 2]]), r"contact.sides.*contact.box.*spans \(0, 0\) to \(1, 2\)"),
        (zone(["front"]), "'front'; a 2D tissue has no such side"),
        (zone(facet_tag=5), "facet_tag = 5 needs facet tags"),
        (zone(box=[[0, 0, 0], [1, 1, 1]]), "two corners with 2 coordinates"),
    ],
)
def test_wrong_contact_is_a_scene_error(contact: Any, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        contact_facets(structured_mesh(COMM, [1.0, 2.0], [3, 6]), contact)


def test_absent_tag_lists_the_present_ones(mpi_tmp_path: Path) -> None:
    tissue = read_mesh(COMM, write(mpi_tmp_path / "a.msh", *grid(2)))
    with pytest.raises(SceneError, match=r"facet_tag = 6 is not in a.msh: its facet tags are \[5\]"):
        contact_facets(tissue, zone(facet_tag=6))


@pytest.mark.parametrize(
    ("kind", "nodes", "words"),
    [
        ("polygon", [[0, 4, 1, 2, 3]], "type polygon"),
        ("triangle6", [[0, 1, 2, 3, 4, 5]], "type triangle6"),
        ("line", [[0, 1]], "line"),
    ],
)
def test_other_cells_are_refused_by_name(mpi_tmp_path: Path, kind: str, nodes: list[list[int]], words: str) -> None:
    path = mpi_tmp_path / "other.vtu"
    if COMM.rank == 0:
        square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0, 0], [1, 0.5, 0]]
        meshio.write(path, meshio.Mesh(np.array(square, dtype=float), [(kind, np.array(nodes))]))
    COMM.barrier()
    with pytest.raises(MeshError, match=words):
        read_mesh(COMM, path)


def test_unreadable_files_are_one_sentence(mpi_tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="does not exist"):
        read_mesh(COMM, mpi_tmp_path / "none.msh")
    for name in ("junk.msh", "junk.vtu", "junk.abc"):
        if COMM.rank == 0:
            (mpi_tmp_path / name).write_text("not a mesh\n")
        COMM.barrier()
        with pytest.raises(MeshError, match="meshio cannot read"):
            read_mesh(COMM, mpi_tmp_path / name)


def test_curved_surface_is_refused(mpi_tmp_path: Path) -> None:
    points, cells, _ = grid(2)
    lifted = np.column_stack([points, points[:, 0] ** 2])
    with pytest.raises(MeshError, match="leave the plane z = 0"):
        read_mesh(COMM, write(mpi_tmp_path / "shell.vtu", lifted, cells))


@pytest.mark.parametrize("dimension", [2, 3])
def test_rigid_modes_do_not_strain(dimension: int) -> None:
    points = np.random.default_rng(0).normal(size=(6, dimension))
    reference = np.arange(1.0, dimension + 1)
    modes = rigid_modes(points, dimension, True, reference)
    assert modes.shape == (6 * dimension, dimension * (dimension + 1) // 2)
    distance = points[0] - points[1]
    for mode in modes.T.reshape(-1, 6, dimension):
        # A linearised rigid motion keeps lengths to first order: (x - y).(u(x) - u(y)) = 0, up to round-off.
        assert abs(distance @ (mode[0] - mode[1])) < 1e-14
    at_reference = rigid_modes(reference[None, :], dimension, True, reference)
    assert not at_reference[:, dimension:].any()
    if dimension == 3:  # right-handed: the third rotation takes x to y
        turn = rigid_modes(np.array([[1.0, 0, 0]]), 3, True, np.zeros(3))[:, 5]
        assert np.array_equal(turn, [0, 1, 0])


def test_pillow_mesh_is_readable() -> None:
    if not PILLOW.is_file():
        pytest.skip("the pillow mesh is not in this checkout")
    raw = meshio.read(PILLOW)
    cells = np.vstack([b.data for b in raw.cells if b.type == "tetra"])
    tissue = read_mesh(COMM, PILLOW)
    held_check(tissue, contact_facets(tissue, zone(box=[[-1, -1, -1], [0, 1, 1]])))
    expected = np.abs(signed_volumes(raw.points, cells)).sum()
    # another order of summation over some thousand cells
    assert volume(tissue) == pytest.approx(expected, rel=1e-10)


@pytest.mark.serial
def test_cells_are_found_in_either_version_of_dolfinx() -> None:
    """0.10 has one dofmap, 0.11 a list of them and a warning at the single one."""
    nodes = np.array([[0, 1, 2]], dtype=np.int32)
    for geometry in (SimpleNamespace(dofmap=nodes), SimpleNamespace(dofmaps=[nodes])):
        assert np.array_equal(cell_nodes(SimpleNamespace(geometry=geometry)), nodes)
