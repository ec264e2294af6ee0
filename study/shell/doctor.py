"""Checks of the installation: solver stack, MPI launcher, threads, compiler, cache; with a cure for each fault.

Needs neither DOLFINx nor MPI to be imported, so that it can say that they are missing.
"""

from __future__ import annotations

import importlib
import os
import shlex
import shutil
import sys
import sysconfig
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from softgrasp.study.shell.processes import find_mpiexec, in_mpi_job, run_limited

LAUNCH_LIMIT = 30.0  # [s] for two ranks that only say how many they are
SAY_SIZE = "import sys, softgrasp.fem._stack; from mpi4py import MPI; sys.stdout.write(f'{MPI.COMM_WORLD.size}\\n')"
MPI_FAMILIES = {
    "MPICH": ("hydra", "mpich"), "Open MPI": ("open mpi", "openrte", "open-mpi"), "Intel MPI": ("intel(r) mpi",),
}  # fmt: skip
INSTALL = "Install the solver stack with `pip install 'softgrasp[solver]'` or load the cluster's DOLFINx module."


@dataclass(frozen=True)
class Check:
    """One line of the diagnosis."""

    name: str  # what was looked at
    ok: bool  # whether it will work
    value: str  # version, path or number
    cure: str = ""  # one sentence on what to do; empty when ok


def _module(name: str) -> Any:
    """A module of the solver stack, imported in an order that keeps one MPI."""
    importlib.import_module("softgrasp.fem._stack")
    return importlib.import_module(name)


def check_python() -> Check:
    """Python 3.12 or newer."""
    ok = sys.version_info >= (3, 12)
    return Check("Python", ok, sys.version.split()[0], "" if ok else "Use Python 3.12 or newer.")


def check_dolfinx() -> Check:
    """DOLFINx 0.11; 0.10 differs in nothing that is called here."""
    version = str(_module("dolfinx").__version__)
    ok = version.startswith(("0.10.", "0.11."))
    return Check("DOLFINx", ok, version, "" if ok else "softgrasp needs DOLFINx 0.11 or 0.10; install one of them.")


def check_petsc() -> Check:
    """PETSc with real double scalars."""
    petsc, np = _module("petsc4py.PETSc"), _module("numpy")
    scalar, integer = np.dtype(petsc.ScalarType), np.dtype(petsc.IntType)
    version = ".".join(map(str, petsc.Sys.getVersion()))
    value = f"{version}, scalar {scalar.name}, {8 * integer.itemsize}-bit int"
    ok = scalar == np.float64
    return Check("PETSc", ok, value, "" if ok else "Use a PETSc that was built with real double scalars.")


def check_slepc() -> Check:
    """SLEPc."""
    return Check("SLEPc", True, ".".join(map(str, _module("slepc4py.SLEPc").Sys.getVersion())))


def _family(text: str) -> str:
    """Name the MPI family that a version text belongs to, or "unknown"."""
    low = text.lower()
    return next((name for name, words in MPI_FAMILIES.items() if any(word in low for word in words)), "unknown")


def check_launcher() -> Check:
    """The mpiexec in use belongs to the MPI library of mpi4py."""
    linked = _family(importlib.import_module("mpi4py.MPI").Get_library_version())
    path = find_mpiexec()
    if path is None:
        return Check("mpiexec", False, "none", f"Put the mpiexec of {linked} on PATH, or `pip install mpich`.")

    def wrong(launcher: str) -> bool:  # one we cannot name (srun wrapper, vendor MPI) is checked by the launch alone
        return "unknown" not in (launcher, linked) and launcher != linked

    launcher = _family(run_limited([path, "--version"], LAUNCH_LIMIT)[1])
    if wrong(launcher):
        cure = f"This mpiexec is {launcher} but the library is {linked}: use the mpiexec of {linked} by its full path."
        return Check("mpiexec", False, path, cure)
    value, first = f"{path} ({launcher}, library {linked})", shutil.which("mpiexec")
    if first is not None and not os.path.samefile(first, path):
        other = _family(run_limited([first, "--version"], LAUNCH_LIMIT)[1])
        if wrong(other):
            cure = f"A bare `mpiexec` starts {first} of {other}, the wrong one: call {path} by its full path."
            return Check("mpiexec", False, value, cure)
    return Check("mpiexec", True, value)


