"""Pictures are drawn beside the computation; files and errors come back as if they were drawn in place."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest
from mpi4py import MPI

from softgrasp.fem import forked as beside
from softgrasp.fem.errors import SceneError
from softgrasp.study.pictures.background import draw_in_background

HERE = os.getpid()
COMM = MPI.COMM_WORLD


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process can be forked on one core too."""
    monkeypatch.setattr(beside, "cores", lambda: 2)


def draw(out: Path) -> list[Path]:
    out.mkdir(parents=True, exist_ok=True)
    (out / "drawn.png").write_text(str(os.getpid()))
    return [out / "drawn.png"]


@pytest.mark.ranks(2)
def test_files_come_back(tmp_path: Path) -> None:
    out = tmp_path / "out"
    waits = draw_in_background(COMM, out, draw)
    assert not out.exists()  # a command that fails before it asks leaves nothing
    assert waits() == ([] if COMM.rank else [out / "drawn.png"])
    assert COMM.rank or ((out / "drawn.png").read_text() != str(HERE)) == (COMM.size == 1)


@pytest.mark.serial
def test_errors_come_back_and_a_lost_process_is_replaced(tmp_path: Path) -> None:
    def refuse(out: Path) -> list[Path]:
        raise SceneError("no such picture")

    with pytest.raises(SceneError, match="no such picture"):
        draw_in_background(COMM, tmp_path, refuse)()

    def killed(out: Path) -> list[Path]:
        if os.getpid() != HERE:
            os.kill(os.getpid(), signal.SIGKILL)
        return draw(out)

    assert draw_in_background(COMM, tmp_path, killed)() == [tmp_path / "drawn.png"]
    assert (tmp_path / "drawn.png").read_text() == str(HERE)


@pytest.mark.serial
def test_a_process_that_stands_still_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A lock that another thread had at the fork is never freed; one that computes is waited for."""
    monkeypatch.setattr(beside, "PATIENCE", 0.2)
    lock = threading.Lock()

    def waits(out: Path) -> list[Path]:
        if os.getpid() != HERE:
            lock.acquire()
        return draw(out)

    with lock:
        files = draw_in_background(COMM, tmp_path, waits)
        assert files() == [tmp_path / "drawn.png"]
    assert (tmp_path / "drawn.png").read_text() == str(HERE)

    def computes(out: Path) -> list[Path]:
        began = time.process_time()  # of this process, whose clock begins at the fork
        while time.process_time() - began < 2.5:
            pass
        return draw(out)

    monkeypatch.setattr(beside, "PATIENCE", 1.0)  # a loaded machine gives it a hundredth of that
    files = draw_in_background(COMM, tmp_path, computes)
    assert files() == [tmp_path / "drawn.png"]
    assert (tmp_path / "drawn.png").read_text() != str(HERE)
