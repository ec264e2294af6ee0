"""Load the solver stack in the one order that works.

The package itself fixes the threads before numpy is imported (two ranks with two BLAS threads each are 10 to 200 times
slower on two cores). MPI is initialised before any compiled module: the PyPI wheel does so in ``dolfinx_solver``; a
cluster's own DOLFINx has no such module and needs ``mpi4py.MPI`` only.
"""

from __future__ import annotations

import importlib
import importlib.util

importlib.import_module("dolfinx_solver" if importlib.util.find_spec("dolfinx_solver") else "mpi4py.MPI")
