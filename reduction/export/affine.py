"""A reduced model as sums over its material, E(theta) w' = A(theta) w + B u + f, in energy coordinates x = d w.

    A(theta) = A_0 + sum_l mu_l A_mu,l + lambda_l A_lambda,l [+ beta_l (mu_l A_beta_mu,l + lambda_l A_beta_lambda,l)]

with the viscous parts in E instead for damped canonical models. A row of an own parameter stands as a layer with mu its
value and lambda = 0, one of own damping with beta = 1 and A_mu = 0; own masses and loads are in A_0, E_0 and f. Each
coordinate has an energy of about w_i^2 / 2 with the material of the projection: d are powers of two, so that no digit
changes. All rows are multiplied by E^-1, so that E = I where it does not depend on the material.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem.columns import hand_of
from softgrasp.fem.material import REST, LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.system import EnergySystem, ModelError, UnstableModelError


@dataclass(frozen=True)
class Label:
    """A number that goes in or out."""

    name: str  # "force_x"
    unit: str  # "N"


@dataclass(frozen=True)
class AffinePlant:
    """All that a program needs to step a reduced model at any material."""

    name: str  # of the basis
    tick: float  # step [s]
    theta: Array  # mu, lambda [Pa], beta [s] of every layer, (layers, 3)
    damped: bool  # whether beta may be changed
    A_0: Array  # without stiffness and viscosity, (N, N)
    A_mu: Array  # by mu of every layer, (layers, N, N) [1/Pa]
    A_lambda: Array  # by lambda of every layer, (layers, N, N) [1/Pa]
    beta_mu: Array  # by beta mu of every layer, of A or of E, (layers, N, N)
    beta_lambda: Array  # by beta lambda of every layer, of A or of E, (layers, N, N)
    E_0: Array | None  # E without viscosity where it depends on beta, (N, N); None for E = I
    B: Array  # loads on the hand, (N, n_s)
    f: Array  # constant load, (N,)
    C: Array  # outputs: q_s, v_s, those of the scene, (p, N)
    start: Array  # state at rest, (N,)
    d: Array  # energy coordinates, x = d w, (N,)
    inputs: tuple[Label, ...]  # one per column of B
    outputs: tuple[Label, ...]  # one per row of C
    rows: tuple[LayerMaterial, ...]  # materials of the layers, then those of own parameters

    @property
    def N(self) -> int:
        """Number of states."""
        return len(self.A_0)

    @property
    def layers(self) -> int:
        """Number of layers."""
        return len(self.theta)

    def constants(self) -> tuple[Label, ...]:
        """mu, lambda, beta of every layer, then every own parameter by its name, in the order of theta."""
        names = [m.part for m in self.rows]
        result = list[Label]()
        for i, m in enumerate(self.rows):
            many, number = names.count(m.part) > 1, names[: i + 1].count(m.part)
            end = f"_{number}" if many else ""
            keys = ("mu", "lambda", "beta") if not m.part else (m.part, f"lambda_{m.part}", f"beta_{m.part}")
            units = ("Pa" if not m.part else "", "Pa", "s")
            result += [Label(f"{key}{end}", unit) for key, unit in zip(keys, units, strict=True)]
        return tuple(result)

    def tunable(self) -> tuple[bool, ...]:
        """Whether each of the constants may be changed."""
        return tuple(
            able
            for m in self.rows
            for able in (
                m.adds not in FIXED and m.part != REST,
                not m.part,
                self.damped and (not m.part or m.adds in ("", "stiffness")),
            )
        )


FIXED = ("mass", "load")  # own terms whose values are those of the export


def theta_of(materials: tuple[LayerMaterial, ...]) -> Array:
    """mu, lambda, beta of every row, (rows, 3)."""
    return np.array([[m.mu, m.lam, 1.0 if m.adds == "damping" else m.beta] for m in materials])


def affine_plant(model: ReducedModel, tick: float) -> AffinePlant:
    """The sums of a reduced model. Online; not collective.

    Args:
        model: linear reduced model.
        tick: step of the midpoint rule [s].

    Raises:
        ModelError: the tick is no positive number, the model is singular, or two inputs or outputs have one name.
        UnstableModelError: it is unstable with its own material.
    """
    if not 0 < tick < np.inf:
        raise ModelError(f"tick = {tick:g} s: the time step must be a positive number of seconds, such as 1e-3")
    system = model.at()
    if not system.stable:
        raise UnstableModelError(
            f"{model.name} with N = {model.N} is unstable (spectral abscissa {system.spectral_abscissa:.2e} 1/s); "
            "export another N or a structure-preserving basis"
        )
    rest, mu, lam, beta_mu, beta_lambda = material_terms(model)
    side = "E" if any(term.E.any() for term in (*beta_mu, *beta_lambda)) else "A"
    d = 1 / _powers(np.diag(system.H))
    E = system.E * d
    rows = 1 / _powers((E * E).sum(axis=1))
    E *= rows[:, None]

    def balanced(matrix: Array) -> Array:
        return np.asarray(np.linalg.solve(E, (rows * matrix.T).T))

    def parts(terms: list[Term], of: str = "A") -> Array:
        return np.stack([balanced(getattr(term, of) * d) for term in terms])

    plant = AffinePlant(
        name=model.name,
        tick=tick,
        theta=theta_of(model.materials),
        damped=model.damped,
        A_0=balanced(rest.A * d),
        A_mu=parts(mu),
        A_lambda=parts(lam),
        beta_mu=parts(beta_mu, side),
        beta_lambda=parts(beta_lambda, side),
        E_0=balanced(rest.E * d) if side == "E" else None,
        B=balanced(system.B),
        f=balanced(system.f),
        C=np.vstack([system.S_q, system.S_v, system.C]) * d,
        start=_rest(system) / d,
        d=d,
        inputs=named(system.inputs),
        outputs=_hand(system) + named(system.outputs),
        rows=model.materials,
    )
    names = [label.name for label in (*plant.inputs, *plant.outputs, *plant.constants())]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ModelError(
            f"two numbers of the exported model are called {twice[0]}; rename the output or the own parameter"
        )
    return plant


@dataclass(frozen=True)
class Term:
    """Matrices that one constant of the material multiplies."""

    E: Array  # of the rates, (N, N)
    A: Array  # of the states, (N, N)


def material_terms(model: ReducedModel) -> tuple[Term, list[Term], list[Term], list[Term], list[Term]]:
    """Terms without stiffness, then of mu, lambda, beta mu, beta lambda of every layer."""
    own = model.parameters(model.materials)
    empty = tuple(m if m.adds in FIXED else replace(m, mu=0.0, lam=0.0, beta=0.0) for m in model.materials)

    def at(i: int, **constants: Any) -> Term:
        materials = (*empty[:i], replace(empty[i], **constants), *empty[i + 1 :])
        system = model.assemble(replace(own, materials=materials))
        return Term(system.E, system.A)

    def slope(new: Term, old: Term, by: float) -> Term:
        return Term((new.E - old.E) / by, (new.A - old.A) / by)

    rest = at(0)
    mu, lam, beta_mu, beta_lambda = list[Term](), list[Term](), list[Term](), list[Term]()
    for i, m in enumerate(model.materials):
        scale = m.mu or 1.0  # with it the stiffness is not small against the rest
        if m.adds in (*FIXED, "damping"):
            nothing = slope(rest, rest, 1.0)
            for terms in (mu, lam, beta_lambda):
                terms.append(nothing)
            beta_mu.append(nothing if m.adds in FIXED else slope(at(i, mu=scale), rest, scale))
            continue
        for key, stiff, viscous in (("mu", mu, beta_mu), ("lam", lam, beta_lambda)):
            elastic = at(i, **{key: scale})
            stiff.append(slope(elastic, rest, scale))
            viscous.append(slope(at(i, **{key: scale, "beta": 1.0}), elastic, scale))
    return rest, mu, lam, beta_mu, beta_lambda


def _powers(squares: Array) -> Array:
    """Powers of two next to the roots; 1 for zeros."""
    roots = np.sqrt(np.where(squares > 0, squares, 1.0))
    return np.asarray(np.exp2(np.round(np.log2(roots))))


def _rest(system: EnergySystem) -> Array:
    """The hand at its origin, the tissue in equilibrium where the hand's own columns tell what that is."""
    return system.equilibrium() if system.hand_first else np.zeros(system.N)


def named(texts: tuple[str, ...]) -> tuple[Label, ...]:
    """Of "tip_x [m]"."""
    return tuple(Label(*text.rstrip("]").rsplit(" [", 1)) for text in texts)


def _hand(system: EnergySystem) -> tuple[Label, ...]:
    """q_s and v_s."""
    columns = hand_of(system.n_s, system.names)
    positions = tuple(Label(f"hand_q_{c.axis}", c.unit) for c in columns)
    return positions + tuple(Label(f"hand_v_{c.axis}", f"{c.unit}/s") for c in columns)
