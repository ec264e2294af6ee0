"""The numbers of an isotropic material, as operators are assembled from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from softgrasp.fem.shown import MOST_LAYERS, amount


@dataclass(frozen=True)
class LayerMaterial:
    """Isotropic material of one layer."""

    lam: float  # first Lame parameter lambda [Pa]
    mu: float  # shear modulus [Pa]
    rho: float  # density [kg/m^3]
    beta: float = 0.0  # Kelvin-Voigt time, D = beta K [s]


def in_words(materials: Sequence[LayerMaterial]) -> str:
    """Numbers of each layer with their units, or how many layers there are."""
    if len(materials) > MOST_LAYERS:
        return f"{len(materials)} layers"
    return "; ".join(
        f"lambda = {m.lam:.4g} Pa, mu = {m.mu:.4g} Pa, rho = {m.rho:.4g} kg/m3"
        + (f", beta = {amount(m.beta, 's')}" if m.beta else "")
        for m in materials
    )
