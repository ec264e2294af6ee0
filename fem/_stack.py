"""Load the solver stack in the one order that works.

The package itself fixes the threads before numpy is imported (two ranks with two BLAS threads each are 10 to 200 times
slower on two cores). MPI is initialised before any compiled module: the PyPI wheel does so in ``dolfinx_solver``; a
cluster's own DOLFINx has no such module and needs ``mpi4py.MPI`` only. PETSc leaves signals to Python.
"""

from __future__ import annotations

import importlib
import importlib.util
import os

# PETSc's handler aborts the program, and with it the run, when the reader of a pipe has gone; an option keeps it off,
# which PETSc reads when it is initialised, unless that has happened before (see `study.shell.streams`).
_options = os.environ.get("PETSC_OPTIONS", "")
if "-no_signal_handler" not in _options.split():
    os.environ["PETSC_OPTIONS"] = f"{_options} -no_signal_handler".strip()

importlib.import_module("dolfinx_solver" if importlib.util.find_spec("dolfinx_solver") else "mpi4py.MPI")
