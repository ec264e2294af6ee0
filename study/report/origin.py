"""Where the numbers of a result come from: scene, version, machine, memory, command line."""

from __future__ import annotations

import platform
import resource
import shlex
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mpi4py import MPI
from slepc4py import SLEPc

from softgrasp import PACKAGE, __version__
from softgrasp.fem import PETSc, Scene, scene_hash


def peak_memory_mb(comm: MPI.Intracomm) -> float:
    """Largest resident memory so far, summed over the ranks [MiB]. Collective.

    Linux's VmHWM starts anew with this program, unlike ``ru_maxrss``, which may show that of the launcher.
    """
    try:
        text = Path("/proc/self/status").read_text()
        local = next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):  # no Linux
        local = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return float(comm.allreduce(local))


def machine() -> str:
    """Processor, system and Python, as results name them."""
    return f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def origin(scene: Scene, ranks: int) -> dict[str, Any]:
    """Where the numbers of a result come from: the first keys of its ``result.json``."""
    return {
        "scene": scene.name,
        "scene_hash": scene_hash(scene),
        "version": __version__,
        "ranks": ranks,
        "machine": machine(),
    }


PACKAGES = {"DOLFINx": ("fenics-dolfinx", "dolfinx-solver-real"), "NumPy": ("numpy",), "SciPy": ("scipy",)}


def command_line(command: str, path: Path, overrides: Sequence[str], ranks: int, options: str = "") -> str:
    """The command line that writes a page again."""
    launch = f"mpiexec -n {ranks} " if ranks > 1 else ""
    sets = "".join(f" --set {shlex.quote(o)}" for o in overrides)
    return f"{launch}softgrasp {command} {shlex.quote(str(path))}{sets}{options}"


def made_with(result: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Sizes, versions and seconds behind a result."""
    known = {**result, **result.get("sizes", {})}
    sizes = [(key, known[key]) for key in ("n_s", "n_e", "states", "cells", "steps", "ranks") if key in known]
    times = [(f"time, {k}", f"{v:.3g} s") for k, v in result.get("time", {}).items() if isinstance(v, float)]
    return [*sizes, *versions(), *((k, result[k]) for k in ("scene_hash",) if k in result), *times]


def versions() -> list[tuple[str, str]]:
    """Versions of this program and of what its numbers come from."""
    commit = _commit(PACKAGE.parent / ".git")
    rows = [("softgrasp", __version__ + (f", commit {commit}" if commit else ""))]
    for name, distributions in PACKAGES.items():
        installed = [text for distribution in distributions if (text := _version(distribution))]
        rows += [(name, installed[0])] if installed else []
    rows += [(name, ".".join(map(str, sys.getVersion()))) for name, sys in (("PETSc", PETSc.Sys), ("SLEPc", SLEPc.Sys))]
    library = MPI.Get_library_version().splitlines()[0].split(",")[0]
    rows.append(("MPI", " ".join(library.replace("Version:", " ").split())))
    return [*rows, ("Python", f"{platform.python_version()}, {platform.system()} on {platform.machine()}")]


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def _commit(git: Path) -> str:
    """Ten digits of the commit of a checkout, read from its files; empty where there is none."""
    try:
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head[:10]
        name = head.removeprefix("ref: ")
        if (git / name).exists():
            return (git / name).read_text()[:10]
        packed = (git / "packed-refs").read_text().splitlines()
        return next((line[:10] for line in packed if line.endswith(f" {name}")), "")
    except OSError:
        return ""
