"""Load the solver stack in the one order that works.

The package itself fixes the threads before numpy is imported (two ranks with two BLAS threads each are 10 to 200 times
slower on two cores). MPI is initialised before any compiled module. The PyPI wheel's `dolfinx_solver` does so once it
has read the metadata of all installed packages, which takes as long as PETSc itself, to refuse a second PETSc beside
its own; here names of folders do, and it is imported for its sentence. A cluster's own DOLFINx has no such module.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
from pathlib import Path

SECOND = re.compile(r"(petsc|slepc)(4py)?-", re.IGNORECASE)  # whose metadata lies beside the wheel's
WHEEL = re.compile(r"dolfinx_solver_(real|complex)-", re.IGNORECASE)


def second_petsc(site: Path) -> bool:
    """Whether Python may find another PETSc than that of the wheel in this folder."""
    names = [path.name for path in site.iterdir() if path.suffix in (".dist-info", ".egg-info")]
    found = importlib.util.find_spec("petsc4py")
    beside = found is not None and found.origin is not None and Path(found.origin).resolve().parent.parent == site
    return not beside or any(map(SECOND.match, names)) or len(list(filter(WHEEL.match, names))) > 1


def first_module() -> str:
    """What to import first: it initialises MPI."""
    wheel = importlib.util.find_spec("dolfinx_solver")
    site = None if wheel is None or wheel.origin is None else Path(wheel.origin).resolve().parent.parent
    return "mpi4py.MPI" if site is None or not second_petsc(site) else "dolfinx_solver"


importlib.import_module(first_module())
