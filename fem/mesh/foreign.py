"""Read a mesh file with meshio, here or in a process of its own: meshio waits for ever in some damaged files.

As a program this module imports nothing but meshio, so that it starts no MPI.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import meshio

# Read here, without the start of a process (a quarter of a second): thousands of damaged files always came to an end.
_SAFE = {".inp": "abaqus", ".mesh": "medit", ".vtk": "vtk", ".vtu": "vtu", ".xdmf": "xdmf", ".xmf": "xdmf"}
_GMSH = b"$MeshFormat"  # .msh is a suffix of Ansys too
_LAUNCHERS = ("PMI", "MPI", "OMPI", "HYDRA", "HYDI", "I_MPI", "SLURM")  # an HDF5 with MPI would join the running job
LEAST, PER_BYTE = 10.0, 1e-6  # [s, s/byte]: ten times the time of text files
WAIT = 20  # seconds on the clock for one of the processor: others may use the machine


def default_limit(path: Path) -> float:
    """Processor time after which a file counts as damaged, by its size [s]."""
    return LEAST + PER_BYTE * path.stat().st_size


def read_foreign(path: Path, limit: float | None = None) -> meshio.Mesh:
    """Read a mesh file of any format of meshio.

    ``limit``: longest processor time for formats that may never end [s]; by size if None.

    Raises:
        ValueError: meshio's reason why it cannot read the file.
        TimeoutError: the limit was reached; the argument is the limit.
        OSError: the file cannot be opened, or no process started.
    """
    with path.open("rb") as file:
        gmsh = path.suffix.lower() == ".msh" and file.read(len(_GMSH)) == _GMSH
    kind = "gmsh" if gmsh else _SAFE.get(path.suffix.lower())
    if kind is not None:
        return _read(str(path), kind)
    seconds = math.ceil(default_limit(path) if limit is None else limit)
    clean = {name: value for name, value in os.environ.items() if not name.startswith(_LAUNCHERS)}
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "mesh"
        command = [sys.executable, "-P", __file__, str(path), str(target), str(seconds)]
        try:
            done = subprocess.run(
                command, env=clean, stdin=subprocess.DEVNULL, capture_output=True, timeout=WAIT * seconds
            )
        except subprocess.TimeoutExpired:
            raise TimeoutError(seconds) from None
        if done.returncode == -getattr(signal, "SIGXCPU", 0):
            raise TimeoutError(seconds)
        if done.returncode or not target.is_file():
            raise ValueError(f"its process ended with status {done.returncode}")
        answer = pickle.loads(target.read_bytes())
    if isinstance(answer, str):
        raise ValueError(answer)
    assert isinstance(answer, meshio.Mesh)
    return answer


def _read(path: str, kind: str | None) -> meshio.Mesh:
    """The mesh of a file by the format of that name; None: by its suffix. Raises ValueError: meshio's reason."""
    printed = io.StringIO()
    try:
        # meshio prints its complaints and may end the process; one sentence is enough.
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            return meshio.read(path, kind)
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{error if not isinstance(error, SystemExit) else ''} {printed.getvalue()}".split())
        raise ValueError(reason or type(error).__name__) from error


def _leave(path: str, target: str, seconds: int) -> None:
    """The program: write to ``target`` the mesh, or the reason as a text; ``seconds`` limit its processor time."""
    with contextlib.suppress(ImportError, ValueError):  # not POSIX, or a lower limit already: the clock then decides
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    answer: meshio.Mesh | str
    try:
        answer = _read(path, None)
    except ValueError as error:
        answer = str(error)
    Path(target).write_bytes(pickle.dumps(answer))


if __name__ == "__main__":
    _leave(sys.argv[1], sys.argv[2], int(sys.argv[3]))
