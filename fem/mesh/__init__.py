"""Meshes: structured or from a file, their cells, parts and checks."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
