"""What lies in the folder of a run is the run's own and whole, or is refused with one sentence."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.checksums import read_manifest, write_arrays, write_manifest
from softgrasp.fem.errors import CheckpointError, Interrupted, ResourceError
from softgrasp.fem.model.build import build
from softgrasp.fem.resources import MARGIN, check_room
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.states.checkpoint import FORMAT
from softgrasp.fem.run.states.trajectory import Trajectory
from tests.helpers.models import make_scene

pytestmark = pytest.mark.ranks

HDF5 = {"snapshots": "hdf5"}


def run(folder: Path, *, target: tuple[float, float] = (5.0, 3.0), output: Any = None, **how: Any) -> Trajectory:
    scene = make_scene(
        tissue={"cells": [3, 6]}, time={"steps": 12}, motion={"target": list(target)}, output=output or {}
    )
    return simulate(build(scene, comm=MPI.COMM_WORLD), RunOptions(folder, **how))


def stopped(folder: Path, step: int, **how: Any) -> None:
    with pytest.raises(Interrupted):
        run(folder, until=step, **how)


def copy(comm: MPI.Intracomm, source: Path, target: Path) -> None:
    """A folder in place of another one. Collective."""
    comm.Barrier()
    if comm.rank == 0:
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
    comm.Barrier()


def test_snapshots_of_another_run_in_the_folder_do_not_resume(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """Even of the same scene: a force given from Python, which no scene names, may differ."""
    stopped(mpi_tmp_path, 6, output=HDF5)
    run(mpi_tmp_path, target=(1.0, -2.0), output=HDF5)
    with pytest.raises(CheckpointError, match=r"snapshots-rank0\.h5 belongs to another run"):
        run(mpi_tmp_path, resume=True, output=HDF5)


def test_another_run_that_is_killed_leaves_the_restart_files_whole(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """It has written its file of the same step on some ranks, and no manifest."""
    stopped(mpi_tmp_path / "a", 6)
    stopped(mpi_tmp_path / "b", 6, target=(1.0, -2.0))
    if comm.rank == 0:
        for file in mpi_tmp_path.glob("b/checkpoint/*-rank0.*"):
            shutil.copy(file, mpi_tmp_path / "a" / "checkpoint")
    comm.Barrier()
    rest = run(mpi_tmp_path / "a", resume=True)
    assert np.array_equal(rest.final, run(mpi_tmp_path / "whole").final)


def test_a_checkpoint_removes_what_older_ones_left(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    stopped(mpi_tmp_path, 4, target=(1.0, -2.0))
    stopped(mpi_tmp_path, 6)
    stopped(mpi_tmp_path, 8, resume=True)
    files = {path.name for path in (mpi_tmp_path / "checkpoint").iterdir()}
    name = read_manifest(mpi_tmp_path / "checkpoint" / "checkpoint.json", FORMAT)["run"]
    assert files == {"checkpoint.json", *(f"{name}-step8-rank{rank}.npz" for rank in range(comm.size))}


def test_every_damage_of_a_restart_file_is_refused(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """One bit anywhere, a cut, nothing, gone: in the file of the last rank, in the manifest, and in the snapshots."""
    stopped(mpi_tmp_path / "good", 6, output=HDF5)
    work, random = mpi_tmp_path / "work", np.random.default_rng(7)
    for pattern, tries in ((f"checkpoint/*-rank{comm.size - 1}.npz", 6), ("checkpoint/checkpoint.json", 6)):
        for attempt in range(tries + 3):
            copy(comm, mpi_tmp_path / "good", work)
            path = next(work.glob(pattern))
            data = bytearray(path.read_bytes())
            if attempt < tries:
                data[random.integers(len(data))] ^= 1 << int(random.integers(8))
            elif attempt < tries + 2:
                data = data[: (attempt - tries) * len(data) // 2]
            comm.Barrier()
            if comm.rank == 0:
                path.write_bytes(data)
                if attempt == tries + 2:
                    path.unlink()
            comm.Barrier()
            with pytest.raises(CheckpointError, match=path.name):
                run(work, resume=True, output=HDF5)
    copy(comm, mpi_tmp_path / "good", work)
    run(work, resume=True, output=HDF5)  # the copy without damage goes on


def test_a_damaged_column_of_streamed_snapshots_is_refused(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    stopped(mpi_tmp_path, 6, output=HDF5)
    path = mpi_tmp_path / f"snapshots-rank{comm.size - 1}.h5"
    if comm.rank == 0:
        with h5py.File(path) as file:
            offset = file["Z"].id.get_chunk_info_by_coord((4, 0)).byte_offset
        data = bytearray(path.read_bytes())
        data[offset + 3] ^= 4
        path.write_bytes(data)
    comm.Barrier()
    with pytest.raises(CheckpointError, match=rf"{path.name} is damaged"):
        run(mpi_tmp_path, resume=True, output=HDF5)


@pytest.mark.parametrize("text", ["[]", "7", '{"format": 4}', '{"format": "x"}', "\xff", "[" * 5000, ""])
@pytest.mark.serial
def test_a_manifest_that_is_none_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "checkpoint.json").write_text(text, encoding="latin-1")
    with pytest.raises(CheckpointError, match=r"checkpoint\.json (is damaged|cannot be read)"):
        read_manifest(tmp_path / "checkpoint.json", 4)


def test_a_restart_file_of_other_nodes_is_refused(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """Whole, but another version of the mesh library may number the mesh in another way."""
    stopped(mpi_tmp_path, 6)
    path = next(mpi_tmp_path.glob(f"checkpoint/*-rank{comm.rank}.npz"))
    with np.load(path) as data:
        arrays = dict(data)
    files = comm.allgather((path.name, write_arrays(path, arrays | {"numbering": np.zeros(32)})))
    if comm.rank == 0:
        manifest = mpi_tmp_path / "checkpoint" / "checkpoint.json"
        entry = {key: value for key, value in json.loads(manifest.read_text()).items() if key != "sha256"}
        write_manifest(manifest, entry | {"files": files})
    comm.Barrier()
    with pytest.raises(CheckpointError, match="written with other nodes on rank 0"):
        run(mpi_tmp_path, resume=True)


@pytest.mark.parametrize("every", [1, 5, 100])
def test_snapshots_stream_through_the_smallest_buffer(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch, every: int
) -> None:
    """A column larger than the buffer, and a stride longer than the run."""
    monkeypatch.setattr("softgrasp.fem.run.states.streamed.BUFFER_BYTES", 1)
    run(mpi_tmp_path, output={"snapshots": "hdf5", "every": every})
    memory = run(mpi_tmp_path, output={"every": every}).snapshots
    assert memory is not None
    start, n = memory.layout.start, memory.layout.n_local
    with h5py.File(mpi_tmp_path / "snapshots.h5") as file:
        assert np.array_equal(file["z"][:, start : start + n], memory.Z[:n].T)
        assert np.array_equal(file["v"][:, start : start + n], memory.Z[n:].T)
        assert np.array_equal(file["steps"], memory.steps)


def test_room_counts_all_ranks_and_the_size_so_far(
    comm: MPI.Intracomm, mpi_tmp_path: Path, small_files: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = mpi_tmp_path / f"file{comm.rank}"
    own.write_bytes(bytes(5000))
    limit = MARGIN + 6000
    small_files(limit)
    check_room(comm, [own], 1000)
    with pytest.raises(ResourceError, match=f"may pass {limit} bytes"):
        check_room(comm, [own], 1001)
    monkeypatch.setattr(
        "softgrasp.fem.resources.shutil.disk_usage", lambda path: SimpleNamespace(free=MARGIN + 100 * comm.size + 7)
    )
    check_room(comm, [own], 100, reserve=7)
    with pytest.raises(ResourceError, match="are free on the disk"):
        check_room(comm, [own], 100, reserve=8)


@pytest.mark.serial
def test_a_full_disk_is_named_by_the_file(tmp_path: Path) -> None:
    """The device that is always full, through the real writer."""
    with pytest.raises(OSError, match="No space left"):
        write_arrays(Path("/dev/full"), {"x": np.zeros(100_000)})


def test_room_that_is_gone_when_it_is_taken_ends_all_ranks(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with a quota, which no question for free room shows: HDF5 itself would end the program."""
    monkeypatch.setattr("softgrasp.fem.run.states.streamed.check_room", lambda *_: None)

    def refuse(file: int, at: int, size: int) -> None:
        assert size > 0
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    if comm.rank == comm.size - 1:
        monkeypatch.setattr("os.posix_fallocate", refuse)
    model = build(make_scene(output=HDF5), comm=comm)
    with pytest.raises(ResourceError, match=r"snapshots-rank\d\.h5 cannot be written .*quota"):
        simulate(model, RunOptions(mpi_tmp_path))
