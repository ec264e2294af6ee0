"""Memory is estimated before anything is allocated, and measured as what this program took."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from mpi4py import MPI

from softgrasp.fem import resources
from softgrasp.fem.errors import ResourceError
from softgrasp.fem.mesh.make import make_mesh
from softgrasp.fem.model.build import build
from softgrasp.fem.model.memory import box_simplices, check_memory, chosen, free_bytes, need, steps_of
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.strain.body import HyperelasticBody
from tests.helpers.models import CUBE, make_scene

GIB = 2.0**30
EVEN = ["tissue.order=2", "tissue.refine=false", "tissue.cells=[16, 12, 32]"]


@pytest.fixture
def nothing_built(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a mesh is made before its memory is estimated")

    monkeypatch.setattr("softgrasp.fem.model.build.make_mesh", refuse)


@pytest.mark.usefixtures("nothing_built")
@pytest.mark.parametrize(
    ("key", "table"),
    [
        ("tissue.cells", {"tissue": {"cells": [100_000, 100_000]}}),
        ("tissue.cells", {"tissue": {"cells": [10**18, 2]}}),
        ("time.steps", {"time": {"steps": 10**12}}),
        ("tissue.cells", CUBE | {"tissue": CUBE["tissue"] | {"cells": [10**4] * 3, "order": 2}}),
    ],
)
def test_what_no_machine_holds_is_refused_before_the_mesh(comm: MPI.Intracomm, key: str, table: dict[str, Any]) -> None:
    with pytest.raises(ResourceError) as caught:
        build(make_scene(table), comm=comm)
    text = str(caught.value)
    assert text.startswith(f"{key} = ")
    assert len(text) < 400
    assert f"rank{'s' if comm.size > 1 else ''} of {comm.size} on one node" in text
    assert "--set output.memory=GIB" in text
    assert comm.allgather(text) == [text] * comm.size


def test_what_the_sentence_advises_fits(comm: MPI.Intracomm) -> None:
    big = make_scene(tissue={"cells": [3000, 6000]}, output={"memory": 0.5})
    with pytest.raises(ResourceError) as caught:
        build(big, comm=comm)
    assert "where 512 MiB may be used" in str(caught.value)
    text = str(caught.value).split("use about tissue.cells = ")[1].split(" or less")[0]
    cells = [int(n) for n in text.strip("[]").split(", ")]
    assert cells[1] == pytest.approx(2 * cells[0], rel=0.1)  # two digits are kept
    some = make_scene(tissue={"cells": cells}, output={"memory": 0.5})
    check_memory(some, comm, True, 2, box_simplices(cells))
    with pytest.raises(ResourceError):
        check_memory(some, comm, True, 2, box_simplices([round(1.25 * n) for n in cells]))


def test_a_graded_mesh_that_does_not_fit_is_refused(comm: MPI.Intracomm) -> None:
    """What says how many cells there are is the tolerance, not the cells of the box."""
    scene = make_scene(tissue={"order": 2, "refine": {"tolerance": 1e-2}}, output={"memory": 1e-3})
    with pytest.raises(
        ResourceError, match=r"^tissue\.refine\.tolerance = 0\.01 needs .* use about \d+ of its \d+ cells"
    ):
        build(scene, comm=comm)


def test_steps_count_only_for_a_run(comm: MPI.Intracomm) -> None:
    scene = make_scene(time={"steps": 10**12})
    assert build(scene, comm=comm, run=False).system.layout.n_e > 0
    with pytest.raises(ResourceError, match=r"use about time\.steps = \d+ or less"):
        build(scene, comm=comm)


@pytest.mark.parametrize(("table", "d"), [({}, 2), (CUBE, 3)])
def test_cells_of_a_box_are_those_of_its_mesh(comm: MPI.Intracomm, table: dict[str, Any], d: int) -> None:
    scene = make_scene(table)
    mesh = make_mesh(comm, scene).mesh
    assert box_simplices(scene.tissue.cells or []) == mesh.topology.index_map(d).size_global


@pytest.mark.ranks
def test_shares_of_the_nodes_add_up(comm: MPI.Intracomm) -> None:
    found = need(make_scene(), 2, 10**6, comm.size, run=True)
    assert found.of(1.0, comm.size) == found.mesh + found.factor + comm.size * found.tables
    assert found.of(0.5, 1) * 2 == pytest.approx(found.of(1.0, 2), rel=1e-12)  # two nodes, one rank each


def test_a_container_limits_what_is_free(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    before = free_bytes(make_scene())
    (tmp_path / "memory.max").write_text("3000000\n")
    (tmp_path / "memory.current").write_text("1000000\n")
    monkeypatch.setattr(resources, "CONTAINER", tmp_path)
    assert free_bytes(make_scene()) == 2e6 < before
    (tmp_path / "memory.stat").write_text("file 700000\ninactive_file 500000\n")  # which streamed snapshots leave
    assert free_bytes(make_scene()) == 2.5e6
    (tmp_path / "memory.max").write_text("max\n")
    assert free_bytes(make_scene()) > 2.5e6
    assert free_bytes(make_scene(output={"memory": 2.0})) == 2 * GIB


def test_no_machine_decides_which_solver_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a factor does not fit in what is free the run is refused, with the setting by which another is chosen."""
    cells = box_simplices([20, 20, 20])  # 2e5 unknowns, 2.5 GB of factor
    scene = make_scene(CUBE, {"tissue": {"order": 2}, "time": {"steps": 1000}})
    work = replace(steps_of(scene, 200_000, 3, 1), contrast=49.0)
    monkeypatch.setattr("softgrasp.fem.model.memory.steps_of", lambda *_: work)
    check_memory(scene, MPI.COMM_SELF, True, 3, cells)
    name = chosen(scene, work)[0]
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=3.5 * GIB))
    assert (name, chosen(scene, work)[0]) == ("mumps", "mumps")
    with pytest.raises(ResourceError, match=r"another solver by --set output\.memory=") as caught:
        check_memory(scene, MPI.COMM_SELF, True, 3, cells)
    allowed = float(str(caught.value).split("output.memory=")[1].split(",")[0])
    lean = make_scene(CUBE, {"tissue": {"order": 2}, "time": {"steps": 1000}, "output": {"memory": allowed}})
    check_memory(lean, MPI.COMM_SELF, True, 3, cells)
    assert chosen(lean, work)[0] == "stars"


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("set_down_3d", ["tissue.order=2"]),
        ("turn_over", []),
        ("block_3d", [*EVEN, "tissue.layers.low={box=[[0,0,0],[0.1,0.1,0.01]], material='ecoflex-00-30'}"]),
    ],
)
def test_contact_nonlinear_laws_and_layers_have_a_factor(name: str, keys: list[str]) -> None:
    """Contact is refused without one, which was the choice at nu = 0.3."""
    even, work = steps_of(load_scene("block_3d", EVEN), 1e5, 3, 1), steps_of(load_scene(name, keys), 1e5, 3, 1)
    assert not {"cg", "stars"} & set(work.candidates())
    assert even.choose()[0] == "stars"


@pytest.mark.parametrize("order", [1, 2])
def test_finite_strain_counts_its_matrices(order: int) -> None:
    """B, B'AB, A and the pass over the points are a good part of what it adds, and no more than that."""
    tissue = {"cells": [16, 32], "order": order}
    model = build(make_scene(tissue=tissue, effects={"finite_strain": {}}), comm=MPI.COMM_SELF)
    system, cells = model.system, box_simplices([16, 32])
    assert system.points is not None
    body = HyperelasticBody(system.points, system.materials)
    body.tangent(system.K_ee.createVecRight())
    matrices = (body.points.B, body.A, body.K, body.product)
    held = 12 * sum(A.getInfo()["nz_used"] for A in matrices if A is not None)  # a number and a column each
    with_it, without = (need(s, 2, cells, 1, True).mesh for s in (model.scene, make_scene(tissue=tissue)))
    assert 0.2 < held / (with_it - without) < 1
