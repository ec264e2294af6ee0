"""Graded meshes: the same on any ranks, with the zone, layers and tags of the mesh they come from."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from typing import Any

import dolfinx.fem
import dolfinx.mesh
import meshio
import numpy as np
import pytest
import ufl
from mpi4py import MPI

from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.layout import bounding_box
from softgrasp.fem.mesh.grading import bisect, distribute
from softgrasp.fem.mesh.make import make_mesh
from softgrasp.fem.mesh.tissue_mesh import MeshArrays, TissueMesh, Whole, spread, structured_mesh
from softgrasp.fem.model.assembly import layer_numbers
from softgrasp.fem.model.build import build
from softgrasp.fem.model.contact import contact_facets
from softgrasp.fem.model.refined import lattice, refined_mesh, unknowns
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.scene import Scene
from tests.helpers.models import CUBE, LAYERS, gather_mesh, make_scene, merged

ROUND = 1e-12  # sums of some hundred terms of order one
ROUGH = {"tolerance": 0.05}
LAYERED = {"tissue": {"layers": LAYERS}, "effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}}


def refined(*changes: dict[str, Any], **refine: Any) -> Scene:
    return make_scene({"tissue": {"refine": refine}}, *changes)


def length(tissue: TissueMesh, facets: np.ndarray) -> float:
    tags = dolfinx.mesh.meshtags(tissue.mesh, tissue.dimension - 1, np.sort(facets), np.ones(len(facets), np.int32))
    ds = ufl.Measure("ds", domain=tissue.mesh, subdomain_data=tags)
    form = dolfinx.fem.form(dolfinx.fem.Constant(tissue.mesh, 1.0) * ds(1))
    return float(tissue.mesh.comm.allreduce(dolfinx.fem.assemble_scalar(form)))


def fingerprint(tissue: TissueMesh) -> str:
    points, _ = gather_mesh(tissue.mesh)
    order = np.lexsort(points.T)
    return hashlib.sha256(np.ascontiguousarray(points[order]).tobytes()).hexdigest()


def zone_of(tissue: TissueMesh, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of the contact zone. Collective."""
    facets = contact_facets(tissue, scene.contact)
    tissue.mesh.topology.create_connectivity(tissue.dimension - 1, tissue.dimension)
    nodes = dolfinx.mesh.entities_to_geometry(tissue.mesh, tissue.dimension - 1, facets).ravel()
    x = tissue.mesh.geometry.x[nodes, : tissue.dimension]
    return bounding_box(tissue.mesh.comm, x)


@pytest.mark.parametrize(
    ("change", "refine"),
    [({}, ROUGH), ({"tissue": {"cells": [5, 7]}}, {"method": "bisect"}), (CUBE, {"method": "bisect"}), (CUBE, {})],
    ids=["tolerance", "given cells", "3D", "lines"],
)
@pytest.mark.ranks
def test_mesh_is_the_same_on_any_ranks(comm: MPI.Intracomm, change: Any, refine: Any) -> None:
    scene = refined(change, **refine)
    together = fingerprint(refined_mesh(comm, scene))
    assert together == fingerprint(refined_mesh(MPI.COMM_SELF, scene))
    assert len(set(comm.allgather(together))) == 1


@pytest.mark.parametrize(
    "refine", [ROUGH, {**ROUGH, "contact": "select"}, {}, {"method": "bisect"}, {"grading": "off"}], ids=str
)
def test_zone_ends_where_the_scene_says(comm: MPI.Intracomm, refine: Any) -> None:
    """On 5 x 11 cells no line meets y = 1.5: facets by their midpoints alone hold from 1.4545."""
    scene = refined({"tissue": {"cells": [5, 11]}}, **refine)
    plain = make_mesh(comm, scene)
    assert zone_of(plain, scene)[0][1] == pytest.approx(16 / 11)
    mesh = refined_mesh(comm, scene)
    assert zone_of(mesh, scene)[0][1] == pytest.approx(1.5, abs=1e-14)
    assert length(mesh, contact_facets(mesh, scene.contact)) == pytest.approx(1.0, rel=ROUND)


def test_lines_keep_the_unknowns_of_the_box(comm: MPI.Intracomm) -> None:
    even, lined = build(make_scene(), comm=comm), build(refined(), comm=comm)
    assert (
        lined.space.mesh.mesh.topology.index_map(2).size_global
        == even.space.mesh.mesh.topology.index_map(2).size_global
    )
    x = np.unique(np.round(gather_mesh(lined.space.mesh.mesh)[0][:, 0], 12))
    assert np.diff(x)[0] < 0.6 * np.diff(x)[1]  # four cells across, graded from both sides


