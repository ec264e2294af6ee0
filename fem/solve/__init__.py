"""Factors and solves of the tissue's matrices."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
