"""Reduced models: small matrices for every material and gravity, and the system at one of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.material import LayerMaterial, in_words
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, amount, listed
from softgrasp.reduction.bases.basis import Coordinates, Frame, ReductionError, Structure
from softgrasp.reduction.canonical import canonical_operators
from softgrasp.reduction.galerkin import galerkin_operators
from softgrasp.reduction.lti import LTI, make_lti
from softgrasp.reduction.operators import Operators, Parameters, Parts, Reconstruction
from softgrasp.reduction.spectrum import Spectrum, spectrum


class ModelError(ReductionError):
    """A reduced model cannot be made, or is asked for what it does not hold."""


class UnstableModelError(SoftgraspError):
    """A reduced model with growing modes was about to be run."""


def singular(X: Array) -> bool:
    """Whether a square matrix is singular to rounding once its rows and columns are balanced."""
    sizes = np.abs(X)
    rows, columns = (np.sqrt(np.where(m > 0, m, 1.0)) for m in (sizes.max(axis=1), sizes.max(axis=0)))
    values = np.linalg.svd(X / np.outer(rows, columns), compute_uv=False)
    return bool(values[-1] <= 4 * len(X) * np.finfo(float).eps * values[0])


@dataclass(frozen=True)
class Outputs:
    """y = C_z x + C_s q_s, the scene's outputs [m]."""

    C_z: Array  # part of the tissue relative to the hand, (p, N)
    C_s: Array  # rigid part, (p, n_s)
    names: tuple[str, ...] = ()  # one per component


@dataclass(frozen=True, repr=False)
class ReducedSystem(Shown):
    """E x' = A x + B u + f, q_s = S_q x, v_s = S_v x, y = C_z x + C_s q_s at one parameter, of dimension N.

    Everything that a run needs, nothing of full order. The state x has no unit of its own: with fixed solid modes its
    first 2 n_s entries are q_s [m, rad] and v_s [m/s, rad/s].
    """

    name: str  # of the basis
    operators: Operators  # E, A (N, N), B (N, n_s), readouts of the hand and energies
    f: Array  # load of gravity, (N,)
    outputs: Outputs  # C_z (p, N) and C_s (p, n_s) [m]
    M_hand: Array  # hand mass matrix, (n_s, n_s) [kg, kg m^2]
    fixed_solid: bool  # the first 2 n_s coordinates are q_s and v_s
    two_way: bool  # the hand feels the tissue
    structured: bool  # without damping the model conserves its energy by construction
    scale: float = 1.0  # density over that of the projection (canonical models, else 1)

    def card(self) -> Card:
        """Dimension, stability and outputs."""
        rows = (
            ("dimension", f"N = {self.N}, hand {self.n_s}"),
            ("stable", self.verdict()),
            ("outputs", listed(self.outputs.names)),
        )
        return Card(f"ReducedSystem {self.name}", rows)

    def verdict(self) -> str:
        """Whether the system is stable, with the largest real part of an eigenvalue, or why there is none."""
        try:
            return f"{'yes' if self.stable else 'no'}, spectral abscissa {amount(self.spectral_abscissa, '1/s')}"
        except ModelError as error:
            return f"unknown: {error}"

    @property
    def N(self) -> int:
        """Dimension of the first-order model."""
        return len(self.operators.A)

    @property
    def n_s(self) -> int:
        """Degrees of freedom of the hand."""
        return len(self.M_hand)

    @property
    def inner(self) -> slice:
        """Coordinates whose equations decide on stability: the tissue's own where the hand does not feel it."""
        return slice(2 * self.n_s if self.fixed_solid and not self.two_way else 0, self.N)

    @cached_property
    def spectrum(self) -> Spectrum:
        """Eigenvalues without the exact zeros of the free hand.

        Raises:
            ModelError: E is singular, as with linearly dependent columns.
        """
        self.check_independent()
        inner, op = self.inner, self.operators
        Q = op.energy if inner.start else op.total
        result = spectrum(op.E[inner, inner], op.A[inner, inner], Q[inner, inner], self.structured)
        return replace(result, zeros=self.N - len(result.eigenvalues))

    def check_independent(self) -> None:
        """Refuse a singular E, which LAPACK need not notice.

        Raises:
            ModelError: E is singular to rounding, as with linearly dependent columns.
        """
        if not np.isfinite(self.operators.E).all():
            raise ModelError("the reduced matrices are not finite; check basis and materials", self.name)
        if singular(self.operators.E):
            raise ModelError(
                "the reduced E is singular; its basis vectors are linearly dependent, take fewer", self.name
            )

    @property
    def spectral_abscissa(self) -> float:
        """Largest real part of an eigenvalue, apart from the exact zeros of the free hand [1/s]."""
        return self.spectrum.abscissa

    @property
    def stable(self) -> bool:
        """No eigenvalue right of the axis beyond the tolerance, :data:`softgrasp.reduction.spectrum.GROWTH_TOLERANCE`.

        The double zero of the free hand (it drifts at constant velocity) does not count.
        """
        return self.spectrum.stable

    def energy(self, x: Array) -> Array:
        """Tissue energy (z' K z + v_z' M v_z) / 2 of states (..., N) [J]."""
        return np.asarray(np.einsum("...i,...i->...", x @ self.operators.energy, x) / 2)

    def total_energy(self, x: Array) -> Array:
        """Energy with that of the hand's motion, of states (..., N) [J]; two-way it is the Hamiltonian."""
        return np.asarray(np.einsum("...i,...i->...", x @ self.operators.total, x) / 2)

    def lti(self) -> LTI:
        """The system from the hand's load u to the scene's outputs; with ``to_control`` and ``to_pymor``."""
        op, C = self.operators, self.outputs.C_z + self.outputs.C_s @ self.operators.S_q
        return make_lti(op.E, op.A, op.B, C, self.outputs.names, self.fixed_solid)

    def equilibrium(self) -> Array:
        """State at rest under gravity with the hand at the origin, (N,).

        Raises:
            ModelError: the hand is not fixed, so that the model has no such coordinates, or there is no such state, or
                more than one.
        """
        if not self.fixed_solid:
            raise ModelError("an equilibrium needs a basis with fixed solid modes", self.name)
        k = 2 * self.n_s
        x = np.zeros(self.N)
        if self.f.any():
            A = self.operators.A[k:, k:]
            if singular(A):  # as with more displacements than velocities in the basis
                raise ModelError("the basis has no single equilibrium under gravity; take another N", self.name)
            x[k:] = -np.linalg.solve(A, self.f[k:])
        return x


