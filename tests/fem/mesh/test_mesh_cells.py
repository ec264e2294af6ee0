"""Mesh files of other cells than linear simplices, named sets, and parts that hang by single nodes."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest
import scipy.linalg
import skfem
from skfem.helpers import ddot, div, sym_grad

from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.mesh.cells import LITTLE, check_straight, cut_cells, shape_of, simplices, volume_of_curves
from softgrasp.fem.mesh.check import find_parts, signed_volumes, sort_facets
from softgrasp.fem.mesh.file import load_arrays, read_mesh
from softgrasp.fem.model.build import build
from softgrasp.fem.model.contact import cells_in, check_parts, contact_facets, held_check
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.tissue import Contact, Layer
from tests.fem.mesh.test_mesh import COMM, WIDE, area, grid, volume, zone
from tests.helpers.models import gather_matrix, node_order

Blocks = list[tuple[str, np.ndarray]]


def bricks(dimension: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of `grid`, its squares or cubes, and their sides on x = 0, in lexicographic numbers."""
    points = grid(dimension, n)[0]
    index = np.arange(len(points)).reshape([n + 1] * dimension)
    low, high = slice(0, n), slice(1, n + 1)
    ring = [(low, low), (high, low), (high, high), (low, high)]
    if dimension == 2:
        return points, np.stack([index[r].ravel() for r in ring], 1), np.stack([index[0, :-1], index[0, 1:]], 1)
    cells = np.stack([index[(*r, s)].ravel() for s in (low, high) for r in ring], 1)
    return points, cells, np.stack([index[0][r].ravel() for r in ring], 1)


def save(path: Path, points: np.ndarray, blocks: Blocks, **more: Any) -> Path:
    """Write on rank 0."""
    if COMM.rank == 0:
        options = {"file_format": "gmsh22", "binary": False} if path.suffix == ".msh" else {}
        points3 = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        meshio.write(path, meshio.Mesh(points3, blocks, **more), **options)
    COMM.barrier()
    return path


def facet_counts(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    facets = np.concatenate([cells[:, list(c)] for c in combinations(range(cells.shape[1]), cells.shape[1] - 1)])
    return np.unique(np.sort(facets, axis=1), axis=0, return_counts=True)


def mixed(n: int) -> tuple[np.ndarray, Blocks]:
    """A block of cubes, some cut by hand: columns into wedges, cubes into pyramids about their middle."""
    points, cubes, _ = bricks(3, n)
    middle = points[cubes].mean(axis=1)
    column = (middle[:, 0] < 1 / n) & (middle[:, 1] > 1)
    star = np.flatnonzero(~column & (np.arange(len(cubes)) % 3 == 0))
    whole = np.setdiff1d(np.flatnonzero(~column), star)
    c = cubes[column]
    wedges = np.concatenate([c[:, [0, 1, 2, 4, 5, 6]], c[:, [0, 2, 3, 4, 6, 7]]])
    tops = len(points) + np.arange(len(star))
    sides = [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]]
    pyramids = np.concatenate([np.column_stack([cubes[star][:, side], tops]) for side in sides])
    points = np.vstack([points, middle[star]])
    return points, [("hexahedron", cubes[whole]), ("wedge", wedges), ("pyramid", pyramids)]


