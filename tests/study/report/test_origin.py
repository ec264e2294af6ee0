"""Peak memory of the process itself."""

from __future__ import annotations

import subprocess
import sys

import pytest

MEASURE = """
import resource
import psutil
from mpi4py import MPI
from softgrasp.study.forward.result import peak_memory_mb
print(peak_memory_mb(MPI.COMM_SELF))
print(psutil.Process().memory_info().rss / 2**20, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


LAUNCH = """
import os, sys
block = b"x" * 700_000_000
os.execv(sys.executable, [sys.executable, "-c", sys.argv[1]])
"""


@pytest.mark.serial
def test_peak_memory_is_not_that_of_the_launcher() -> None:
    """A program that takes the place of a large one starts anew; getrusage does not."""
    run = subprocess.run([sys.executable, "-c", LAUNCH, MEASURE], capture_output=True, check=True, text=True)
    peak, now, usage = (float(x) for x in run.stdout.split())
    assert usage > 650  # MiB, of the launcher
    assert 0.9 * now < peak < 600  # DOLFINx and PETSc take a quarter of that
