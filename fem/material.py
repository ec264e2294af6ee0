"""The numbers of an isotropic material, as operators are assembled from them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LayerMaterial:
    """Isotropic material of one layer."""

    lam: float  # first Lame parameter lambda [Pa]
    mu: float  # shear modulus [Pa]
    rho: float  # density [kg/m^3]
    beta: float = 0.0  # Kelvin-Voigt time, D = beta K [s]
