"""Hard case: one of two ranks fails alone, in the real command."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator

from softgrasp.fem.errors import SoftgraspError
from softgrasp.study.hardcases.cases import Family, HardCase, Outcome, short, textbook
from softgrasp.study.shell.processes import IN_MPI_JOB, child_environment, find_mpiexec, run_limited

# what happens, what must be said, and the same in a bare script
FAULTS: dict[str, tuple[str, str, str]] = {
    "disk": ("rank 1 cannot write its restart file", "cannot be written", 'raise OSError("disk full")'),
    "bug": ("a bug raises on rank 1 in the middle of the run", "RuntimeError", 'raise RuntimeError("a bug")'),
    "nan": ("the state of rank 1 turns NaN", "not finite", 'x = float("nan")'),
    "killed": ("rank 1 is killed by the system", "", "os.kill(os.getpid(), signal.SIGKILL)"),
}
HEALTHY_LIMIT = 600.0  # [s] for the run without a fault
# Times of a run without a fault on the same machine, measured just before, so that no bound judges the machine. A job
# that ends early needs less than one; the rest is for other work that comes in between. One that hangs never ends.
PATIENCE = 20.0
BARE_PATIENCE = 1.0  # the bare script only starts, which is a part of the run
BARE = """
import os, signal
from mpi4py import MPI
x = 1.0
if MPI.COMM_WORLD.rank == 1:
    {fault}
print(MPI.COMM_WORLD.allreduce(x))
"""
FAULTY = ["-m", "softgrasp.study.hardcases.faulty"]  # then fault and folder


def healthy_seconds() -> float:
    """Seconds of the command on two ranks without a fault: what this machine needs, loaded as it is."""
    with tempfile.TemporaryDirectory() as folder:
        status, output, seconds = job([*FAULTY, "", folder], HEALTHY_LIMIT)
    if status != 0:
        said = output.strip().splitlines()[-1:] or ["it says nothing"]
        raise SoftgraspError(f"a run on two ranks without a fault fails, status {status}: {said[0]}")
    return seconds


def job(command: list[str], limit: float) -> tuple[int | None, str, float]:
    """Run two ranks for at most ``limit`` [s]; status, None when that was not enough, output and seconds."""
    mpiexec = find_mpiexec()
    if mpiexec is None:
        raise SoftgraspError("no mpiexec found; `softgrasp doctor` says what to do")
    begin = time.perf_counter()
    status, output = run_limited([mpiexec, "-n", "2", sys.executable, *command], limit, child_environment())
    return status, output, time.perf_counter() - begin


def judge(command: list[str], patience: float, healthy: float, sentence: str) -> Outcome:
    """Time until both ranks have ended over that of a healthy run, or why that is no good end."""
    status, output, seconds = job(command, patience * healthy)
    if status is None:
        return Outcome(float("inf"), f"hangs, still waiting after {patience:g} times a healthy run")
    if status == 0:
        return Outcome(None, "status 0, the fault goes unnoticed")
    if sentence not in output:
        return Outcome(None, f"ended without saying '{sentence}'")
    said = next((line.strip() for line in output.splitlines() if sentence and sentence in line), f"status {status}")
    return Outcome(seconds / healthy, short(said))


def rank_rows(quick: bool) -> Iterator[HardCase]:
    """Two ranks, one of them fails; all must end, with a status and a sentence."""
    if any(variable in os.environ for variable in IN_MPI_JOB):
        return  # an MPI job cannot start another one
    healthy = healthy_seconds()
    reason = "all ranks must end sooner than a healthy run, times what other work may slow it down"
    for i, fault in enumerate(["disk"] if quick else list(FAULTS)):
        text, sentence, same = FAULTS[fault]
        with tempfile.TemporaryDirectory() as folder:
            outcome = judge([*FAULTY, fault, folder], PATIENCE, healthy, sentence)
        bare = textbook(judge, ["-c", BARE.format(fault=same)], BARE_PATIENCE, healthy, "")
        yield HardCase(text, i + 1, outcome, bare, PATIENCE, reason)


FAMILIES = (
    Family("rank", "A rank that fails alone", "fault", "time until all ranks have ended / time of a healthy run",
           "bare mpi4py script",
           "In a bare script the healthy rank waits for ever, or goes on with the NaN of the other; here all ranks "
           "agree on the failure or are ended.",
           rank_rows, axis="listed"),
)  # fmt: skip
