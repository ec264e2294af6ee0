"""Reduced bases and reduced models; imports fem only, knows matrices and vectors but no DOLFINx."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
