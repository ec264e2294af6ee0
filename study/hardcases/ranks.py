"""Hard case: one of two ranks fails alone, in the real command."""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

from softgrasp.study.hardcases.cases import LENGTH, Family, Outcome, Row, plain
from softgrasp.study.shell.doctor import IN_MPI_JOB, find_mpiexec, run_limited

# what happens, what must be said, and the same in a bare script
FAULTS: dict[str, tuple[str, str, str]] = {
    "disk": ("rank 1 cannot write its restart file", "cannot be written", 'raise OSError("disk full")'),
    "bug": ("a bug raises on rank 1 in the middle of the run", "RuntimeError", 'raise RuntimeError("a bug")'),
    "nan": ("the state of rank 1 turns NaN", "not finite", 'x = float("nan")'),
    "killed": ("rank 1 is killed by the system", "", "os.kill(os.getpid(), signal.SIGKILL)"),
}
LIMIT = {True: 20.0, False: 30.0}  # [s] of the job, start included; MPI starts in 1 to 3 s
BARE = """
import os, signal
from mpi4py import MPI
x = 1.0
if MPI.COMM_WORLD.rank == 1:
    {fault}
print(MPI.COMM_WORLD.allreduce(x))
"""
WORKER = "import sys; sys.path[:] = {path!r}; from softgrasp.study.hardcases.ranks import worker; worker(*sys.argv[1:])"


def inject(fault: str) -> None:
    """Make rank 1 of this job fail in the named way. Not collective."""
    import softgrasp.fem.run.checkpoint
    from softgrasp.fem import _stack as _stack
    from softgrasp.fem.run.simulate import Run

    step: Callable[..., None] = Run.step

    def disk(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    def faulty(run: Run, ts: Any) -> None:
        if run.reached == 20 and run.model.system.layout.comm.rank == 1:
            if fault == "bug":
                raise RuntimeError("a bug on rank 1")
            if fault == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            run.midpoint.r.array_w[:] = float("nan")
        step(run, ts)

    from mpi4py import MPI

    if fault == "disk":
        if MPI.COMM_WORLD.rank == 1:
            softgrasp.fem.run.checkpoint._write_rank = disk  # type: ignore[assignment]
    else:
        Run.step = faulty  # type: ignore[method-assign,assignment]


def worker(fault: str, folder: str) -> None:
    """The real `softgrasp simulate` with a fault on rank 1. Collective."""
    import softgrasp.fem  # noqa: F401  (threads and MPI first)
    from softgrasp.fem.scene.file import shipped_scenes
    from softgrasp.study.cli import main

    inject(fault)
    scene = str(shipped_scenes()["paper_forward"])
    sys.argv = ["softgrasp", "simulate", scene, "--out", folder, "--quiet", "--no-pictures"]
    for change in ("tissue.cells=[3,6]", "time.steps=60", "output.checkpoint_every=10", "output.fields='none'"):
        sys.argv += ["--set", change]
    main()


def job(command: list[str], limit: float, sentence: str) -> Outcome:
    """Seconds that two ranks take to end, or why that is no good end. Not collective."""
    mpiexec = find_mpiexec()
    if mpiexec is None:
        return Outcome(None, "no mpiexec found; `softgrasp doctor` says what to do")
    begin = time.perf_counter()
    status, output = run_limited([mpiexec, "-n", "2", sys.executable, *command], limit)
    seconds = time.perf_counter() - begin
    if status is None:
        return Outcome(float("inf"), f"hangs, still waiting after {limit:g} s")
    if status == 0:
        return Outcome(None, "ended with status 0, nobody noticed")
    if sentence not in output:
        return Outcome(None, f"ended without saying '{sentence}'")
    said = next((line.strip() for line in output.splitlines() if sentence and sentence in line), f"status {status}")
    return Outcome(seconds, re.sub(r"/\S*/(?=[^/\s])", "", said)[:LENGTH])


def rank_rows(quick: bool) -> list[Row]:
    """Two ranks, one of them fails; all must end, with a status and a sentence."""
    if any(variable in os.environ for variable in IN_MPI_JOB):
        return []  # an MPI job cannot start another one
    rows, limit = [], LIMIT[quick]
    reason = "start of the job and a few seconds: nobody waits for the rank that is gone"
    for i, fault in enumerate(["disk"] if quick else list(FAULTS)):
        text, sentence, same = FAULTS[fault]
        with tempfile.TemporaryDirectory() as folder:
            found = job(["-c", WORKER.format(path=sys.path), fault, folder], limit, sentence)
        bare = plain(job, ["-c", BARE.format(fault=same)], 5.0 if quick else 10.0, "")
        rows.append(Row(text, i + 1, found, bare, limit, reason))
    return rows


FAMILIES = (
    Family("rank", "A rank that fails alone", "fault", "seconds until all ranks have ended",
           "bare mpi4py script",
           "In a bare script the healthy rank waits for ever, or goes on with the NaN of the other; here all ranks "
           "agree on the failure or are ended.",
           rank_rows, axis="listed"),
)  # fmt: skip
