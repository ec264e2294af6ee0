"""The midpoint run: step, motion of the hand, snapshots, restart."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
