"""The equilibrium of a hyperelastic body under gravity: f(z) = G g by Newton's method with load steps."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.solve.solvers import SolverName, choose_solver, make_solver
from softgrasp.fem.strain.body import Body
from softgrasp.fem.system import BlockSystem

SMALLEST = 2.0**-10  # step of the load, and part of a correction
MOST = 25  # iterations of a load
TOL = 1e-11  # |f - t G g| over |G g|


def finite_equilibrium(system: BlockSystem, solver: SolverName | None = None) -> Array:
    """Z with f(z) = G g, stable under small motions of the load; local rows (n_local,) [m]. Collective.

    The load t G g grows from 0 to 1 by steps that are halved where Newton's method fails and doubled where it does not.

    Raises:
        SolverError: no step of the load converges; the message names its share t, the cell with the smallest J, and J.
    """
    assert system.points is not None
    assert system.gravity is not None
    body, comm = Body(system.points, system.materials), system.layout.comm
    name = solver or choose_solver(system.layout, few=True)[0]
    z, f = system.K_ee.createVecs()
    load = z.duplicate()
    load.array_w[:] = system.G @ system.gravity
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
            raise SolverError(
                f"finite strain ({body.law.name}): no equilibrium beyond {t:.3g} of the weight; in the cell at {place} "
                f"det F = {J:.3g}: take a stiffer material, or time.start = 'rest'"
            )
    body.refuse(body.start(z), comm)
    for item in (z, f, load):
        item.destroy()
    body.destroy()
    return answer


def _newton(
    body: Body, system: BlockSystem, name: SolverName, z: PETSc.Vec, f: PETSc.Vec, load: PETSc.Vec, t: float
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
            tangent = make_solver(body.tangent(z).copy(), name, system.layout, "softgrasp_static_")
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
