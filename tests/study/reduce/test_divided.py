"""Work that ranks take in turn."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import pytest
from mpi4py import MPI

from softgrasp.study.reduce.linear.ranks import dealt, divided


@pytest.mark.ranks
@pytest.mark.parametrize("shares", [True, False])
def test_a_rank_that_is_done_takes_calls_that_were_meant_for_another(
    comm: MPI.Intracomm, tmp_path: Path, shares: bool
) -> None:
    """The first call waits until the two behind it in its rank's share are made; every rank has all results."""
    if comm.size == 1:
        return
    folder = Path(comm.bcast(str(tmp_path)))

    def waiting() -> int:
        end = time.monotonic() + 60.0  # only where nobody takes them
        while not all((folder / name).exists() for name in "ab"):
            assert time.monotonic() < end, "nobody takes the calls"
            time.sleep(1e-3)
        return comm.rank

    def noted(name: str) -> int:
        (folder / name).touch()
        return comm.rank

    calls = [waiting, partial(noted, "a"), partial(noted, "b")]
    if shares:
        found = divided(comm, [calls, *([partial(int, rank)] for rank in range(1, comm.size))])
        assert found[3:] == list(range(1, comm.size))
    else:
        found = dealt(comm, calls)
    assert found == comm.bcast(found)
    assert all(0 <= rank < comm.size for rank in found[:3])
