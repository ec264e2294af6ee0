"""Other programs: the launcher of ranks, and a run that may take only so long. Loads neither MPI nor DOLFINx."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from softgrasp import PACKAGE
from softgrasp.fem import SoftgraspError

IN_MPI_JOB = ("PMI_RANK", "PMI_SIZE", "PMIX_RANK", "OMPI_COMM_WORLD_SIZE")


def in_mpi_job() -> bool:
    """Whether a launcher of ranks started this process."""
    return any(variable in os.environ for variable in IN_MPI_JOB)


def find_mpiexec() -> str | None:
    """The launcher beside this Python, else the first on PATH."""
    beside = Path(sys.executable).parent / "mpiexec"
    return str(beside) if os.access(beside, os.X_OK) else shutil.which("mpiexec")


def child_environment() -> dict[str, str]:
    """Environment in which another Python finds this very package."""
    path = os.pathsep.join(p for p in (str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")) if p)
    return os.environ | {"PYTHONPATH": path}


def run_limited(command: list[str], limit: float, environment: dict[str, str] | None = None) -> tuple[int | None, str]:
    """Run a command and all its children for at most ``limit`` [s]; status None when that was not enough.

    The children end with this program too: they do not hear Ctrl-C themselves.
    """
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True, env=environment
    ) as process:
        try:
            output, _ = process.communicate(timeout=limit)
        except BaseException as reason:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            if isinstance(reason, subprocess.TimeoutExpired):
                return None, output
            raise
    return process.returncode, output


def run_ranks(command: list[str], ranks: int, limit: float) -> tuple[int | None, str]:
    """:func:`run_limited` of this Python with arguments on several ranks, one thread each.

    Raises SoftgraspError: there is no launcher.
    """
    mpiexec = find_mpiexec()
    if mpiexec is None:
        raise SoftgraspError("no mpiexec found; `softgrasp doctor` says what to do")
    environment = child_environment() | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return run_limited([mpiexec, "-n", str(ranks), sys.executable, *command], limit, environment)
