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
from softgrasp.fem.forked import Pause, forked
from softgrasp.study.pictures.background import draw_in_background

HERE = os.getpid()
COMM = MPI.COMM_WORLD


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
    forked = COMM.size == 1 and len(os.sched_getaffinity(0)) > 1
    assert COMM.rank or ((out / "drawn.png").read_text() != str(HERE)) == forked


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
    assert (tmp_path / "drawn.png").read_text() != str(HERE) or len(os.sched_getaffinity(0)) == 1


@pytest.mark.serial
@pytest.mark.skipif(len(os.sched_getaffinity(0)) == 1, reason="one core has no other process")
def test_a_call_that_pauses_goes_on_when_it_is_asked_for(tmp_path: Path) -> None:
    """So that the times of either process are taken while the other one does nothing."""
    same = object()

    def works(pause: Pause) -> tuple[float, object]:
        assert pause(3) == "on"
        return time.monotonic(), same

    other = forked(works, (same,))
    assert other is not None
    with other:
        assert other.wait() == 3
        time.sleep(0.1)
        asked = time.monotonic()
        other.go_on("on")
        went_on, back = other.result()
    assert went_on >= asked
    assert back is same
    left = forked(lambda pause: time.sleep(100))
    assert left is not None
    with pytest.raises(SceneError), left:
        raise SceneError("an error here ends the other process")
    assert not left.process.is_alive()
