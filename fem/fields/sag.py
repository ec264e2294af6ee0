"""The tissue at rest under its weight, by linear elasticity: whether gravity counts, and whether the theory holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgrasp.fem.effects.gravity import EARTH, acceleration
from softgrasp.fem.effects.sag import Sag
from softgrasp.fem.fields.strain import gradient
from softgrasp.fem.model.build import Model
from softgrasp.fem.solve.solvers import choose_solver
from softgrasp.fem.solve.statics import equilibrium


def measure_sag(model: Model) -> Sag:
    """Solve the static problem with one factor of the stiffness. Collective.

    Raises:
        SolverError: the solve failed or missed its tolerance.
    """
    scene, system = model.scene, model.system
    layout, d = system.layout, system.layout.dimension
    g = acceleration(scene, layout.n_s)
    if g is None:
        g = np.zeros(layout.n_s)
        g[d - 1] = -EARTH
    name, _ = choose_solver(layout, scene.time.solver, few=True)
    z = equilibrium(replace(system, gravity=g), name, scene.time)
    largest = float(np.linalg.norm(z.reshape(-1, d), axis=1).max(initial=0.0))
    return Sag(tuple(g[:d].tolist()), max(layout.comm.allgather(largest)), gradient(model, z))
