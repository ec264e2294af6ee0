"""Times of calls."""

from __future__ import annotations

import time

import pytest
from mpi4py import MPI

from softgrasp.study.shell import median_processor_seconds, processor_seconds


@pytest.mark.parametrize("tick", [0.0, 3600.0])
def test_a_short_call_takes_time_where_the_system_counts_in_ticks(tick: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Speed-ups divide by these seconds; some virtual machines count processor time in ticks of 10 ms."""
    own = time.process_time
    monkeypatch.setattr(time, "process_time", lambda: own() // tick * tick if tick else own())
    assert processor_seconds(MPI.COMM_SELF, lambda: None) > 0
    assert processor_seconds(MPI.COMM_SELF, lambda: time.sleep(0.1)) < 0.05  # which takes no processor time
    assert median_processor_seconds(MPI.COMM_SELF, lambda: None, 3) > 0
