"""``python -m tests.hardcases.faulty FAULT FOLDER``: `softgrasp simulate` in which rank 1 fails.

A program of its own that nobody imports, so that nothing of the suite runs with the fault.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import softgrasp.fem.run.states.checkpoint
from softgrasp.fem import _stack as _stack
from softgrasp.fem.run.simulate import Run
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.shell.ending import console, rank, run_command

CHANGES = ["tissue.cells=[3,6]", "time.steps=60", "output.checkpoint_every=10", "output.fields='none'"]


def inject(fault: str) -> None:
    """Make this process fail in the named way, or not at all when the name is empty."""
    step: Callable[..., None] = Run.step

    def disk(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    def faulty(run: Run, ts: Any) -> None:
        if run.reached == 20:
            if fault == "bug":
                raise RuntimeError("a bug on rank 1")
            if fault == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            run.midpoint.r.array_w[:] = float("nan")
        step(run, ts)

    if fault == "disk":
        vars(softgrasp.fem.run.states.checkpoint)["write_arrays"] = disk
    elif fault:
        Run.step = faulty  # type: ignore[method-assign,assignment]


def main(fault: str, folder: str) -> None:
    """The run on a coarse mesh, with the fault on rank 1. Collective."""
    if rank() == 1:
        inject(fault)
    run_simulate(shipped_scenes()["paper_forward"], Path(folder), CHANGES, console(), quiet=True, pictures=False)


if __name__ == "__main__":
    run_command(lambda: main(*sys.argv[1:]))
