"""Ranks that wait for another one leave it the cores."""

from __future__ import annotations

import time

import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SceneError, raise_on_all_ranks
from softgrasp.fem.petsc import folded, on_root

WORK = 1.0  # [s] that rank 0 takes, asleep itself, so that what others spend is theirs


@pytest.mark.ranks
@pytest.mark.parametrize("how", ["raise_on_all_ranks", "on_root"])
def test_ranks_that_wait_sleep(comm: MPI.Intracomm, how: str) -> None:
    comm.Barrier()
    begin = time.process_time()
    if how == "raise_on_all_ranks":
        with raise_on_all_ranks(comm):
            time.sleep(WORK * (comm.rank == 0))
    else:
        on_root(comm, lambda: time.sleep(WORK))
    spent = time.process_time() - begin
    assert spent < 0.25 * WORK  # spinning takes all of it; naps of 20 ms are woken fifty times


@pytest.mark.ranks
def test_an_error_reaches_the_ranks_that_sleep(comm: MPI.Intracomm) -> None:
    def fail() -> None:
        with raise_on_all_ranks(comm):
            if comm.rank == 0:
                time.sleep(0.1)
                raise SceneError("of rank 0")

    with pytest.raises(SceneError, match="of rank 0"):
        fail()


@pytest.mark.ranks
@pytest.mark.parametrize("where", ["a part", "a fold"])
def test_an_error_in_a_tree_of_parts_reaches_all_ranks(comm: MPI.Intracomm, where: str) -> None:
    """Of a part on the last rank, of a fold on the one rank that folds; the others would wait for ever."""

    def part() -> str:
        if where == "a part" and comm.rank == comm.size - 1:
            raise SceneError(f"of {where}")
        return str(comm.rank)

    def fold(upper: str, lower: str) -> str:
        if where == "a fold" and lower == str(comm.size - 1):
            raise SceneError(f"of {where}")
        return upper + lower

    if comm.size == 1 and where == "a fold":
        assert folded(comm, part, fold) == "0"
        return
    with pytest.raises(SceneError, match=f"of {where}"):
        folded(comm, part, fold)


@pytest.mark.ranks
def test_parts_are_folded_in_the_order_of_the_ranks(comm: MPI.Intracomm) -> None:
    whole = folded(comm, lambda: str(comm.rank), lambda upper, lower: upper + lower)
    assert comm.bcast(whole) == "".join(map(str, range(comm.size)))
