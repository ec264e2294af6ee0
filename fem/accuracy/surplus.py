"""The model of the next order corrected instead of solved, for meshes where its factor would need too much time.

    e = K'^-1 (f' - K' I u_h)

for the static solutions u_h of the mesh and its lowest modes, by some iterations of CG with vertex stars on the next
order; then the Galerkin model on span{I V, e}, in whose energy an error of e enters squared.
"""

from __future__ import annotations

import dolfinx.fem
import numpy as np

from softgrasp.fem.accuracy.krylov import KrylovModel, extended, projected
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.petsc import Array, times_columns, total
from softgrasp.fem.solve.solvers import make_solver
from softgrasp.fem.system import BlockSystem

ITERATIONS = 5  # leave less than 1 % of the estimate on lines that crowd; 3 less than 0.5 % on even cells
MODES = 4  # of the mesh: 4 and 10 modes gave the same estimate to one percent on the paper's scene
UNREACHED = 1e-14  # relative residual that no iteration of so few reaches
PREFIX = "softgrasp_surplus_"


def surplus_model(small: KrylovModel, finer: Model, iterations: int = ITERATIONS) -> KrylovModel:
    """The Galerkin model of the next order on the prolonged basis of a mesh and its surpluses. Collective.

    Raises SolverError: the elements of the next order have no stars.
    """
    system, model = finer.system, small.model
    C = output_columns(make_outputs(finer.scene, system), system.layout.n_local)
    omega, Q = small.modes
    m = min(MODES, len(omega))
    Phi = prolong(model, finer, small.V @ Q[:, :m])
    known = np.hstack([prolong(model, finer, small.X), Phi / omega[:m] ** 2])
    loads = np.hstack([system.G, C, times_columns(system.M_ee, Phi)])
    e = corrections(system, loads - times_columns(system.K_ee, known), iterations)
    V = K_V = np.zeros((system.layout.n_local, 0))
    for block in (prolong(model, finer, small.V), e):
        V, K_V = extended(system, V, K_V, block)[:2]
    p = small.X.shape[1]
    return projected(finer, V, known[:, :p] + e[:, :p])


def corrections(system: BlockSystem, R: Array, iterations: int) -> Array:
    """About K_ee^-1 R of local rows (n_local, k) by so many iterations a column. Collective."""
    solver = make_solver(system.K_ee.copy(), "stars", system.layout, PREFIX, UNREACHED)
    solver.ksp.setTolerances(max_it=iterations)
    r, w = solver.S.createVecs()
    result = np.zeros(R.shape, order="F")
    for j in np.flatnonzero(total(system.layout.comm, np.abs(R).sum(axis=0))):
        r.array_w[:] = R[:, j]
        solver.ksp.solve(r, w)
        result[:, j] = w.array_r
    for item in (r, w, solver):
        item.destroy()
    return result


def prolong(model: Model, finer: Model, X: Array) -> Array:
    """Columns of the mesh's space in that of the next order, local rows. Collective."""
    v = dolfinx.fem.Function(finer.space.V)
    Y = np.empty((finer.system.layout.n_local, X.shape[1]), order="F")
    for j in range(X.shape[1]):
        v.interpolate(model.space.nodal(X[:, j]))
        Y[:, j] = v.x.array.reshape(-1, model.space.mesh.dimension)[finer.space.free].ravel()
    return Y
