"""Static solves: the equilibrium under gravity, and many loads with one factor."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, total
from softgrasp.fem.scene.scene import Time
from softgrasp.fem.solve.solvers import Reproducible, SolverName, choose_solver, make_solver
from softgrasp.fem.system import BlockSystem


def equilibrium(system: BlockSystem, solver: SolverName | None = None, time: Time | None = None) -> Array:
    """Static displacement relative to the hand, K_ee z = G g or f(z) = G g; local rows (n_local,) [m]. Collective.

    Args:
        solver: None takes the one that suits few solves.
        time: tolerance and reproducibility of the scene.

    Raises:
        SolverError: the stiffness is singular or the residual too large, or the loads of finite strain do not converge.
    """
    if system.gravity is None:
        return np.zeros(system.layout.n_local)
    if system.points is not None:
        from softgrasp.fem.solve.finite_statics import finite_equilibrium

        return finite_equilibrium(system, solver)
    load, where = (system.G @ system.gravity)[:, None], "the static equilibrium"
    time = time or Time(steps=1, rtol=1e-12)
    return solve_columns(
        system.K_ee, system.layout, load, where, time.rtol, solver=solver, reproducible=time.reproducible
    )[:, 0]


def solve_columns(
    A: PETSc.Mat,
    layout: BlockLayout,
    X: Array,
    where: str = "the inner product",
    rtol: float = 1e-12,
    *,
    solver: SolverName | None = None,
    reproducible: Reproducible = "auto",
) -> Array:
    """Return the local rows of A^-1 X, A symmetric positive definite, Fortran order. Collective.

    Factored once; columns of zeros cost nothing.

    Args:
        A: distributed over the ranks of ``layout``.
        layout: sizes and ownership.
        X: local rows (n_local, k).
        where: what it is for, in messages.
        rtol: of cg, where no direct solver fits.
        solver: None takes the one that suits few solves.
        reproducible: as for :func:`make_solver`.

    Raises:
        SolverError: the factorisation fails, or the solution has a large residual.
    """
    name = solver or choose_solver(layout, few=True)[0]
    static = make_solver(A.copy(), name, layout, "softgrasp_static_", rtol, reproducible)
    b, x = A.createVecs()
    result = np.zeros(X.shape, order="F")
    try:
        for j in np.flatnonzero(total(layout.comm, np.abs(X).sum(axis=0)) != 0):
            b.array_w[:] = X[:, j]
            static.solve(b, x)
            static.check(b, x, where)
            result[:, j] = x.array_r
    finally:
        static.destroy()
        b.destroy()
        x.destroy()
    return result
