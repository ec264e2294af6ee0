"""Reduced models: small matrices for every material and gravity, and the system at one of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.material import LayerMaterial, differs, in_words, of_layers
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, drawn, listed
from softgrasp.reduction.bases.basis import Coordinates, Frame, Structure
from softgrasp.reduction.canonical import canonical_system
from softgrasp.reduction.galerkin import galerkin_equations, galerkin_system
from softgrasp.reduction.operators import Parameters, Parts, Reconstruction
from softgrasp.reduction.system import EnergySystem, ModelError, Outputs

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.run.states.trajectory import Trajectory


def check_materials(materials: tuple[LayerMaterial, ...], own: tuple[LayerMaterial, ...], damped: bool) -> None:
    """Check that a model made with the materials ``own`` can represent others.

    Raises ModelError: wrong number of layers, other own terms, no elastic material, or viscosity of a model that was
    projected without damping.
    """
    if len(materials) != len(own):
        raise ModelError(f"{len(materials)} materials are given; the model has {len(own)} layers")
    if text := differs(materials, own):
        raise ModelError(text)
    for m in of_layers(materials):
        if not (m.mu > 0 and m.lam > -2 * m.mu / 3 and m.rho > 0 and m.beta >= 0):
            raise ModelError(
                f"lambda = {m.lam:g} Pa, mu = {m.mu:g} Pa, rho = {m.rho:g} kg/m3, beta = {m.beta:g} s is no "
                "elastic material; mu and rho must be > 0, lambda > -2 mu / 3 and beta >= 0"
            )
    if not damped and any(m.beta > 0 for m in materials):
        raise ModelError("beta > 0 needs a model projected with effects.damping; name it in the scene")


@dataclass(frozen=True, repr=False)
class ReducedModel(Shown):
    """E x' = A x + B u + F g for all lambda, mu, rho of every layer: a new parameter needs no full-order work.

    The matrices are sums over the layers, A = A_0 + sum_l lambda_l A_lambda,l + mu_l A_mu,l and so on, which
    :meth:`at` assembles; a run needs the :class:`EnergySystem` that it returns.
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

    def plot_errors(self, model: Model, run: Trajectory) -> Any:
        """Outputs of a full run and of this model, and their difference, as ``matplotlib`` figure. Collective.

        Raises SoftgraspError: see :func:`softgrasp.reduction.reduce.replay`.
        """
        return drawn("model_errors", self, model, run)

    def explore(self, model: Model, run: Trajectory, span: float = 10.0) -> Any:
        """Outputs of this model under the hand of a run, with sliders of lambda and mu of each layer, for a notebook.

        Args:
            model: scene of the model, with the materials of the run; the sliders begin at them.
            run: a full run.
            span: largest ratio of a slider's value and its first one, above 1 [1].

        Returns:
            ``ipywidgets.VBox``: the sliders and the figure.

        Raises SoftgraspError: ipywidgets is not installed, or see :func:`softgrasp.reduction.reduce.replay`.
        """
        return drawn("explorer", self, model, run, span)

    def pull(self, model: Model) -> Any:
        """A page in which the mouse pulls the hand and this model of the tissue follows, for a notebook. Collective.

        Args:
            model: scene of the model, with the materials of the motion.

        Returns:
            :class:`softgrasp.study.notebook.View`: ``save("pull.html")`` writes it; empty on a rank above 0.

        Raises ModelError: the scene is another one, the basis does not keep the hand apart, or the model is unstable or
            without its basis.
        """
        return drawn("pulled", self, model)

    def to_pymor(self) -> Any:
        """The model as ``pymor.models.iosys.LTIModel``, affine in ``mu``, ``lambda`` [Pa], ``beta`` [s] of each layer.

        A (q, v) model is affine in ``rho`` [kg/m^3] too; only a damped one has ``beta``. B and C are called as their
        columns and rows, with units; gravity, which only moves the state of rest, is left out.

        Raises SoftgraspError: pyMOR is not installed, or the program runs on several ranks.
        """
        return import_module("softgrasp.reduction.export.pymor").parametric(self)  # a room above this one

    def at(self, materials: tuple[LayerMaterial, ...] | None = None, gravity: Array | None = None) -> EnergySystem:
        """Assemble E x' = A x + B u + F g at new materials and gravity. Online; not collective.

        A (q, v) model is affine in mu, lambda, rho, beta mu and beta lambda of each layer. A canonical one needs
        M_ee^-1, which is affine in 1/rho only when all densities change by one factor.

        Args:
            materials: one per layer; None: those of the projection.
            gravity: acceleration of free fall (n_s,) [m/s^2]; None: that of the scene.

        Raises:
            ModelError: materials that the parts cannot represent.
        """
        return self.assemble(self.parameters(self.materials if materials is None else materials, gravity))

    def assemble(self, p: Parameters) -> EnergySystem:
        """The sums at parameters that need be no material, such as one constant alone. Online; not collective."""
        if self.coordinates == "qv":
            return galerkin_system(self.name, self.parts, p, self.outputs, self.structure == "second_order")
        return canonical_system(self.name, self.parts, p, self.outputs, self.fixed_solid, self.frame == "absolute")

    def equations(self, p: Parameters) -> tuple[Array, Array, Array]:
        """E, A and f of :meth:`assemble` alone. Online; not collective."""
        if self.coordinates == "qv":
            return galerkin_equations(self.parts, p)
        system = self.assemble(p)
        return system.E, system.A, system.f

    def parameters(self, materials: tuple[LayerMaterial, ...], gravity: Array | None = None) -> Parameters:
        """Check materials and bundle them with the effects of the scene.

        Raises:
            ModelError: wrong number of layers, an impossible value, densities that are no common multiple of those of
                the projection (canonical models), or viscosity in a model without damping.
        """
        check_materials(materials, self.materials, self.damped)
        scale = 1.0
        if self.coordinates == "qp":
            pairs = [(m.dense, old.dense) for m, old in zip(materials, self.materials, strict=True)]
            ratios = [new / old if old else np.inf for new, old in pairs if old or new]
            scale = ratios[0]
            # the common factor enters squared at most: more than rounding apart is another mass distribution
            if max(ratios) - min(ratios) > 1e-12 * scale:
                raise ModelError(
                    "a canonical model contains M_ee^-1 and accepts densities that all change by one factor; "
                    "project again, or use a (q, v) model"
                )
        g = self.gravity if gravity is None else np.asarray(gravity, dtype=float)
        return Parameters(materials, g, self.alpha, self.damped, self.in_space, self.hand_weight, self.two_way, scale)

    def reconstruct(self, small: EnergySystem, x: Array, v_s: Array | None = None) -> tuple[Array, Array]:
        """Relative tissue states of reduced states x (N, m): z and v_z, local rows (n_local, m).

        Args:
            small: the parameter that x was computed at.
            x: reduced states, one a column.
            v_s: hand velocity (n_s, m); None: S_v x.

        Raises:
            ModelError: the model was loaded without its reconstruction.
        """
        reconstruction = self.reconstruction
        if reconstruction is None:
            raise ModelError("the model has no basis on the mesh; load it with the layout of its mesh", self.name)
        z, v_z = reconstruction.L_q @ x, reconstruction.L_v @ x
        if small.scale != 1.0:
            v_z /= small.scale
        if reconstruction.W_G is not None:
            v_z -= reconstruction.W_G @ (small.S_v @ x if v_s is None else v_s)
        return z, v_z
