"""How far the outputs of a run are from those of an infinitely fine mesh, and meshes that reach a tolerance."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
