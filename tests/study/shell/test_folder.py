"""A folder belongs to one run at a time and to one scene; `--empty` removes what the list of its files names."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem import owned
from softgrasp.fem.errors import SceneError
from softgrasp.fem.owned import LIST, LOCK, Process, hold, locked, note, read_list, release
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.runs.listing import run_compare
from softgrasp.study.shell.folder import claim, default_folder, folder_lock

SMALL = ["tissue.cells=[3,6]", "time.steps=20", "output.frames=2"]
QUIET = Console(quiet=True)


@pytest.fixture(autouse=True)
def given_back() -> None:
    release()


def leave(folder: Path, command: str = "simulate", scene: str = "strip") -> None:
    """A finished run of two files."""
    claim(folder, command, scene)
    (folder / "models").mkdir(exist_ok=True)
    for name, text in {"models/psd.h5": "x", "result.json": json.dumps({"command": command, "scene": scene})}.items():
        note(folder / name)
        (folder / name).write_text(text)
    release()


@pytest.mark.serial
def test_every_scene_and_command_has_its_folder() -> None:
    assert default_folder("reduce", Path("a/strip.toml")) == Path("out/strip-reduce")


@pytest.mark.serial
def test_a_folder_of_another_run_is_refused_or_emptied(tmp_path: Path) -> None:
    out = tmp_path / "run"
    claim(out, "simulate", "strip", empty=True)  # not there yet
    release()
    assert not out.exists()  # made for nothing
    leave(out)
    claim(out, "simulate", "strip")
    assert (out / "models" / "psd.h5").exists()  # the same run again writes over its own files
    for command, scene in (("reduce", "strip"), ("simulate", "block")):
        with pytest.raises(SceneError, match=r"results of simulate on strip; .* --empty"):
            claim(out, command, scene)
        assert not (out / LOCK).exists()
    claim(out, "reduce", "block", empty=True)
    assert {path.name for path in out.iterdir()} == {LIST, LOCK}
    assert read_list(out) == (("reduce", "block"), set())


@pytest.mark.serial
def test_a_folder_of_a_stopped_run_is_its_scenes(tmp_path: Path) -> None:
    out = tmp_path / "run"
    run_simulate(shipped_scenes()["paper_forward"], out, SMALL, QUIET, quiet=True, pictures=False, until=10)
    assert not (out / "result.json").exists()
    with pytest.raises(SceneError, match="it contains the results of simulate on paper_forward"):
        run_simulate(shipped_scenes()["paper_lqr"], out, SMALL, QUIET, quiet=True, pictures=False)
    (out / "notes.txt").write_text("mine")
    claim(out, "simulate", "strip", empty=True)
    release()
    assert [path.name for path in out.iterdir()] == ["notes.txt"]  # the list of the stopped run was complete


@pytest.mark.serial
def test_only_files_of_the_list_are_removed(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    leave(out)
    for name in (".git/config", "models/mine.h5", "sub/result.json", "hand.csv"):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text("years of work")
    leave(elsewhere)
    (out / "linked").symlink_to(elsewhere)
    with (out / LIST).open("a") as lines:  # as a damaged or a foreign list may be
        lines.write(
            '"../elsewhere/result.json"\n"linked/result.json"\n"/etc/hostname"\n["models"]\n{"command": 1\n"sub'
        )
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    claim(out, "simulate", "strip", empty=True)
    release()
    gone = {path.relative_to(out).as_posix() for path in before if not path.exists()}
    assert gone == {"result.json", "models/psd.h5", LIST}
    assert (out / "linked").is_symlink()


@pytest.mark.serial
def test_a_folder_without_a_list_is_not_emptied(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text(json.dumps({"command": "simulate", "scene": "strip"}))
    with pytest.raises(SceneError, match=r"no such list.*by hand"):
        claim(tmp_path, "simulate", "strip", empty=True)
    with pytest.raises(SceneError, match="results of simulate on strip"):  # of a version that wrote no list
        claim(tmp_path, "reduce", "strip")
    assert (tmp_path / "result.json").exists()


@pytest.mark.serial
def test_what_a_command_reads_is_not_removed(tmp_path: Path) -> None:
    scene, hand = shipped_scenes()["paper_forward"], tmp_path / "a" / "hand.csv"
    for name in "ab":
        run_simulate(scene, tmp_path / name, SMALL, QUIET, quiet=True, pictures=False)
    with pytest.raises(SceneError, match=r"--empty would also remove .*/a"):
        run_compare(tmp_path / "a", tmp_path / "b", tmp_path / "a", QUIET, empty=True)
    own = tmp_path / "a" / "scene.toml"
    with pytest.raises(SceneError, match=r"--empty would also remove .*scene\.toml"):
        run_simulate(own, tmp_path / "a", [], QUIET, quiet=True, pictures=False, empty=True)
    hand.write_text("0,0,0\n1,1,1\n3,5,3\n")  # no run wrote it, so it is kept and can be read
    table = [*SMALL, f"motion={{profile='csv', csv='{hand}', drive='motion'}}"]
    run_simulate(scene, tmp_path / "a", table, QUIET, quiet=True, pictures=False, empty=True)
    assert hand.exists()
    with (tmp_path / "a" / LIST).open("a") as lines:
        lines.write('"hand.csv"\n')
    with pytest.raises(SceneError, match=r"--empty would also remove .*hand\.csv"):
        run_simulate(scene, tmp_path / "a", table, QUIET, quiet=True, pictures=False, empty=True)


@pytest.mark.serial
def test_the_list_names_all_that_a_run_writes(tmp_path: Path) -> None:
    more = ["output.snapshots='hdf5'", "output.checkpoint_every=7"]
    run_simulate(shipped_scenes()["paper_forward"], tmp_path, [*SMALL, *more], QUIET, quiet=True)
    there = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()} - {LIST}
    assert {"move.png", "move.gif", "snapshots.h5", "checkpoint/checkpoint.json", "fields/000000.vtu"} <= there
    assert there <= read_list(tmp_path)[1]


@pytest.mark.serial
def test_a_second_process_is_refused_while_the_first_runs(tmp_path: Path) -> None:
    out = tmp_path / "run"
    code = (
        "import sys, time; from pathlib import Path; from softgrasp.fem.owned import hold\n"
        f"hold(Path({str(out)!r})); print('held', flush=True); time.sleep(100)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None
        first.stdout.readline()
        with pytest.raises(SceneError, match=f"process {first.pid} runs in this folder; name another folder, or wait"):
            claim(out, "simulate", "strip")
        with pytest.raises(SceneError, match="runs in this folder"):
            claim(out, "simulate", "strip", empty=True)
        first.kill()  # leaves its lock
        first.wait()
    assert (out / LOCK).exists()
    claim(out, "simulate", "strip")
    assert json.loads((out / LOCK).read_text())["pid"] == os.getpid()
    release()
    assert not out.exists() or not (out / LOCK).exists()


@pytest.mark.serial
@pytest.mark.parametrize(
    ("holder", "words"),
    [
        ({"host": "node7 x", "pid": 12, "started": 0.0}, r"process 12 on node7 has locked .* remove .*softgrasp\.lock"),
        ({"pid": 12}, "is damaged; remove it if no run"),
        ([1], "is damaged"),
        (None, ""),  # this number was given to another process since
    ],
)  # fmt: skip
def test_locks_that_are_foreign_damaged_or_old(tmp_path: Path, holder: object, words: str) -> None:
    old = Process(Process.own().host, os.getppid(), time.time() - 1e6)
    (tmp_path / LOCK).write_text(json.dumps(vars(old) if holder is None else holder))
    if words:
        with pytest.raises(SceneError, match=words):
            hold(tmp_path)
        assert (tmp_path / LOCK).exists()
    else:
        hold(tmp_path)
    assert socket.gethostname() in Process.own().host


@pytest.mark.ranks
def test_a_library_run_that_streams_holds_its_folder(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    if comm.rank == 0:
        (mpi_tmp_path / LOCK).write_text(json.dumps({"host": "node7 x", "pid": 12, "started": 0.0}))
    comm.Barrier()
    with pytest.raises(SceneError, match="process 12 on node7"), locked(comm, mpi_tmp_path):
        pytest.fail("entered")  # on any rank
    assert owned._held is None


def test_a_command_inside_another_leaves_the_outer_one_its_folder(tmp_path: Path) -> None:
    """Elsewhere and in the same folder, also where the inner one fails."""
    outer, inner = tmp_path / "outer", tmp_path / "inner"

    @folder_lock()
    def run(out: Path, *others: Path) -> None:
        claim(out, "simulate", "block")
        for other in others:
            run(other)
            assert (out / LOCK).is_file()
            assert (other / LOCK).is_file() == (other == out)
        note(out / "result.json")
        if others:
            (out / "result.json").write_text("{}")

    run(outer, inner, outer)
    assert not (outer / LOCK).exists()
    assert read_list(outer) == (("simulate", "block"), {"result.json"})
    assert not inner.exists()
    with folder_lock():
        claim(outer, "simulate", "block")
        with pytest.raises(SceneError, match="contains the results of simulate on block"), folder_lock():
            claim(outer, "reduce", "strip")
        assert (outer / LOCK).is_file()
    assert not (outer / LOCK).exists()