@pytest.mark.serial
@pytest.mark.parametrize("seed", [0, 1])
def test_mixed_cells_are_cut_alike_by_their_neighbours(seed: int) -> None:
    """Any numbering, inner nodes moved: no facet of one cell only lies inside, volumes add up."""
    rng = np.random.default_rng(seed)
    points, blocks = mixed(4)
    inner = ((points > 1e-9) & (points < np.array([1, 2, 1]) - 1e-9)).all(axis=1)
    points[inner] += 0.02 * rng.standard_normal((int(inner.sum()), 3))
    numbers = rng.permutation(len(points))
    shuffled = np.empty_like(points)
    shuffled[numbers] = points
    cut = [cut_cells(shuffled, numbers[cells], kind, "a") for kind, cells in blocks]
    for (_, cells), (_, parents), pieces in zip(blocks, cut, (6, 3, 2), strict=True):
        assert np.array_equal(parents, np.repeat(np.arange(len(cells)), pieces))
    tetrahedra = np.concatenate([c for c, _ in cut])
    volumes = signed_volumes(shuffled, tetrahedra)
    assert (volumes > 0).all()
    assert volumes.sum() == pytest.approx(2.0, rel=WIDE)
    facets, counts = facet_counts(tetrahedra)
    assert counts.max() == 2
    outside = shuffled[facets[counts == 1]]
    edges = np.cross(outside[:, 1] - outside[:, 0], outside[:, 2] - outside[:, 0])
    assert np.linalg.norm(edges, axis=1).sum() / 2 == pytest.approx(10.0, rel=WIDE)  # surface of 1 x 2 x 1


@pytest.mark.parametrize("dimension", [2, 3])
def test_squares_and_cubes_are_the_mesh_cut_by_hand(mpi_tmp_path: Path, dimension: int) -> None:
    """In lexicographic numbers the cut is Kuhn's; tags go along, and K is that of scikit-fem on Kuhn's cells."""
    points, cells, sides = bricks(dimension, 3)
    _, kuhn, _ = grid(dimension)
    kinds = {2: ("quad", "line"), 3: ("hexahedron", "quad")}[dimension]
    upper = points[cells].mean(axis=1)[:, 1] > 1
    tags = {"gmsh:physical": [np.where(upper, 7, 3), np.full(len(sides), 5)]}
    tags["gmsh:geometrical"] = tags["gmsh:physical"]
    path = save(mpi_tmp_path / "a.msh", points, [(kinds[0], cells), (kinds[1], sides)], cell_data=tags)
    arrays = load_arrays(path, 1.0, False)
    assert {tuple(sorted(c)) for c in arrays.cells.tolist()} == {tuple(sorted(c)) for c in kuhn.tolist()}
    tissue = read_mesh(COMM, path)
    left = contact_facets(tissue, zone(facet_tag=5))
    assert area(tissue, left) == pytest.approx(2.0, rel=WIDE)
    assert np.array_equal(left, contact_facets(tissue, zone(["left"])))
    assert COMM.allreduce(len(cells_in(tissue, SimpleNamespace(tag=7)))) == upper.sum() * len(kuhn) // len(cells)

    material = {"lambda": 30.0, "mu": 20.0, "rho": 2.0}
    scene = Scene.model_validate(
        {
            "name": "cut",
            "tissue": {"mesh": str(path), "material": material},
            "contact": {"facet_tag": 5},
            "hand": {"mass": 1.0},
            "motion": {"target": [0.1] * dimension, "duration": 1.0},
            "time": {"steps": 2},
        }
    )
    system = build(scene, comm=COMM).system
    mesh = (skfem.MeshTri if dimension == 2 else skfem.MeshTet)(points.T.copy(), kuhn.T.copy())
    element = skfem.ElementTriP1() if dimension == 2 else skfem.ElementTetP1()
    basis = skfem.Basis(mesh, skfem.ElementVector(element))
    stiffness = skfem.BilinearForm(
        lambda u, v, w: 40.0 * ddot(sym_grad(u), sym_grad(v)) + 30.0 * div(u) * div(v)
    ).assemble(basis)
    order = node_order(points)
    free = basis.nodal_dofs[:, order[points[order, 0] > 0]].T.ravel()
    expected = stiffness[free][:, free]
    # entries of order 100, sums of a few terms
    assert abs(gather_matrix(system.layout, system.K_ee) - expected).max() < 1e-12 * abs(expected).max()


