"""What explain says of a mesh file too large to be assembled, against the mesh itself."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.refined import refined_mesh
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.tissue import Refine
from softgrasp.study.forward import bisected, copies, filed
from softgrasp.study.forward import explain as forward_explain
from softgrasp.study.forward.copies import node_pairs_of
from softgrasp.study.forward.explain import explain
from softgrasp.study.forward.explain_page import sections
from tests.fem.mesh.test_lattice import cut_box


def bar(comm: MPI.Intracomm, folder: Path, counts: list[int], order: int = 1, slit: bool = False) -> Scene:
    """A bent bar in a mesh file, held at one end, perhaps slit along half of its length."""
    if comm.rank == 0:
        points, cells = cut_box(counts)
        if slit:  # cells on one side have nodes of their own there
            on = np.flatnonzero((points[:, 0] == 0.5) & (points[:, -1] > 0.5))
            own = np.arange(len(points))
            own[on] = len(points) + np.arange(len(on))
            right = points[cells].mean(axis=1)[:, 0] > 0.5
            cells[right] = own[cells[right]]
            points = np.concatenate([points, points[on]])
        points = points * ([0.1] * (len(counts) - 1) + [0.3])
        points[:, 0] += 0.5 * points[:, -1] ** 2
        meshio.write(folder / "bar.xdmf", meshio.Mesh(points, [("tetra" if len(counts) == 3 else "triangle", cells)]))
    comm.Barrier()
    d = len(counts)
    return Scene.model_validate(
        {
            "name": "bar",
            "tissue": {
                "mesh": str(folder / "bar.xdmf"),
                "order": order,
                "material": {"young": 2e4, "poisson": 0.3, "rho": 1e3},
            },
            "contact": {"sides": ["yz"[d - 2] + "-"]},
            "motion": {"target": [0.0] * (d - 1) + [0.1], "duration": 1.0},
            "time": {"steps": 50},
        }
    )


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("counts", "order"), [([24, 72], 2), ([4, 4, 12], 2)])
def test_a_large_file_is_explained_by_a_copy_of_its_body(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counts: list[int], order: int
) -> None:
    """Sizes, modes, sag and hash against those of the assembled mesh."""
    scene = bar(comm, mpi_tmp_path, counts, order)
    monkeypatch.setattr(filed, "LARGE", {2: math.inf, 3: math.inf})
    own, hashed = explain(scene, comm), scene_hash(scene)
    monkeypatch.setattr(filed, "LARGE", {2: 1000, 3: 1000})
    scene._mesh_digest = ""
    copied = explain(scene, comm)
    assert (own.coarser, own.built) == (0, True)
    assert (copied.built, copied.counted) == (False, False)
    assert scene_hash(scene) == hashed
    assert (copied.sizes.nodes, copied.sizes.cells) == (own.sizes.nodes, own.sizes.cells)
    assert copied.sizes.n_e == pytest.approx(own.sizes.n_e, rel=0.01)
    assert copied.sizes.nonzeros == pytest.approx(own.sizes.nonzeros, rel=0.05)  # in two digits
    off = {2: 0.01, 3: 0.05}[own.dimension]  # measured 0.3 % and 2 %
    np.testing.assert_allclose(copied.time.omega[:3], own.time.omega[:3], rtol=off)
    assert copied.sag.largest == pytest.approx(own.sag.largest, rel=2 * off)  # measured 0.6 % and 6 %
    assert [f.setup for f in copied.forecasts] == pytest.approx([f.setup for f in own.forecasts], rel=0.05)
    assert copied.mesh.ends == ()  # those of lattice cells are not those of the body
    (said,) = [part.text for part in sections(copied) if part.title == "Mesh"]
    assert "a coarser copy of the body" in said


def test_a_body_that_lattice_cells_do_not_show_is_assembled(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slit, which lattice cells close, and which lets the first frequency fall."""
    monkeypatch.setattr(filed, "LARGE", {2: 1000, 3: 1000})
    scene = bar(comm, mpi_tmp_path, [10, 10, 20], slit=True)
    assert explain(scene, comm).coarser == 0


