"""The linear plant that feedback is designed for, and the plant of finite strain that it then runs on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import PETSc, combine
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.strain.body import HyperelasticBody
from softgrasp.fem.system import BlockSystem, Damping
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import Target, hand_target


def linearised(model: Model) -> Model:
    """The model with K(z*) for K_ee and without finite strain; z* is the rest state, or the equilibrium under gravity.

    Deviations from z* obey it to first order. Collective. Raises SolverError: there is no equilibrium.
    """
    system = model.system
    if system.points is None:
        return model
    if system.static_load is None:
        return replace(model, system=replace(system, points=None))
    body, z = (
        HyperelasticBody(system.points, system.materials, system.K_ee, system.springs),
        system.K_ee.createVecRight(),
    )
    z.array_w[:] = equilibrium(system)
    K = body.tangent(z).copy()
    K.setOption(PETSc.Mat.Option.SPD, True)
    body.destroy()
    z.destroy()
    return replace(model, system=replace(system, K_ee=K, points=None, damping=_kept(system)))


def _kept(system: BlockSystem) -> Damping:
    """The same damping matrix beside another K_ee. Collective."""
    damping = system.damping
    if not damping.beta:
        return damping
    terms = [(damping.beta, system.K_ee)] + ([] if damping.matrix is None else [(1.0, damping.matrix)])
    return replace(damping, beta=0.0, matrix=combine(terms))


def finite_problem(problem: RiccatiProblem, system: BlockSystem, target: Target) -> tuple[RiccatiProblem, Target]:
    """The same outputs, weights and place of the hand for the plant of finite strain. Collective."""
    finite = replace(problem, system=system)
    return finite, hand_target(finite, np.asarray(target.state.q_s))
