"""Work that a forked process shares: results, errors, pauses, and a process that is lost."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from softgrasp.fem import forked as module
from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.forked import Pause, forked, shared

HERE = os.getpid()
pytestmark = pytest.mark.serial


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process can be forked on one core too."""
    monkeypatch.setattr(module, "cores", lambda: 2)


class RefusedError(SoftgraspError):
    """One whose call takes more than a text, and keeps what cannot be told from it."""

    def __init__(self, text: str, N: int) -> None:
        super().__init__(f"{text}, N = {N}")
        self.N = N


def numbered(i: int) -> tuple[int, bool]:
    return i, os.getpid() == HERE


def test_a_call_that_pauses_goes_on_when_it_is_asked_for() -> None:
    """So that the times of either process are taken while the other one does nothing."""
    same = object()

    def works(pause: Pause) -> tuple[float, object]:
        assert pause(3) == "on"
        return time.monotonic(), same

    other = forked(works, (same,))
    assert other is not None
    with other:
        assert other.wait() == 3
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


def test_shared_calls_come_back_in_their_order_each_made_once() -> None:
    """Each process waits in its first call until the other one is in its own: both are at work."""
    (ask, asked), (answer, answered) = os.pipe(), os.pipe()
    same = object()

    def meets(put: int, get: int) -> tuple[int, bool, object]:
        os.write(put, b"x")
        assert os.read(get, 1) == b"x"
        return 0, os.getpid() == HERE, same

    def call(i: int) -> Callable[[], Any]:
        return partial(numbered, i)

    own: list[Callable[[], Any]] = [lambda: meets(asked, answer), *map(call, range(1, 5))]
    beside: list[Callable[[], Any]] = [lambda: meets(answered, ask), *map(call, range(5, 8))]
    found = shared(own, beside, (same,))
    assert [each[0] for each in found] == [0, 1, 2, 3, 4, 0, 5, 6, 7]
    assert found[0] == (0, True, same)
    assert found[5] == (0, False, same)
    for end in (ask, asked, answer, answered):
        os.close(end)


def test_the_one_that_is_done_helps_the_other() -> None:
    """The other process stays in its first call until this one has made all the others."""
    (begun, begin), (done, finish) = os.pipe(), os.pipe()

    def first() -> tuple[int, bool]:
        os.read(begun, 1)
        return numbered(0)

    def waits() -> tuple[int, bool]:
        os.write(begin, b"x")
        os.read(done, 1)
        return numbered(9)

    def last() -> tuple[int, bool]:
        os.write(finish, b"x")
        return numbered(2)

    # this process takes own calls first, then those beside it from their end
    own: list[Callable[[], Any]] = [first, partial(numbered, 1)]
    found = shared(own, [waits, last, partial(numbered, 3)])
    assert found == [(0, True), (1, True), (9, False), (2, True), (3, True)]
    for end in (begun, begin, done, finish):
        os.close(end)


def test_a_lost_process_and_no_other_process_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(i: int) -> int:
        if os.getpid() != HERE:
            os.kill(os.getpid(), signal.SIGKILL)
        return i

    own, beside = ([partial(killed, i) for i in part] for part in ((0, 1), (2, 3)))
    assert shared(own, beside) == [0, 1, 2, 3]
    monkeypatch.setattr(module, "cores", lambda: 1)
    assert shared(own, [partial(numbered, 2)]) == [0, 1, (2, True)]
    assert shared(own, []) == [0, 1]
    assert shared([], beside) == [2, 3]


def test_more_calls_than_a_pipe_holds_bytes_are_made_here(monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr(os, "write", lambda pipe, data: write(pipe, data[:3]))
    many = [partial(numbered, i) for i in range(6)]
    assert shared(many[:4], many[4:]) == [(i, True) for i in range(6)]


def test_an_error_there_is_raised_here_with_its_sentence() -> None:
    """Whatever the call of the error takes."""
    done, finish = os.pipe()

    def refuse() -> None:
        os.write(finish, b"x")
        raise RefusedError("too many columns", 4)

    def waits() -> None:
        os.read(done, 1)

    with pytest.raises(RefusedError, match="too many columns, N = 4") as caught:
        shared([waits], [refuse])
    assert caught.value.N == 4
    os.close(done)
    os.close(finish)