def test_a_body_is_mended_before_it_is_copied(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An open seam and inverted cells, against the mesh that was mended and assembled."""
    scene = bar(comm, mpi_tmp_path, [10, 10, 20], slit=True)
    if comm.rank == 0:
        mesh = meshio.read(mpi_tmp_path / "bar.xdmf")
        mesh.cells[0].data[::7, -2:] = mesh.cells[0].data[::7, :-3:-1]
        meshio.write(mpi_tmp_path / "bar.xdmf", mesh)
    comm.Barrier()
    scene = scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"repair": True})})
    monkeypatch.setattr(filed, "LARGE", {3: math.inf})
    own, hashed = explain(scene, comm), scene_hash(scene)
    monkeypatch.setattr(filed, "LARGE", {3: 1000})
    scene._mesh_digest = ""
    copied = explain(scene, comm)
    assert (own.coarser, copied.built) == (0, False)
    assert scene_hash(scene) == hashed
    assert (copied.sizes.nodes, copied.sizes.cells) == (own.sizes.nodes, own.sizes.cells)
    off = 0.1  # linear cells are stiffer: measured 4.7 %
    np.testing.assert_allclose(copied.time.omega[:3], own.time.omega[:3], rtol=off)
    said = [text for text in copied.warnings if "tissue.repair joined them" in text]
    assert said == [text for text in own.warnings if "tissue.repair joined them" in text]
    assert said


def never_assembled(monkeypatch: pytest.MonkeyPatch, cells: int) -> None:
    """Models of so many cells or more raise."""

    def built(*args: Any, **keys: Any) -> Model:
        model = build(*args, **keys)
        assert model.cells < cells
        return model

    for module in (bisected, copies, filed, forward_explain):
        monkeypatch.setattr(module, "build", built)


@pytest.mark.parametrize(
    ("counts", "order", "refine", "off"),
    [
        ([20, 60], 2, {}, 0.05),
        ([20, 60], 1, {"tolerance": 2e-3}, 0.05),
        ([20, 60], 1, {"tolerance": 1e-4, "most": 20_000}, 0.2),  # the tolerance grows by quarters until that fits
        ([6, 6, 16], 1, {}, 0.2),
        ([5, 5, 14], 1, {"tolerance": 5e-3}, 0.2),
    ],
)
def test_cells_that_follow_the_ends_of_a_file_are_counted_on_a_sample(
    comm: MPI.Intracomm,
    mpi_tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    counts: list[int],
    order: int,
    refine: dict[str, float],
    off: float,
) -> None:
    """Sizes, ends and modes against those of the bisected mesh. ``off`` is what the page says."""
    scene = bar(comm, mpi_tmp_path, counts, order)
    refined = Refine.model_validate(refine)
    scene = scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"refine": refined})})
    monkeypatch.setattr(filed, "LARGE", {2: math.inf, 3: math.inf})
    own = explain(scene, comm)
    assert (own.coarser, own.sampled) == (0, False)
    monkeypatch.setattr(filed, "LARGE", {2: 1000, 3: 1000})
    never_assembled(monkeypatch, math.prod(counts) * math.factorial(len(counts)))
    copied = explain(scene, comm)
    assert (copied.built, copied.sampled) == (False, True)
    for size in ("n_e", "cells", "nodes"):
        assert getattr(copied.sizes, size) == pytest.approx(getattr(own.sizes, size), rel=off)
    assert copied.memory.mesh == pytest.approx(own.memory.mesh, rel=off)
    kinds = [(end.kind, end.alpha) for end in own.mesh.ends]
    assert [(end.kind, end.alpha) for end in copied.mesh.ends] == kinds
    near = {2: 0.02, 3: 0.1}[own.dimension]  # measured 0.7 % and, of linear elements that are stiffer, 7 %
    np.testing.assert_allclose(copied.time.omega[:3], own.time.omega[:3], rtol=near)
    (said,) = [part.text for part in sections(copied) if part.title == "Mesh"]
    assert "counted on a sample" in said
    assert ("another 25 %" in said) == ("most" in refine)  # 1.25^(d / 2 p)


def test_a_file_with_more_unknowns_than_refinement_allows_is_refused_as_it_is(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the words of simulate; where only the finer mesh has too many, a warning."""
    scene = bar(comm, mpi_tmp_path, [20, 60])
    monkeypatch.setattr(filed, "LARGE", {2: 1000})

    def limited(most: int) -> Scene:
        return scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"refine": Refine(most=most)})})

    said = []
    for command in (explain, refined_mesh):
        with pytest.raises(SceneError, match="most = 2000 unknowns are fewer than the 2562") as caught:
            command(*((limited(2000), comm)[:: 1 if command is explain else -1]))
        said.append(str(caught.value))
    assert said[0] == said[1]
    assert any("tissue.refine.most = 2600 allows fewer" in text for text in explain(limited(2600), comm).warnings)
    assert not any("allows fewer" in text for text in explain(limited(6000), comm).warnings)


