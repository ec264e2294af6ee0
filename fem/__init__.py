"""Full-order model of a rigid hand that holds soft tissue: scene, mesh, blocks, midpoint run."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