@pytest.mark.ranks
def test_layers_are_inherited(comm: MPI.Intracomm) -> None:
    scene = refined(LAYERED, **ROUGH)
    mesh = refined_mesh(comm, scene)
    names, numbers = layer_numbers(mesh, scene)
    sizes = {}
    for i, name in enumerate(names):
        members = np.flatnonzero(numbers == i).astype(np.int32)
        dx = ufl.Measure("dx", domain=mesh.mesh, subdomain_data=[(1, members)])(1)
        part = dolfinx.fem.assemble_scalar(dolfinx.fem.form(dolfinx.fem.Constant(mesh.mesh, 1.0) * dx))
        sizes[name] = comm.allreduce(part)
    assert sizes == pytest.approx({"low": 0.375, "core": 0.375, "tissue": 1.25}, rel=ROUND)  # lines meet their boxes


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.ranks
def test_tags_survive_four_bisections(comm: MPI.Intracomm, dimension: int) -> None:
    """Area of the tagged side and volume of the tagged half stay; the mesh stays conforming."""
    size = [1.0, 2.0, 1.0][:dimension]
    whole = None
    if comm.rank == 0:
        box = structured_mesh(MPI.COMM_SELF, size, [2, 4, 2][:dimension])
        mesh, d = box.mesh, dimension
        mesh.topology.create_connectivity(d - 1, d)
        side = dolfinx.mesh.locate_entities_boundary(mesh, d - 1, lambda x: np.isclose(x[1], 2.0)).astype(np.int32)
        tags = dolfinx.mesh.meshtags(mesh, d - 1, np.sort(side), np.full(len(side), 7, np.int32))
        n = mesh.topology.index_map(d).size_local
        middle = dolfinx.mesh.compute_midpoints(mesh, d, np.arange(n, dtype=np.int32))
        whole = Whole(
            mesh, "box", {"cell_tags": (middle[:, 1] > 1).astype(np.int32)}, {"facet_tags": tags}, {7: (7,)}, {1: (1,)}
        )
        for level in range(4):
            x = whole.points[whole.simplices].mean(axis=1)
            r = np.linalg.norm(x - np.array([0.0, 2.0, 0.0])[:d], axis=1)
            whole = bisect(whole, np.flatnonzero(r < 0.8 / 2**level).astype(np.int32))
    result = distribute(comm, whole)
    assert result.facet_tags is not None
    assert result.cell_tags is not None
    result.mesh.topology.create_connectivity(dimension - 1, dimension)
    outside = dolfinx.mesh.exterior_facet_indices(result.mesh.topology)
    held = np.intersect1d(result.facet_tags.indices, outside)
    assert length(result, held) == pytest.approx(1.0, rel=ROUND)
    assert length(result, outside) == pytest.approx({2: 6.0, 3: 10.0}[dimension], rel=ROUND)  # nothing hangs inside
    owned = result.mesh.topology.index_map(dimension).size_local
    upper = result.cell_tags.indices[(result.cell_tags.values == 1) & (result.cell_tags.indices < owned)]
    dx = ufl.Measure("dx", domain=result.mesh, subdomain_data=[(1, upper)])(1)
    form = dolfinx.fem.form(dolfinx.fem.Constant(result.mesh, 1.0) * dx)
    assert comm.allreduce(dolfinx.fem.assemble_scalar(form)) == pytest.approx(1.0, rel=ROUND)


@pytest.mark.serial
def test_cells_that_cannot_be_bisected_are_named() -> None:
    """A needle with a short side beside a cell that is split: half of it keeps its length and has half its area."""
    points, cells = np.array([[0.0, 0.0], [1.0, 0.0], [0.99, 3e-12], [0.0, -1.0]]), np.array([[0, 1, 2], [0, 3, 1]])
    mesh = spread(MPI.COMM_SELF, MeshArrays(points, cells, {}, {"source": "needle.msh"})).mesh
    mesh.topology.create_connectivity(1, 2)
    whole = Whole(mesh, "needle.msh", {}, {})
    beside = int(np.argmin(whole.points[whole.simplices].mean(axis=1)[:, 1]))
    with pytest.raises(
        MeshError, match=r"needle\.msh cannot be bisected further: \d cells? would be flat, the worst ar"
    ):
        bisect(whole, np.array([beside], dtype=np.int32))


