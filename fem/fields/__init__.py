"""Fields on the mesh: series of files and what pictures show."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