def raised(cells: np.ndarray, points: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Simplices with the equidistant nodes of a higher order on edges and faces (no inner ones up to order 3)."""
    corners, extra = points[cells], []
    m = cells.shape[1]
    for i, j in combinations(range(m), 2):
        extra += [corners[:, i] * (1 - k / order) + corners[:, j] * k / order for k in range(1, order)]
    if order == 3:
        extra += [corners[:, list(f)].mean(axis=1) for f in combinations(range(m), 3)]
    new = len(points) + np.arange(len(extra) * len(cells)).reshape(len(cells), -1)
    return np.vstack([points, np.stack(extra, 1).reshape(-1, points.shape[1])]), np.hstack([cells, new])


@pytest.mark.parametrize(("kind", "order"), [("triangle6", 2), ("triangle10", 3), ("tetra10", 2), ("tetra20", 3)])
def test_straight_cells_of_higher_order_are_their_corners(mpi_tmp_path: Path, kind: str, order: int) -> None:
    dimension = 2 if kind.startswith("tri") else 3
    points, cells, _ = grid(dimension)
    more, high = raised(cells, points, order)
    first = high[0, dimension + 1]
    more[first] += 0.1 * (points[cells[0, 0]] - more[first])  # a node may slide along its edge
    suffix = ".vtu" if order == 2 else ".msh"  # meshio writes the third order to Gmsh only
    path = save(mpi_tmp_path / f"a{suffix}", more, [(kind, high)])
    arrays = load_arrays(path, 1.0, False)
    assert np.array_equal(arrays.cells, cells)
    assert np.array_equal(arrays.points, points)
    assert volume(read_mesh(COMM, path)) == pytest.approx(2.0, rel=WIDE)
    more[high[4, dimension + 1]] += np.array([0.08, -0.05, 0.06])[:dimension]  # along no edge of the grid
    with pytest.raises(MeshError, match=rf"1 curved cell of type {kind}.*lies 0\.0\d+ m from"):
        read_mesh(COMM, save(mpi_tmp_path / f"b{suffix}", more, [(kind, high)]))


def round_body(dimension: int, fine: int) -> tuple[np.ndarray, np.ndarray]:
    """Second-order cells of the unit disc or ball: a fan from the centre, all nodes of the surface on it."""
    if dimension == 2:
        angle = 2 * np.pi * np.arange(fine) / fine
        surface, facets = np.c_[np.cos(angle), np.sin(angle)], np.c_[np.arange(fine), (np.arange(fine) + 1) % fine]
    else:
        surface = np.vstack([np.eye(3), -np.eye(3)])
        facets = np.array([[a, b, c] for a in (0, 3) for b in (1, 4) for c in (2, 5)])
        for _ in range(fine):
            middles = [(facets[:, i], facets[:, (i + 1) % 3]) for i in range(3)]
            new = [len(surface) + k * len(facets) + np.arange(len(facets)) for k in range(3)]
            surface = np.vstack([surface, *((surface[a] + surface[b]) / 2 for a, b in middles)])
            corners = [np.c_[facets[:, i], new[i], new[i - 1]] for i in range(3)]
            facets = np.vstack([*corners, np.stack(new, 1)])
        surface /= np.linalg.norm(surface, axis=1)[:, None]
        surface, same = np.unique(surface.round(12), axis=0, return_inverse=True)
        facets = same.reshape(-1)[facets]
    points, cells = np.vstack([0 * surface[:1], surface]), np.c_[np.zeros(len(facets), dtype=int), facets + 1]
    flip = np.linalg.det(points[cells][:, 1:] - points[cells][:, :1]) < 0
    cells[flip, -2:] = cells[flip, :-3:-1]
    more, high = raised(cells, points, 2)
    outside = np.linalg.norm(more[high], axis=2) > 0.75
    rim = np.unique(high[outside])
    more[rim] /= np.linalg.norm(more[rim], axis=1)[:, None]
    return more, high


@pytest.mark.serial
@pytest.mark.parametrize(("dimension", "fine", "exact"), [(2, 32, np.pi), (3, 3, 4 * np.pi / 3)])
def test_slightly_curved_cells_are_straightened_and_the_change_is_told(
    tmp_path: Path, dimension: int, fine: int, exact: float
) -> None:
    """The parabolas have the volume of disc and ball but for the fourth order of the angle of a cell."""
    kind = "triangle6" if dimension == 2 else "tetra10"
    points, cells = round_body(dimension, fine)
    corner = points[cells[:, : dimension + 1]]
    straight = np.linalg.det(corner[:, 1:] - corner[:, :1]).sum() / (2 if dimension == 2 else 6)
    edges = list(combinations(range(dimension + 1), 2))
    change = volume_of_curves(points, cells, edges)
    assert change == pytest.approx(exact / straight - 1, rel=0.03)  # fourth order, 0.1 to 0.2 radian
    path = save(tmp_path / "round.vtu", points, [(kind, cells)])
    if change > LITTLE[1]:
        with pytest.raises(
            MeshError, match=rf"straight cells would change its volume by {-100 * change / (1 + change):.2f} %: export"
        ):
            load_arrays(path, 1.0, False)
        return
    (note,) = load_arrays(path, 1.0, False).known["notes"]
    assert f"{fine} curved cells of type {kind}" in note
    assert f"changes the volume of the body by {100 * (straight / exact - 1):.2f} %" in note


@pytest.mark.serial
def test_curved_hexahedra_and_quadrilaterals_are_found() -> None:
    """The distance is exact on a unit cube: an edge node 0.03 off, then a face node 0.05 off."""
    for dimension, kinds in ((2, ("quad8", "quad9")), (3, ("hexahedron20", "hexahedron27"))):
        ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
        corners = ring if dimension == 2 else np.vstack([np.c_[ring, np.full(4, z)] for z in (0.0, 1.0)])
        pairs = [p for p in combinations(range(len(corners)), 2) if abs(corners[p[0]] - corners[p[1]]).sum() == 1]
        faces = [corners[corners[:, a] == s].mean(axis=0) for a in range(dimension) for s in (0, 1)]
        more = [*(faces if dimension == 3 else []), corners.mean(axis=0)]
        x = np.vstack([corners, corners[pairs].mean(axis=1), more])
        for kind, size in zip(kinds, (len(corners) + len(pairs), len(x)), strict=True):
            nodes = np.arange(size)[None, :]
            check_straight(x, nodes, kind.rstrip("0123456789"), kind, "a")
            off = x.copy()
            off[len(corners), -1] -= 0.03
            with pytest.raises(
                MeshError,
                match=rf"1 curved cell of type {kind}, .* 0\.03 m from .*: export the mesh with smaller cells, ",
            ):
                check_straight(off, nodes, kind.rstrip("0123456789"), kind, "a")
    x[20, 0] -= 0.05  # the middle of the face x = 0
    with pytest.raises(MeshError, match=r"hexahedron27, .* 0\.05 m from .* at \(-0\.05, 0\.5, 0\.5\)"):
        check_straight(x, nodes, "hexahedron", "hexahedron27", "a")


@pytest.mark.serial
def test_awkward_cells_are_cut_right_or_refused() -> None:
    concave = np.array([[0.2, 0.2], [1, 0], [0, 0], [0, 1.0]])  # nodes 2, 1, 0, 3 in turn: the notch is node 0
    for numbers in ([2, 1, 0, 3], [1, 0, 3, 2], [0, 3, 2, 1]):
        volumes = signed_volumes(concave, cut_cells(concave, np.array([numbers]), "quad", "a")[0])
        assert (volumes > 0).all()
        assert volumes.sum() == pytest.approx(0.2, rel=WIDE)
        moved = np.roll(concave, 1, axis=0)  # now the smallest node would cut outside
        cut = cut_cells(moved, (np.array([numbers]) + 1) % 4, "quad", "a")[0]
        assert (signed_volumes(moved, cut) > 0).all()
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    with pytest.raises(MeshError, match="1 cell of type quad so distorted"):
        cut_cells(square, np.array([[0, 1, 3, 2]]), "quad", "a")  # its sides cross

    points, cubes, _ = bricks(3, 1)
    wedge = cubes[:, [0, 1, 2, 4, 5, 6]]
    for nodes in (wedge, wedge[:, [3, 4, 5, 0, 1, 2]]):  # the two orientations in use
        assert (signed_volumes(points, cut_cells(points, nodes, "wedge", "a")[0]) > 0).all()
    collapsed = cubes[:, [0, 1, 2, 2, 4, 5, 6, 6]]  # a wedge written as a hexahedron
    cut, _ = simplices(collapsed, "hexahedron")
    assert len(cut) == 3
    assert signed_volumes(points, cut).sum() == pytest.approx(1.0, rel=WIDE)
    points[6] = [0.1, 0.1, 0.1]
    with pytest.raises(MeshError, match="1 cell of type hexahedron so distorted"):
        cut_cells(points, cubes, "hexahedron", "a")
    assert [shape_of(k) for k in ("VTK_LAGRANGE_QUADRILATERAL", "wedge15", "polygon", "polyhedron8")] == [
        "quad", "wedge", None, None
    ]  # fmt: skip


@pytest.mark.parametrize("low", [True, False])
def test_tetrahedra_on_a_cube_fit_or_are_refused(mpi_tmp_path: Path, low: bool) -> None:
    """A cube beside six tetrahedra, whose common face has the cube's diagonal only in one of two numberings."""
    points, kuhn, _ = grid(3, 1)
    numbers = np.arange(12)
    if not low:
        numbers[[4, 5]] = 5, 4  # the face's smallest node is no longer an end of Kuhn's diagonal
    cube = [0, 4, 6, 2, 1, 5, 7, 3]
    beside = np.vstack([points, points[4:] + np.array([1.0, 0, 0])])
    shuffled = np.empty_like(beside)
    shuffled[numbers] = beside
    blocks = [("hexahedron", numbers[[cube]]), ("tetra", numbers[kuhn + 4])]
    path = save(mpi_tmp_path / "a.vtu", shuffled, blocks)
    if low:
        tissue = read_mesh(COMM, path)
        assert volume(tissue) == pytest.approx(4.0, rel=WIDE)
        assert tissue.part_tags is None
        return
    with pytest.raises(MeshError, match=r"2 triangles on quadrilaterals .* around \(1, "):
        read_mesh(COMM, path)


@pytest.mark.parametrize("suffix", [".msh", ".inp"])
def test_named_sets_serve_as_tags(mpi_tmp_path: Path, suffix: str) -> None:
    """Physical names of Gmsh go with a number; the element sets of Abaqus have names only, and may overlap."""
    points, cells, sides = bricks(2, 4)
    middle = points[cells].mean(axis=1)
    upper, right = middle[:, 1] > 1, middle[:, 0] > 0.5
    blocks = [("quad", cells), ("line", sides)]
    if suffix == ".msh":
        tags = [np.where(upper, 7, 3), np.full(len(sides), 5)]
        names = {"upper": np.array([7, 2]), "lower": np.array([3, 2]), "left": np.array([5, 1])}
        data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
        path = save(mpi_tmp_path / f"a{suffix}", points, blocks, cell_data=data, field_data=names)
        present = r"\[5, 'left'\]"
    else:
        none = np.zeros(0, dtype=int)
        sets = {"upper": [np.flatnonzero(upper), none], "right": [np.flatnonzero(right), none]}
        sets["left"] = [none, np.arange(len(sides))]
        path = save(mpi_tmp_path / f"a{suffix}", points, blocks, cell_sets=sets)
        present = r"\['left'\]"
    tissue = read_mesh(COMM, path)
    for name, chosen in [("upper", upper), ("lower", ~upper) if suffix == ".msh" else ("right", right)]:
        layer = Layer.model_validate({"tag": name, "material": {"lambda": 1.0, "mu": 1.0, "rho": 1.0}})
        assert COMM.allreduce(len(cells_in(tissue, layer))) == 2 * chosen.sum()
    contact = Contact.model_validate({"facet_tag": "left"})
    assert np.array_equal(contact_facets(tissue, contact), contact_facets(tissue, zone(["left"])))
    with pytest.raises(SceneError, match=rf"facet_tag = top is not in a{suffix}: its facet tags are {present}"):
        contact_facets(tissue, Contact.model_validate({"facet_tag": "top"}))
    with pytest.raises(SceneError, match=r"tag = 9 of a layer is not in .*'upper'"):
        cells_in(tissue, SimpleNamespace(tag=9))


def joined(*pieces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles in each square, six tetrahedra in each cube given by its lowest corner, equal nodes merged."""
    corners = np.unique(np.vstack(pieces), axis=0)
    d = corners.shape[1]
    points, cells, _ = grid(d, 1)
    every = np.vstack([points / points.max(axis=0) + c for c in corners])
    merged, numbers = np.unique(every, axis=0, return_inverse=True)
    return merged, numbers.ravel()[np.vstack([cells + i * len(points) for i in range(len(corners))])]


def row(*corners: list[int]) -> np.ndarray:
    return np.array(corners, dtype=float)


HINGED = {  # squares and cubes by their lowest corners, and the free motions left when the bottom is held
    "one node": ([[0, 0], [1, 1]], 1),
    "two nodes": ([[0, 0], [1, 1], [2, 0]], 0),
    "chain": ([[0, 0], [1, 1], [2, 2]], 2),
    "four bars": ([[0, 0], [-1, 1], [0, 2], [1, 1]], 1),
    "three-hinged arch": ([[0, 0], [1, 0], [1, 1], [-1, 1], [0, 2]], 0),
    "edge in space": ([[0, 0, 0], [1, 0, 1]], 1),
    "node in space": ([[0, 0, 0], [1, 1, 1]], 3),
    "three nodes in space": ([[0, 0, 0], [1, 0, 1], [1, 1, 0]], 0),
}


@pytest.mark.serial
@pytest.mark.parametrize("case", HINGED)
def test_hinged_parts_are_refused_where_k_is_singular(case: str) -> None:
    """The independent count: null vectors of scikit-fem's K with the bottom held."""
    corners, motions = HINGED[case]
    points, cells = joined(np.array(corners, dtype=float))
    d = points.shape[1]
    mesh = (skfem.MeshTri if d == 2 else skfem.MeshTet)(points.T.copy(), cells.T.copy())
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTriP1() if d == 2 else skfem.ElementTetP1()))
    K = skfem.BilinearForm(lambda u, v, w: ddot(sym_grad(u), sym_grad(v)) + div(u) * div(v)).assemble(basis)
    free = np.setdiff1d(np.arange(basis.N), basis.nodal_dofs[:, points[:, -1] == 0].ravel())
    values = scipy.linalg.eigvalsh(K[free][:, free].toarray())
    assert (values < 1e-9).sum() == motions  # the others are above 1e-3
    found = find_parts(points, cells, sort_facets(cells), "a")
    assert found is not None
    labels, parts = found
    below = np.isclose(points[cells][:, :, -1], 0).sum(axis=1) == d
    held = np.bincount(labels, weights=below, minlength=len(parts.cells)) > 0
    if not motions:
        check_parts(parts, held, "a")
        return
    with pytest.raises(MeshError, match="can turn freely about the nodes they share with the rest"):
        check_parts(parts, held, "a")


