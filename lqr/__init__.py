"""Linear-quadratic regulator: Lyapunov and Riccati solvers, feedback; imports reduction, never DOLFINx."""

from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py
