"""Static solves: the equilibrium under gravity, and many loads with one factor."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, total
from softgrasp.fem.scene.scene import Time
from softgrasp.fem.solve.solvers import SolverName, choose_solver, make_solver
from softgrasp.fem.system import BlockSystem


def equilibrium(system: BlockSystem, solver: SolverName, time: Time) -> Array:
    """Static displacement relative to the hand, K_ee z = G g; local rows. Collective.

    Raises:
        SolverError: the stiffness is singular or the residual too large.
    """
    load = system.K_ee.createVecLeft()
    z = system.K_ee.createVecRight()
    load.array_w[:] = 0.0 if system.gravity is None else system.G @ system.gravity
    static = make_solver(system.K_ee.copy(), solver, system.layout, "softgrasp_static_", time.rtol, time.reproducible)
    static.solve(load, z)
    static.check(load, z, "the static equilibrium")
    result = z.array_r.copy()
    static.destroy()
    load.destroy()
    z.destroy()
    return np.asarray(result)


def solve_columns(
    A: PETSc.Mat, layout: BlockLayout, X: Array, where: str = "the inner product", rtol: float = 1e-12
) -> Array:
    """Return the local rows of A^-1 X, A symmetric positive definite, Fortran order. Collective.

    Factored once; columns of zeros cost nothing.

    Args:
        A: distributed over the ranks of ``layout``.
        layout: sizes and ownership.
        X: local rows (n_local, k).
        where: what it is for, in messages.
        rtol: of cg, where no direct solver fits.

    Raises:
        SolverError: the factorisation fails, or the solution has a large residual.
    """
    solver = make_solver(A.copy(), choose_solver(layout, few=True)[0], layout, "softgrasp_inner_", rtol)
    b, x = A.createVecs()
    result = np.zeros(X.shape, order="F")
    try:
        for j in np.flatnonzero(total(layout.comm, np.abs(X).sum(axis=0)) != 0):
            b.array_w[:] = X[:, j]
            solver.solve(b, x)
            solver.check(b, x, where)
            result[:, j] = x.array_r
    finally:
        solver.destroy()
        b.destroy()
        x.destroy()
    return result
