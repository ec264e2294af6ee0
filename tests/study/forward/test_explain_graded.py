"""What explain says of boxes whose cells a tolerance or bisection chooses, against the meshes themselves."""

from __future__ import annotations

import math

import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.refined import refined_mesh
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.forward import bisected, copies, filed
from softgrasp.study.forward import explain as forward_explain
from softgrasp.study.forward.explain import Explanation, explain
from softgrasp.study.forward.explain_page import sections
from tests.study.forward.test_explain_files import never_assembled

FEW = {2: 2_000, 3: 2_000}


def own_and_copied(
    scene: Scene, comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> tuple[Explanation, Explanation, str]:
    """From the mesh itself, and from a copy beside which no model of half as many cells is built; what it says."""
    monkeypatch.setattr(filed, "LARGE", {2: math.inf, 3: math.inf})
    monkeypatch.setattr(forward_explain, "BUILT_SECONDS", math.inf)
    own = explain(scene, comm)
    monkeypatch.setattr(filed, "LARGE", FEW)
    monkeypatch.setattr(forward_explain, "BUILT_SECONDS", 1e-3)
    for module in (bisected, copies):
        monkeypatch.setattr(module, "MOST_LOOKED_AT", FEW)
    never_assembled(monkeypatch, own.sizes.cells // 2)
    copied = explain(scene, comm)
    assert (own.built, copied.built) == (True, False)
    kinds = [(end.kind, end.alpha) for end in own.mesh.ends]
    assert [(end.kind, end.alpha) for end in copied.mesh.ends] == kinds
    assert (copied.mesh.graded, copied.mesh.first) == (own.mesh.graded, own.mesh.first)
    assert copied.mesh.order == own.mesh.order
    assert copied.warnings == own.warnings
    (said,) = [part.text for part in sections(copied) if part.title == "Mesh"]
    return own, copied, said


@pytest.mark.ranks(2)
@pytest.mark.parametrize(
    ("name", "changes", "off"),
    [
        ("paper_forward", ["tissue.refine={tolerance=0.01}"], 0.05),
        ("layers_2d", ["tissue.refine={tolerance=1e-4,most=6000}"], 0.17),  # and a step of the tolerance
        ("paper_forward", ["tissue.cells=[40,80]", "tissue.refine={method='bisect'}"], 0.05),
        ("block_3d", ["tissue.order=1", "tissue.refine={method='bisect'}"], 0.2),
        ("block_3d", ["tissue.order=2", "tissue.refine={method='bisect',tolerance=0.01}"], 0.2),
    ],
)
def test_cells_of_a_bisected_box_are_counted_on_a_sample(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, name: str, changes: list[str], off: float
) -> None:
    """Sizes, ends and modes against those of the bisected mesh. ``off`` is what the page says."""
    own, copied, said = own_and_copied(load_scene(name, changes), comm, monkeypatch)
    assert copied.sampled
    for size in ("n_e", "cells", "nodes"):
        assert getattr(copied.sizes, size) == pytest.approx(getattr(own.sizes, size), rel=off)
    assert copied.memory.mesh == pytest.approx(own.memory.mesh, rel=off)
    near = {2: 0.03, 3: 0.35}[own.dimension]  # linear cells at nu = 0.49 lock
    assert copied.time.omega[0] == pytest.approx(own.time.omega[0], rel=near)
    assert ("another 12 %" in said) == ("most=6000" in changes[-1])  # 1.25^(d / 2 p)
    assert f"{copies.SAMPLED[own.dimension]} of the unknowns, as cells are counted on a sample" in said


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("layers_2d", ["tissue.refine={tolerance=1e-4,method='lines'}"]),
        ("block_3d", ["tissue.order=2", "tissue.refine={tolerance=0.02}"]),
        ("block_3d", ["tissue.order=1", "tissue.refine={tolerance=1e-4,most=9000}"]),  # fewer lines, until that fits
    ],
)
def test_lines_that_a_tolerance_chooses_are_counted(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, name: str, changes: list[str]
) -> None:
    """Sizes and modes against those of the mesh, of which a copy has fewer lines."""
    own, copied, said = own_and_copied(load_scene(name, changes), comm, monkeypatch)
    assert not copied.sampled
    assert (copied.sizes.nodes, copied.sizes.cells) == (own.sizes.nodes, own.sizes.cells)
    assert copied.sizes.n_e == pytest.approx(own.sizes.n_e, rel=0.02)  # a zone of whole facets of few cells
    assert copied.sizes.nonzeros == pytest.approx(own.sizes.nonzeros, rel=0.1)  # as the page says
    near = {2: 0.03, 3: 0.35}[own.dimension]  # linear cells at nu = 0.49 lock
    assert copied.time.omega[0] == pytest.approx(own.time.omega[0], rel=near)
    assert "computed from that copy, to 1 % of the unknowns" in said


@pytest.mark.parametrize("method", ["lines", "bisect"])
def test_a_box_with_more_unknowns_than_refinement_allows_is_refused_as_it_is(comm: MPI.Intracomm, method: str) -> None:
    """In the words of simulate, with a tolerance and without."""
    for most in ("tolerance=0.01,most=4", "most=1000"):
        scene = load_scene("paper_forward", ["tissue.cells=[30,60]", f"tissue.refine={{{most},method='{method}'}}"])
        said = []
        for command in (lambda scene: explain(scene, comm), lambda scene: refined_mesh(comm, scene)):
            with pytest.raises(SceneError, match="unknowns are fewer than the") as caught:
                command(scene)
            said.append(str(caught.value))
        assert said[0] == said[1]