def test_hinge_is_one_sentence_with_its_place(mpi_tmp_path: Path) -> None:
    points, cells = joined(row([0, 0], [1, 0], [2, 1], [3, 1]))
    path = save(mpi_tmp_path / "hinge.vtu", points, [("triangle", cells)])
    tissue = read_mesh(COMM, path)
    words = r"1 of 2 parts of hinge.vtu can turn .* 4 cells and 1 such node around \(2, 1\)"
    with pytest.raises(MeshError, match=words):
        held_check(tissue, contact_facets(tissue, zone(["bottom"])))
    held_check(tissue, contact_facets(tissue, zone(["left", "right"])))
    with pytest.raises(MeshError, match="facets with more than two cells"):
        read_mesh(COMM, save(mpi_tmp_path / "twice.vtu", points, [("triangle", np.vstack([cells, cells[[0, 0]]]))]))


GMSH_41 = """\
$MeshFormat
4.1 0 8
$EndMeshFormat
$Entities
4 4 1 0
1 0 0 0 0
2 1 0 0 0
3 1 1 0 0
4 0 1 0 0
11 0 0 0 1 0 0 0 2 1 -2
12 1 0 0 1 1 0 0 2 2 -3
13 0 1 0 1 1 0 0 2 3 -4
14 0 0 0 0 1 0 0 2 4 -1
1 0 0 0 1 1 0 0 4 11 12 13 14
$EndEntities
$Nodes
1 4 1 4
2 1 0 4
1
2
3
4
0 0 0
1 0 0
1 1 0
0 1 0
$EndNodes
$Elements
2 3 1 3
1 11 1 1
1 1 2
2 1 2 2
2 1 2 3
3 1 3 4
$EndElements
"""  # curves 11 to 14 bound the surface: meshio lists those numbers in cell_sets