@pytest.mark.parametrize("counts", [[24, 72], [6, 6, 18]])
def test_the_plan_past_obstacles_of_a_large_file_is_that_of_its_own_boundary(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch, counts: list[int]
) -> None:
    """Variables and rows, which are counted by boundary nodes, equal those of the assembled mesh."""
    d = len(counts)
    keys = bar(comm, mpi_tmp_path, counts).model_dump(by_alias=True, exclude_none=True, exclude_defaults=True)
    keys["effects"] = {"damping": {"kind": "kelvin-voigt", "beta": 0.002}}
    keys["obstacle"] = [{"name": "wall", "kind": "halfspace", "normal": [-1.0] + [0.0] * (d - 1), "offset": -1.0}]
    tip = [0.05] * (d - 1) + [0.3]
    keys["control"] = {"outputs": [{"kind": "node", "point": tip, "name": "tip"}], "constraints": {"force": 8.0}}
    scene = Scene.model_validate(keys)
    own = explain(scene, comm)
    monkeypatch.setattr(filed, "LARGE", {2: 1000, 3: 1000})
    never_assembled(monkeypatch, math.prod(counts) * math.factorial(len(counts)))
    copied = explain(scene, comm)
    assert (own.built, copied.built) == (True, False)
    assert copied.plan == own.plan
    keys["control"]["constraints"]["body"] = ["tip"]
    assert explain(Scene.model_validate(keys), comm).plan.rows < copied.plan.rows / 10


def test_cubic_elements_are_explained_by_quadratic_ones(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene("pillow_3d")
    copied = explain(scene, comm)
    monkeypatch.setattr(copies, "MOST_LOOKED_AT", {3: 10**6})
    own = explain(scene, comm)
    assert own.coarser == 0
    assert 0 < copied.coarser < own.sizes.n_e / 2
    assert (copied.sizes.n_e, copied.sizes.nodes) == (own.sizes.n_e, own.sizes.nodes)
    assert copied.sizes.nonzeros == pytest.approx(own.sizes.nonzeros, rel=0.05)  # in two digits
    np.testing.assert_allclose(copied.time.omega, own.time.omega, rtol=0.02)  # measured 1.3 %
    assert copied.sag.largest == pytest.approx(own.sag.largest, rel=0.02)  # measured 1.1 %
    assert copied.mesh.ends == own.mesh.ends
    assert copied.forecasts[0].setup == own.forecasts[0].setup


@pytest.mark.parametrize("order", [1, 2, 3])
def test_nodes_and_pairs_of_one_tetrahedron(order: int) -> None:
    """All its nodes share it."""
    nodes = math.comb(order + 3, 3)
    assert node_pairs_of([4, 6, 4, 1], order) == (nodes, nodes**2)
