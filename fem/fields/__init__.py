"""Fields on the mesh: series of files, and arrays for pictures."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