@dataclass(frozen=True, repr=False)
class ReducedModel(Shown):
    """E x' = A x + B u + F g for all lambda, mu, rho of every layer: a new parameter costs no full-order work.

    The matrices are sums over the layers, A = A_0 + sum_l lambda_l A_lambda,l + mu_l A_mu,l and so on, which
    :meth:`at` assembles; a run needs the :class:`ReducedSystem` that it returns.
    """

    name: str
    """Name of the basis."""
    N: int
    """Number of basis vectors, the dimension of the first-order model."""
    coordinates: Coordinates
    """"qv" of the paper's Galerkin model, "qp" of a canonical one."""
    frame: Frame
    """Frame of the tissue rows: absolute, or relative to the hand."""
    structure: Structure
    """Structure that the basis keeps: "none", "symplectic" or "second_order"."""
    fixed_solid: bool
    """Whether the first 2 n_s coordinates are q_s [m, rad] and v_s [m/s, rad/s]."""
    parts: Parts
    """Small matrices by name, the same bits on every rank; those of every layer with a leading axis."""
    materials: tuple[LayerMaterial, ...]
    """Materials of the projection, one a layer."""
    outputs: Outputs
    """Outputs of the scene, y = C_z x + C_s q_s."""
    split: tuple[int, ...] = ()
    """Number of columns of every part of the decomposition, see :class:`softgrasp.reduction.bases.basis.Basis`."""
    alpha: float = 0.0
    """Mass-proportional damping [1/s]."""
    in_space: bool = False
    """Whether alpha drags the rigid motion too."""
    damped: bool = False
    """Whether damping terms were projected."""
    hand_weight: bool = False
    """Whether gravity acts on the hand's own mass."""
    two_way: bool = False
    """Whether the hand feels the tissue."""
    gravity: Array | None = None
    """Acceleration of free fall in the hand's degrees of freedom, (n_s,) [m/s^2], or None."""
    reconstruction: Reconstruction | None = None
    """Rows that return reduced states to the mesh, or None."""
    scene_hash: str = ""
    """Hash of the scene that the model was made for."""
    origin: dict[str, Any] = field(default_factory=dict)
    """Settings of that scene that a run depends on, see :mod:`softgrasp.reduction.origin`; or empty."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Offline time by stage [s]."""

    def card(self) -> Card:
        """Dimension, structure, stability at the scene's materials, outputs."""
        rows = (
            ("dimension", f"N = {self.N}, {'hand kept apart' if self.fixed_solid else 'hand and tissue together'}"),
            ("structure", f"{self.structure.replace('_', ' ')}, in {self.coordinates[0]} and {self.coordinates[1]}"),
            ("material", in_words(self.materials)),
            ("stable there", self.at().verdict()),
            ("outputs", listed(self.outputs.names)),
        )
        return Card(f"ReducedModel {self.name}", rows)

    def at(self, materials: tuple[LayerMaterial, ...] | None = None, gravity: Array | None = None) -> ReducedSystem:
        """Assemble E x' = A x + B u + F g at new materials and gravity. Online; not collective.

        A (q, v) model is affine in mu, lambda, rho, beta mu and beta lambda of each layer. A canonical one needs
        M_ee^-1, which is affine in 1/rho only when all densities change by one factor.

        Args:
            materials: one per layer; None takes those of the projection.
            gravity: acceleration of free fall (n_s,) [m/s^2]; None takes that of the scene.

        Raises:
            ModelError: materials that the parts cannot represent.
        """
        materials = self.materials if materials is None else materials
        p = self.parameters(materials)
        if self.coordinates == "qv":
            operators = galerkin_operators(self.parts, p)
        else:
            operators = canonical_operators(self.parts, p, self.fixed_solid, self.frame == "absolute")
        g = self.gravity if gravity is None else np.asarray(gravity, dtype=float)
        conservative = not p.damped or (p.alpha == 0 and all(m.beta == 0 for m in materials))
        kept = self.coordinates == "qp" or self.structure == "second_order"
        return ReducedSystem(
            name=self.name,
            operators=operators,
            f=np.zeros(self.N) if g is None else operators.F @ g,
            outputs=self.outputs,
            M_hand=self.parts["M_hand"],
            fixed_solid=self.fixed_solid,
            two_way=self.two_way,
            structured=conservative and kept,
            scale=p.scale,
        )

    def lti(self, materials: tuple[LayerMaterial, ...] | None = None) -> LTI:
        """The linear time-invariant system at some materials, see :meth:`ReducedSystem.lti`; as for :meth:`at`."""
        return self.at(materials).lti()

    def parameters(self, materials: tuple[LayerMaterial, ...]) -> Parameters:
        """Check materials and bundle them with the effects of the scene.

        Raises:
            ModelError: wrong number of layers, an impossible value, densities that are no common multiple of those of
                the projection (canonical models), or viscosity in a model without damping.
        """
        if len(materials) != len(self.materials):
            raise ModelError(f"{len(materials)} materials are given; the model has {len(self.materials)} layers")
        for m in materials:
            if not (m.mu > 0 and m.lam > -2 * m.mu / 3 and m.rho > 0 and m.beta >= 0):
                raise ModelError(
                    f"lambda = {m.lam:g} Pa, mu = {m.mu:g} Pa, rho = {m.rho:g} kg/m3, beta = {m.beta:g} s is no "
                    "elastic material; mu and rho must be > 0, lambda > -2 mu / 3 and beta >= 0"
                )
        if not self.damped and any(m.beta > 0 for m in materials):
            raise ModelError("beta > 0 needs a model projected with effects.damping; name it in the scene")
        scale = 1.0
        if self.coordinates == "qp":
            ratios = [m.rho / old.rho for m, old in zip(materials, self.materials, strict=True)]
            scale = ratios[0]
            # the common factor enters squared at most: more than rounding apart is another mass distribution
            if max(ratios) - min(ratios) > 1e-12 * scale:
                raise ModelError(
                    "a canonical model holds M_ee^-1 and takes densities that all change by one factor; "
                    "project again, or use a (q, v) model"
                )
        return Parameters(materials, self.alpha, self.damped, self.in_space, self.hand_weight, self.two_way, scale)

    def reconstruct(self, small: ReducedSystem, x: Array, v_s: Array | None = None) -> tuple[Array, Array]:
        """Relative tissue states of reduced states x (N, m): z and v_z, local rows (n_local, m).

        Args:
            small: the parameter that x was computed at.
            x: reduced states, one a column.
            v_s: hand velocity (n_s, m); None takes S_v x.

        Raises:
            ModelError: the model was loaded without its reconstruction.
        """
        reconstruction = self.reconstruction
        if reconstruction is None:
            raise ModelError("the model holds no basis on the mesh; load it with the layout of its mesh", self.name)
        z, v_z = reconstruction.L_q @ x, reconstruction.L_v @ x
        if small.scale != 1.0:
            v_z /= small.scale
        if reconstruction.W_G is not None:
            v_z -= reconstruction.W_G @ (small.operators.S_v @ x if v_s is None else v_s)
        return z, v_z
