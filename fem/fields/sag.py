"""The tissue at rest, by linear elasticity: whether gravity counts, and whether the theory holds."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.gravity import EARTH, acceleration
from softgrasp.fem.effects.sag import Gradient, Sag
from softgrasp.fem.fields.strain import gradient
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.solve.solvers import choose_solver
from softgrasp.fem.solve.statics import solve_columns


def measure_sag(model: Model, a: Array) -> tuple[Sag, Gradient]:
    """K_ee z = G g under the weight, and the gradient of z under G (g - a), with one factor. Collective.

    Args:
        a: largest acceleration of the hand, (n_s,).

    Raises:
        SolverError: the solve failed or missed its tolerance.
    """
    scene, system = model.scene, model.system
    layout, d = system.layout, system.layout.dimension
    weight = acceleration(scene, layout.n_s)
    g = np.zeros(layout.n_s) if weight is None else weight
    load = g - a
    if weight is None:
        g = np.eye(layout.n_s)[d - 1] * -EARTH
    columns, (solver, _) = system.G @ np.column_stack([g, load]), choose_solver(layout, scene.time.solver, few=True)
    where, repeat = "the static equilibrium", scene.time.reproducible
    Z = solve_columns(system.K_ee, layout, columns, where, scene.time.rtol, solver=solver, reproducible=repeat)
    largest = float(np.linalg.norm(Z[:, 0].reshape(-1, d), axis=1).max(initial=0.0))
    sag = Sag(tuple(g[:d].tolist()), max(layout.comm.allgather(largest)), gradient(model, Z[:, 0]))
    return sag, gradient(model, Z[:, 1])