@pytest.mark.serial
def test_numbers_of_cad_entities_are_no_cells(tmp_path: Path) -> None:
    path = tmp_path / "a.msh"
    path.write_text(GMSH_41)
    arrays = load_arrays(path, 1.0, False)
    assert len(arrays.cells) == 2
    assert "gmsh:bounding_entities" not in arrays.known["cell_sets"]


ABAQUS = """\
*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 0, 1, 0
4, 1, 1, 0
*ELEMENT, TYPE=CPS3, ELSET=A
1, 1, 2, 3
*ELEMENT, TYPE=CPS3, ELSET=B
2, 2, 4, 3
*ELSET, ELSET=ALL
B,
"""


@pytest.mark.serial
def test_sets_of_sets_are_left_out(tmp_path: Path) -> None:
    """Which cells they hold meshio does not say; taking its numbers at their word would mark the wrong ones."""
    path = tmp_path / "a.inp"
    path.write_text(ABAQUS)
    assert "ALL" not in load_arrays(path, 1.0, False).known["cell_sets"]


@pytest.mark.serial
def test_collapsed_hexahedron_beside_a_wedge(tmp_path: Path) -> None:
    """A wedge written as a hexahedron has triangles for two of its faces: its neighbour may have them too."""
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 0, 2], [1, 0, 2], [1, 1, 2]]
    )
    hexahedron = np.array([[0, 1, 2, 2, 3, 4, 5, 5]])
    wedge = np.array([[3, 4, 5, 6, 7, 8]])
    path = save(tmp_path / "a.vtu", points.astype(float), [("hexahedron", hexahedron), ("wedge", wedge)])
    arrays = load_arrays(path, 1.0, False)
    assert len(arrays.cells) == 6
    assert signed_volumes(arrays.points, arrays.cells).sum() == pytest.approx(1.0, rel=WIDE)


@pytest.mark.serial
def test_flat_cells_are_counted_as_the_file_has_them(tmp_path: Path) -> None:
    points, cubes, _ = bricks(3, 2)
    points[cubes[0], 2] = 0.0
    path = save(tmp_path / "a.vtu", points, [("hexahedron", cubes[:1])])
    with pytest.raises(MeshError, match="has 1 cell of type hexahedron and zero volume, the first around"):
        load_arrays(path, 1.0, False)
