"""Benchmark rows as programs of their own under mpiexec, so that none inherits memory or caches from another."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from softgrasp.study.shell.processes import child_environment, find_mpiexec


def launch_worker(name: str, spec: dict[str, Any], ranks: int, limit: float = 3600.0) -> dict[str, Any]:
    """Run ``python -m softgrasp.study.bench worker NAME SPEC`` on some ranks; its numbers, or ``error``.

    Args:
        name: of the benchmark.
        spec: arguments of the function that measures a row, fit for JSON.
        ranks: MPI ranks.
        limit: longest time [s].
    """
    mpiexec = find_mpiexec()
    if mpiexec is None:
        return {"error": "no mpiexec found; `softgrasp doctor` says what to do"}
    environment = child_environment() | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "row.json"
        text = json.dumps(spec | {"file": str(file)})
        command = [mpiexec, "-n", str(ranks), sys.executable, "-m", "softgrasp.study.bench", "worker", name, text]
        try:
            done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired:
            return {"error": f"no result after {limit:g} s"}
        if done.returncode == 0 and file.is_file():
            return dict(json.loads(file.read_text()))
    lines = (done.stderr + done.stdout).strip().splitlines() or ["no output"]
    said = next((line for line in lines if "Error: " in line and not line.startswith(" ")), lines[-1])
    return {"error": f"exit status {done.returncode}: {said}"}


def leave_result(file: str, measure: Callable[[], dict[str, Any]]) -> None:
    """Inside a worker: measure, and leave the numbers where the launcher looks. Collective."""
    comm = MPI.COMM_WORLD
    try:
        result = measure()
        if comm.rank == 0:
            Path(file).write_text(json.dumps(result))
    except Exception:
        if comm.size == 1:
            raise
        # the other ranks may wait in a collective call
        sys.stderr.write(traceback.format_exc())
        sys.stderr.flush()
        comm.Abort(1)