def l_shape(path: Path) -> Path:
    """An L of 12 squares with its foot as a named facet tag, written by meshio."""
    x = np.arange(5)
    points = np.array([[i, j, 0.0] for j in x for i in x]) / 4
    number = {(i, j): 5 * j + i for j in x for i in x}
    cells = []
    for i in range(4):
        for j in range(4):
            if not (i >= 2 and j >= 2):
                a, b, c, e = number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]
                cells += [[a, b, c], [a, c, e]]
    foot = [[number[i, 0], number[i + 1, 0]] for i in range(4)]
    used, flat = np.unique(np.array(cells), return_inverse=True)
    lines = np.searchsorted(used, np.array(foot))
    blocks = [("triangle", flat.reshape(-1, 3)), ("line", lines)]
    marks = [np.full(len(cells), 1), np.full(4, 5)]
    meshio.write(path, meshio.Mesh(points[used], blocks, cell_data={"medit:ref": marks}), file_format="medit")
    return path


def l_scene(folder: Path, comm: MPI.Intracomm, **tissue: Any) -> Scene:
    if comm.rank == 0:
        l_shape(folder / "l.mesh")
    comm.Barrier()
    data = make_scene().model_dump(by_alias=True, exclude_none=True)
    data["tissue"] = {"mesh": str(folder / "l.mesh"), "material": {"lambda": 50.0, "mu": 50.0, "rho": 1.0}, **tissue}
    data["contact"] = {"facet_tag": 5}
    return Scene.model_validate(data)


def test_mesh_file_is_bisected_at_its_corner(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    scene = l_scene(mpi_tmp_path, comm, order=2, refine={"tolerance": 0.01})
    mesh = refined_mesh(comm, scene)
    assert length(mesh, contact_facets(mesh, scene.contact)) == pytest.approx(1.0, rel=ROUND)
    points, cells = gather_mesh(mesh.mesh)
    h = np.linalg.norm(np.roll(points[cells], 1, axis=1) - points[cells], axis=2).max(axis=1)
    for corner in ((0.5, 0.5), (0.0, 0.0), (1.0, 0.0)):
        at = np.isclose(points[cells], corner).all(axis=2).any(axis=1)
        assert h[at].max() < 0.25 * h.max()


@pytest.mark.parametrize(
    ("change", "refine"),
    [
        ({}, {"tolerance": 0.05}), ({}, {"tolerance": 1e-3}), ({}, {"method": "bisect"}), ({}, {}),
        (LAYERED, ROUGH), (merged(CUBE, {"tissue": {"order": 1}}), {"method": "bisect"}),
    ],
    ids=["tolerance", "fine", "given cells", "lines", "layers", "3D"],
)  # fmt: skip
def test_energy_is_kept_on_graded_meshes(comm: MPI.Intracomm, change: Any, refine: Any) -> None:
    run = simulate(build(refined({"tissue": {"order": 2}}, change, **refine), comm=comm))
    assert run.energy_drift < ROUND  # sixty steps of rounding, as on even meshes
    assert max(run.residuals) < ROUND


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.serial
def test_unknowns_are_counted_before_they_are_made(order: int) -> None:
    scene = refined({"tissue": {"order": order}}, tolerance=0.1)
    model = build(scene, comm=MPI.COMM_SELF)
    assert model.space.mesh.whole is not None
    held = len(model.space.contact) * 2
    assert unknowns(model.space.mesh.whole, order) == model.system.layout.n_e + held
    assert lattice([4, 8], order) == 2 * (4 * order + 1) * (8 * order + 1)


def test_most_limits_the_mesh_and_too_few_are_refused(comm: MPI.Intracomm) -> None:
    model = build(refined(tolerance=0.01, most=2000), comm=comm)
    assert model.system.layout.n_e <= 2000
    for refine in ({"method": "bisect", "most": 50}, {"most": 50}, {"tolerance": 0.01, "method": "lines", "most": 3}):
        with pytest.raises(SceneError, match=r"tissue\.refine\.most = \d+ unknowns are fewer than"):
            build(refined(**refine), comm=comm)


@pytest.mark.serial
def test_without_the_table_nothing_changes() -> None:
    """The same bits, and neither module nor attribute of the graded meshes."""
    import subprocess

    code = (
        "import sys; from mpi4py import MPI; from softgrasp.fem.scene.file import load_scene;"
        "from softgrasp.fem.model.build import build; m = build('paper_forward');"
        "names = ('refined', 'bisect', 'singular', 'grading', 'lines', 'accuracy');"
        "print([n for n in sys.modules if n.startswith('softgrasp.fem') and n.rsplit('.')[-1] in names])"
    )
    out = subprocess.run(
        [sys.executable, "-c", "from softgrasp.fem import _stack;" + code], capture_output=True, text=True
    )
    assert out.stdout.strip() == "[]", out.stderr