def check_launch() -> Check:
    """Two ranks really find each other."""

    def fault(value: str, cure: str) -> Check:
        return Check("two ranks", False, value, cure)

    if in_mpi_job():
        value = "Not tried: this is already an MPI job, run doctor without mpiexec to try it."
        return Check("two ranks", True, value)
    path = find_mpiexec()
    if path is None:
        return fault("no mpiexec", "Make an mpiexec available as said above.")
    status, output = run_limited([path, "-n", "2", sys.executable, "-c", SAY_SIZE], LAUNCH_LIMIT)
    if status is None:
        return fault(f"no answer in {LAUNCH_LIMIT:g} s", f"Make `{path} -n 2 hostname` work first.")
    if status == 0 and output.split() == ["2", "2"]:
        return Check("two ranks", True, "launched, found each other")
    if status == 0 and output.split() == ["1", "1"]:
        cure = f"{path} belongs to another MPI: use the mpiexec beside {sys.executable} or the library's own."
        return fault("two single ranks instead of one job", cure)
    last = output.strip().splitlines()[-1:] or ["no output"]
    return fault(f"exit status {status}: {last[0]}", f"Use an mpiexec that can start {sys.executable}.")


def check_threads() -> Check:
    """One BLAS thread a rank."""
    values = {name: os.environ.get(name, "unset") for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    ok = set(values.values()) == {"1"}
    cure = "" if ok else "Export OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1, more threads fight with the ranks."
    return Check("threads", ok, ", ".join(f"{name}={value}" for name, value in values.items()), cure)


def check_compiler() -> Check:
    """A C compiler with the headers of this Python, as the JIT of forms needs it."""
    words = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    path = shutil.which(words[0])
    if path is None:
        return Check("C compiler", False, "none", f"Install {words[0]} or set CC to a C compiler.")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "probe.c")
        source.write_text("#include <Python.h>\n")
        command = [path, *words[1:], f"-I{sysconfig.get_path('include')}", "-c", str(source), "-o", f"{folder}/probe.o"]
        ok = run_limited(command, LAUNCH_LIMIT)[0] == 0
    cure = "" if ok else "Install the headers of this Python (Debian, Ubuntu: python3-dev)."
    return Check("C compiler", ok, path, cure)


def check_cache() -> Check:
    """The folder of compiled forms can be written."""
    folder = Path(_module("dolfinx.jit").get_options()["cache_dir"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return Check("JIT cache", True, str(folder))
    except OSError:
        return Check("JIT cache", False, str(folder), "Set XDG_CACHE_HOME to a folder that you can write.")


def check_memory() -> Check:
    """Memory that is free now, enough for the paper's scenes."""
    memory = psutil.virtual_memory()
    value = f"{memory.available / 2**30:.1f} of {memory.total / 2**30:.1f} GiB free"
    ok = memory.available > 2**30
    return Check("memory", ok, value, "" if ok else "Free at least 1 GiB before a run.")


CHECKS: dict[str, Callable[[], Check]] = {
    "Python": check_python, "DOLFINx": check_dolfinx, "PETSc": check_petsc, "SLEPc": check_slepc,
    "mpiexec": check_launcher, "two ranks": check_launch, "threads": check_threads, "C compiler": check_compiler,
    "JIT cache": check_cache, "memory": check_memory,
}  # fmt: skip


def checks() -> list[Check]:
    """Run all checks; one that raises has failed. Not collective: call on one rank."""
    results = []
    for name, look in CHECKS.items():
        try:
            results.append(look())
        except (ImportError, OSError, RuntimeError, AttributeError) as error:
            text = str(error).splitlines() or [type(error).__name__]
            results.append(Check(name, False, text[0], INSTALL))
    return results


def show(console: Console) -> bool:
    """Write the diagnosis as a table; True when nothing needs a cure. Not collective: call on one rank."""
    table = Table("", "check", "value", "cure", box=None, pad_edge=False)
    for column in table.columns:
        column.overflow = "fold"
    with console.status("looking at the installation"):
        results = checks()
    for check in results:
        mark = "[green]ok[/]" if check.ok else "[red]bad[/]"
        table.add_row(mark, check.name, escape(check.value), escape(check.cure))
    console.print(table)
    return all(check.ok for check in results)
