"""Static solves: the equilibrium under gravity, and many loads with one factor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, from_options
from softgrasp.fem.scene.scene import Time
from softgrasp.fem.solve.cholesky import is_factor
from softgrasp.fem.solve.entries import definite
from softgrasp.fem.solve.solvers import ITERATIVE, SolverName, TissueSolver, choose_solver, make_solver
from softgrasp.fem.solve.stiffness import factored_stiffness
from softgrasp.fem.system import BlockSystem

if TYPE_CHECKING:
    from softgrasp.fem.strain.body import HyperelasticBody


def equilibrium(
    system: BlockSystem,
    solver: SolverName | None = None,
    time: Time | None = None,
    notify: Callable[[float], None] | None = None,
) -> Array:
    """Static displacement relative to the hand, K_ee z = G g or f(z) = G g; local rows (n_local,) [m]. Collective.

    Args:
        solver: its name; None: the one that suits few solves.
        time: for the reproducibility of the scene.
        notify: called with the share of its digits that an iteration has, from 0 to 1; a factor says nothing.

    Raises:
        SolverError: the stiffness is singular or the residual too large, or the loads of finite strain do not converge.
    """
    held = system.static_load
    if held is None:
        return np.zeros(system.layout.n_local)
    if system.points is not None:
        return finite_equilibrium(system, solver)
    load = held[:, None]
    bits = "auto" if time is None else time.reproducible
    with factored_stiffness(system, solver, reproducible=bits) as factor, _watched(factor, notify):
        return factor.columns(load, "the static equilibrium")[:, 0]


@contextmanager
def _watched(factor: TissueSolver, notify: Callable[[float], None] | None) -> Iterator[None]:
    """Call with the share of the digits that a solve has, on a log scale. Collective."""
    if notify is None or factor.name not in ITERATIVE:
        yield
        return
    digits, first = -np.log10(factor.ksp.getTolerances()[0]), [0.0]

    def monitor(_: PETSc.KSP, iteration: int, norm: float) -> None:
        first[0] = first[0] if iteration else norm
        if norm > 0:
            notify(float(np.clip(np.log10(first[0] / norm) / digits, 0.0, 1.0)))

    factor.ksp.setMonitor(monitor)
    try:
        yield
    finally:
        factor.ksp.monitorCancel()


def solve_columns(
    A: PETSc.Mat, layout: BlockLayout, X: Array, where: str = "the inner product", rtol: float = 1e-12
) -> Array:
    """Return the local rows (n_local, k) of A^-1 X, A symmetric positive definite, Fortran order. Collective.

    Factored once; columns of zeros are not solved.

    ``rtol``: of cg, where no direct solver fits. Raises SolverError: the factorisation fails, or the solution has a
    large residual.
    """
    static = make_solver(A.copy(), choose_solver(layout, few=True)[0], layout, "softgrasp_static_", rtol)
    try:
        return static.columns(X, where)
    finally:
        static.destroy()


def mass_columns(system: BlockSystem, X: Array) -> Array:
    """Return the local rows (n_local, k) of M_ee^-1 X, Fortran order. Collective.

    By CG with the diagonal, whose iterations grow neither with the mesh nor where nodes crowd [W87]. Raises
    SolverError: it does not converge.
    """
    M = system.M_ee
    ksp = PETSc.KSP().create(M.comm)
    ksp.setOptionsPrefix("softgrasp_mass_")
    ksp.setOperators(M)
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
    ksp.setTolerances(rtol=MASS_RTOL, atol=1e-300, max_it=1000)
    from_options(ksp)
    solver = TissueSolver("cg", ksp, M.copy(), 10 * MASS_RTOL)
    try:
        return solver.columns(X, "a momentum")
    finally:
        solver.destroy()


MASS_RTOL = 1e-12  # relative residual [1]: near rounding, which a factor would reach
SMALLEST = 2.0**-10  # step of the load, and part of a correction
MOST = 25  # iterations of a load
TOL = 1e-11  # |f - t G g| over |G g|


def finite_equilibrium(system: BlockSystem, solver: SolverName | None = None) -> Array:
    """Z with f(z) = G g and a tangent f'(z) > 0; local rows (n_local,) [m]. Collective.

    The load t G g grows from 0 to 1 by steps that are halved where Newton's method fails and doubled where it does not.
    Raises SolverError: no step of the load converges; the message names its share t, the cell with the smallest J, and
    J. Or the tangent at the end is not positive definite: the equilibrium is unstable.
    """
    from softgrasp.fem.strain.body import HyperelasticBody  # only scenes with finite strain pay for it

    assert system.points is not None
    held = system.static_load
    assert held is not None
    body, comm = HyperelasticBody(system.points, system.materials, springs=system.springs), system.layout.comm
    name = solver or choose_solver(system.layout, few=True)[0]
    z, f = system.K_ee.createVecs()
    load = z.duplicate()
    load.array_w[:] = held
    t, step, answer = 0.0, 1.0, np.array(z.array_r)
    while t < 1.0:
        aim = min(t + step, 1.0)
        if _newton(body, system, name, z, f, load, aim):
            t, step, answer = aim, 2 * step, np.array(z.array_r)
            continue
        z.array_w[:] = answer
        step = (aim - t) / 2
        if step < SMALLEST:
            J, place = body.lowest(1 + body.start(z).j, comm)
            kind = "stable equilibrium" if name in ITERATIVE else "equilibrium"  # cg ends on an indefinite tangent
            raise SolverError(
                f"finite strain ({body.law.name}): no {kind} beyond {t:.3g} of the weight; in the cell at {place} "
                f"det F = {J:.3g}: use a stiffer material, or time.start = 'rest'"
            )
    body.refuse(body.start(z), comm)
    if name not in ITERATIVE and not _stable(body, system, name, z):
        raise SolverError(
            f"finite strain ({body.law.name}): the equilibrium under gravity that was found is unstable (its tangent "
            "is not positive definite), as that of a column that buckles: use a stiffer material or a stouter tissue, "
            "or time.start = 'rest'"
        )
    for item in (z, f, load):
        item.destroy()
    body.destroy()
    return answer


def _stable(body: HyperelasticBody, system: BlockSystem, name: SolverName, z: PETSc.Vec) -> bool:
    """Whether the tangent at z is positive definite, that is, W(z) - z'G g has a minimum there. Collective.

    ``name``: of a factor; by the signs of its pivots.
    """
    solver = make_solver(body.tangent(z).copy(), name, system.layout, "softgrasp_static_", tangent=True)
    pc = solver.ksp.getPC()
    stable = not is_factor(pc) or definite(pc.getFactorMatrix())
    solver.destroy()
    return stable


def _newton(
    body: HyperelasticBody, system: BlockSystem, name: SolverName, z: PETSc.Vec, f: PETSc.Vec, load: PETSc.Vec, t: float
) -> bool:
    """Newton from z on for the load t G g, each correction halved until |f - t G g| falls; z moves. Collective."""
    comm, trial, p = system.layout.comm, z.duplicate(), z.duplicate()
    target = max(TOL * load.norm(), 4 * body.rounding)

    def residual(x: PETSc.Vec) -> float:
        J, _ = body.lowest(1 + body.start(x).j, comm)
        if not J > 0:
            return np.inf
        body.force(x, f)
        f.axpy(-t, load)
        return float(f.norm())

    try:
        norm = residual(z)
        for _ in range(MOST):
            if norm <= target:
                return True
            tangent = make_solver(body.tangent(z).copy(), name, system.layout, "softgrasp_static_", tangent=True)
            residual(z)
            tangent.solve(f, p)
            tangent.destroy()
            part = 1.0
            while True:
                trial.waxpy(-part, p, z)
                new = residual(trial)
                if new < norm:
                    break
                part /= 2
                if part < SMALLEST:
                    return False
            trial.copy(z)
            norm = new
    except SolverError:  # a singular tangent
        return False
    finally:
        trial.destroy()
        p.destroy()
    return bool(norm <= target)
