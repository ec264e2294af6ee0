"""Mesh files that meshio never ends to read, and those it reads in a process of its own."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest

import softgrasp.fem.mesh.foreign
from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh.file import read_mesh
from softgrasp.fem.mesh.foreign import read_foreign
from tests.fem.mesh.test_mesh import COMM, WIDE, grid, volume


def save(path: Path, keep: int | None = None) -> Path:
    """Two hundred tetrahedra, or the first bytes of their file; written on rank 0."""
    if COMM.rank == 0:
        points, cells, _ = grid(3)
        meshio.write(path, meshio.Mesh(points, [("tetra", cells)]))
        if keep is not None:
            path.write_bytes(path.read_bytes()[:keep])
    COMM.barrier()
    return path


def test_a_file_that_meshio_never_ends_is_refused_on_all_ranks(mpi_tmp_path: Path) -> None:
    words = r"did not end within 1 s of processor time on .*a\.ele.*raise tissue\.read_limit"
    with pytest.raises(MeshError, match=words):
        read_mesh(COMM, save(mpi_tmp_path / "a.ele", keep=0), limit=0.5)


def test_a_whole_file_comes_through_its_process(mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PMI_RANK", "no number")  # an MPI started in there would end on it
    path = save(mpi_tmp_path / "a.ele")
    assert volume(read_mesh(COMM, path)) == pytest.approx(2.0, rel=WIDE)
    if COMM.rank == 0:
        here, there = meshio.read(path), read_foreign(path)
        assert np.array_equal(here.points, there.points)
        assert np.array_equal(here.cells[0].data, there.cells[0].data)


@pytest.mark.serial
@pytest.mark.parametrize("name", ["a.ply", "a.msh", "b" * 300 + ".msh"])
def test_its_complaints_are_one_sentence(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if len(name) < 99:
        path.write_text("not a mesh\n")
    with pytest.raises(MeshError, match=r"cannot read|cannot be read") as caught:
        read_mesh(COMM, path)
    assert str(caught.value).isprintable()


@pytest.mark.serial
def test_the_process_knows_nothing_of_mpi() -> None:
    tree = ast.parse(Path(softgrasp.fem.mesh.foreign.__file__).read_text(encoding="utf-8"))
    names = {n.module if isinstance(n, ast.ImportFrom) else a.name for n in ast.walk(tree)
             if isinstance(n, ast.Import | ast.ImportFrom) for a in n.names}  # fmt: skip
    assert {str(name).partition(".")[0] for name in names} <= {"meshio", *sys.stdlib_module_names}
