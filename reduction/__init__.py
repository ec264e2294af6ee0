"""Reduced bases and reduced models; imports fem only, of matrices and vectors, without DOLFINx."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
