"""A reduced model for pyMOR, affine in the material of every layer; programs of one rank."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from softgrasp.fem.pymor import Factors, Term, operator, port, pymor_models
from softgrasp.reduction.export.affine import FIXED, material_terms
from softgrasp.reduction.model import ReducedModel


def parametric(model: ReducedModel) -> Any:
    """The model as ``pymor.models.iosys.LTIModel`` E x' = A x + B u, y = C x; see ``ReducedModel.to_pymor``.

    Raises SoftgraspError: pyMOR is not installed, or the program runs on several ranks.
    """
    models, system, layers = pymor_models(), model.at(), len(model.materials)
    rest, mu, lam, beta_mu, beta_lambda = material_terms(model)
    E: list[Term] = [((), 0, rest.E)]
    A: list[Term] = [((), 0, rest.A)]

    def add(names: Factors, i: int, term: Any) -> None:
        E.append((names, i, term.E))
        A.append((names, i, term.A))

    for i in range(layers):
        add(("mu",), i, mu[i])
        add(("lambda",), i, lam[i])
        if model.materials[i].adds == "damping":
            add(("mu",), i, beta_mu[i])
        elif model.damped:
            add(("beta", "mu"), i, beta_mu[i])
            add(("beta", "lambda"), i, beta_lambda[i])
    if model.coordinates == "qv":
        A[0], E[0] = _by_density(model, A, E)
    return models.LTIModel(
        operator(A, layers, "A"),
        port(system.B, system.inputs),
        port(system.C, system.outputs),
        E=operator(E, layers, "E"),
        name=model.name,
    )


def _by_density(model: ReducedModel, A: list[Term], E: list[Term]) -> tuple[Term, Term]:
    """Split the constant terms by rho of every layer, append its parts, and return what is left."""
    own, constant = model.parameters(model.materials), (A[0][2], E[0][2])
    empty = [m if m.adds in FIXED else replace(m, mu=0.0, lam=0.0, beta=0.0) for m in model.materials]
    left = [X.copy() for X in constant]
    for i, m in enumerate(empty):
        twice = (*empty[:i], replace(m, rho=2 * m.rho), *empty[i + 1 :])
        system = model.assemble(replace(own, materials=twice))
        for k, (terms, new) in enumerate(((A, system.A), (E, system.E))):
            change = new - constant[k]
            terms.append((("rho",), i, change / m.rho))
            left[k] -= change
    return ((), 0, left[0]), ((), 0, left[1])
