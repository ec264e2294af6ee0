"""Runs and points of a mesh in two files, of which one changed."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import CheckpointError, Interrupted
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.cache import Cache
from softgrasp.study.precision.riccati import Refusal
from tests.helpers.models import make_scene

pytestmark = pytest.mark.ranks(2)


def mesh_scene(comm: MPI.Intracomm, folder: Path, height: float) -> Scene:
    """The block on a mesh in two files, of which the one with the numbers changes with the height. Collective."""
    if comm.rank == 0:
        x, y = np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 2, 7))
        points = np.column_stack([x.ravel(), np.where(y.ravel() == 0, -height, y.ravel())])
        low = np.array([4 * j + i for j in range(6) for i in range(3)])
        corners = np.column_stack([low, low + 1, low + 5, low + 4])
        cells = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
        meshio.write(folder / "block.xdmf", meshio.Mesh(points, [("triangle", cells)]))
    comm.Barrier()
    base = make_scene(time={"steps": 12}).model_dump(mode="json", by_alias=True, exclude_none=True)
    base["tissue"] = {"mesh": str(folder / "block.xdmf"), "material": base["tissue"]["material"]}
    return Scene.model_validate(base)


def test_a_mesh_that_changed_in_its_second_file_does_not_go_on(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """Neither a run nor the points of a study."""
    scene = mesh_scene(comm, mpi_tmp_path, 0.0)
    named, kept = (mpi_tmp_path / "block.xdmf").read_bytes(), Cache(mpi_tmp_path / "cache", comm, scene)
    assert kept.get("point", {}, Refusal, lambda: [Refusal("1")]) == [Refusal("1")]
    with pytest.raises(Interrupted):
        simulate(build(scene, comm=comm), RunOptions(mpi_tmp_path, until=6))
    again = mesh_scene(comm, mpi_tmp_path, 0.0)
    assert simulate(build(again, comm=comm), RunOptions(mpi_tmp_path, resume=True)).steps_timed == 6
    kept = Cache(mpi_tmp_path / "cache", comm, again)
    assert kept.get("point", {}, Refusal, lambda: [Refusal("2")]) == [Refusal("1")]
    other = mesh_scene(comm, mpi_tmp_path, 0.5)
    assert (mpi_tmp_path / "block.xdmf").read_bytes() == named
    with pytest.raises(CheckpointError, match="a file that the scene names is not what it was"):
        simulate(build(other, comm=comm), RunOptions(mpi_tmp_path, resume=True))
    fresh = Cache(mpi_tmp_path / "cache", comm, other)
    assert fresh.get("point", {}, Refusal, lambda: [Refusal("2")]) == [Refusal("2")]
