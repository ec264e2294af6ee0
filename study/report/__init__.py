"""The page of a result: sections, equations, files."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
