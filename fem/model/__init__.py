"""From a scene to the matrices of hand and tissue."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
