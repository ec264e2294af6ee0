"""The numbers of an isotropic material, as operators are assembled from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from softgrasp.fem.shown import MOST_LAYERS, amount, digits

REST = "rest"  # name of the part of an own energy that no parameter multiplies


@dataclass(frozen=True)
class LayerMaterial:
    """Isotropic material of one layer."""

    lam: float  # first Lame parameter lambda [Pa]
    mu: float  # shear modulus [Pa]
    rho: float  # density [kg/m^3]
    beta: float = 0.0  # Kelvin-Voigt time, D = beta K [s]
    part: str = ""  # name of the parameter whose value mu is, in a row of an own energy or term; empty in a layer
    fixed: tuple[tuple[str, float], ...] = ()  # parameters that the operators are not affine in, with their values
    adds: str = ""  # what the row of an own term adds to: "stiffness", "damping", "mass" or "load"; else empty

    def __post_init__(self) -> None:
        pairs = tuple((str(key), float(value)) for key, value in self.fixed)  # lists, if they come from JSON
        object.__setattr__(self, "fixed", pairs)

    @property
    def stiff(self) -> float:
        """Factor of K_mu in the stiffness [Pa]."""
        return self.mu if self.adds in ("", "stiffness") else 0.0

    @property
    def viscous(self) -> float:
        """Factor of K_mu in the damping matrix [Pa s]."""
        return self.mu if self.adds == "damping" else self.beta * self.stiff

    @property
    def dense(self) -> float:
        """Factor of M_1 in the mass [kg/m^3]."""
        return self.mu if self.adds == "mass" else self.rho

    @property
    def pulls(self) -> float:
        """Factor of the row's own load [N]."""
        return self.mu if self.adds == "load" else 0.0


def differs(new: Sequence[LayerMaterial], old: Sequence[LayerMaterial]) -> str:
    """The first parameter that differs though the operators are not affine in it, as a sentence; empty if none does."""
    for m, own in zip(new, old, strict=True):
        own_values = dict(own.fixed)
        for key, value in m.fixed:
            if own_values.get(key, value) != value:
                return _sentence(key, value, own_values[key])
        for key in ("lam", "mu"):
            if key in own_values and not own.part and getattr(m, key) != own_values[key]:
                return _sentence(key, getattr(m, key), own_values[key])
    return ""


def _sentence(key: str, value: float, old: float) -> str:
    return (
        f"{key} = {value:g} needs a new model: the tangent of the energy is not affine in {key}, which is {old:g} here;"
        " build the scene with the new value"
    )


def scaled(materials: Sequence[LayerMaterial], lam: float, mu: float, rho: float = 1.0) -> tuple[LayerMaterial, ...]:
    """The materials with lambda, mu and rho of all layers multiplied; own parameters as they are."""
    return tuple(
        replace(m, rho=m.rho * rho) if m.part else replace(m, lam=m.lam * lam, mu=m.mu * mu, rho=m.rho * rho)
        for m in materials
    )


def of_layers(materials: Sequence[LayerMaterial]) -> tuple[LayerMaterial, ...]:
    """The materials of layers, without the rows of own parameters."""
    return tuple(m for m in materials if not m.part)


def in_words(materials: Sequence[LayerMaterial]) -> str:
    """Numbers of each layer with their units, or how many layers there are."""
    layers, own = of_layers(materials), [m for m in materials if m.part and m.part != REST]
    if len(layers) > MOST_LAYERS:
        return f"{len(layers)} layers"
    many = len(own) > 2 * MOST_LAYERS
    parameters = [f"{len(own)} parameters"] if many else [f"{m.part} = {digits(m.mu)}" for m in own]
    return "; ".join(
        [
            f"lambda = {digits(m.lam)} Pa, mu = {digits(m.mu)} Pa, rho = {digits(m.rho)} kg/m3"
            + (f", beta = {amount(m.beta, 's')}" if m.beta else "")
            for m in layers
        ]
        + parameters
    )
