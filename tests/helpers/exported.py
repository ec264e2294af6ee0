"""Reduced models of every kind that export takes, and the matrices of their sums."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

import softgrasp as sg
from softgrasp.reduction.export.affine import AffinePlant
from softgrasp.reduction.model import ReducedModel
from tests.helpers.models import LAYERS, Array
from tests.helpers.reduced import DAMPED, model_of, reduced, symplectic_basis

GRAVITY: dict[str, Any] = {"effects": {"gravity": {"g": [0.0, -9.81]}, "reaction": True}}


def rom(*changes: dict[str, Any]) -> ReducedModel:
    model = model_of(MPI.COMM_SELF, *changes)
    return sg.reduce(model, sg.simulate(model), "craig_bampton", N=14)


def of_kind(kind: tuple[Any, Any, bool], *changes: dict[str, Any]) -> ReducedModel:
    """A model of smooth shapes, stable by its structure."""
    coordinates, frame, fixed = kind
    model = model_of(MPI.COMM_SELF, *changes)
    return reduced(model, symplectic_basis(model.system.layout, 4, frame, fixed, coordinates, lift=coordinates == "qv"))


def with_terms(method: str, *keys: str) -> ReducedModel:
    """A model that the hand feels with an own term of every kind."""
    terms = [
        sg.Term("bed", lambda u, v: ufl.inner(u, v) * ufl.ds, 20.0),
        sg.Term("air", lambda u, v: ufl.inner(u, v) * ufl.dx, 0.4, adds="damping"),
        sg.Term("skin", lambda u, v: ufl.inner(u, v) * ufl.ds, 0.1, adds="mass"),
        sg.Term("pull", lambda v: v[0] * ufl.dx, 0.3, adds="load"),
    ]
    model = sg.build("paper_lqr", ["tissue.cells=[4, 8]", "effects.reaction=true", *keys], terms=terms)
    return sg.reduce(model, sg.simulate(model), method, N=14)


MODELS = {
    "gravity": cache(lambda: rom(DAMPED, GRAVITY)),
    "undamped": cache(lambda: rom({})),
    "layers": lambda: rom(DAMPED, {"tissue": {"layers": LAYERS}}),
    "own terms": cache(lambda: with_terms("craig_bampton")),
    "viscosity in E": lambda: of_kind(("qp", "absolute", False), DAMPED),
}


def state_matrices(plant: AffinePlant, theta: Array) -> tuple[Array, Array]:
    """E and A of the sums, (N, N)."""
    E = np.eye(plant.N) if plant.E_0 is None else plant.E_0.copy()
    A = plant.A_0.copy()
    for i, (mu, lam, beta) in enumerate(theta):
        A += mu * plant.A_mu[i] + lam * plant.A_lambda[i]
        viscous = beta * (mu * plant.beta_mu[i] + lam * plant.beta_lambda[i])
        if plant.E_0 is None:
            A += viscous
        else:
            E += viscous
    return E, A
