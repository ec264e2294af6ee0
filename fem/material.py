"""The numbers of an isotropic material, as operators are assembled from them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LayerMaterial:
    """Lame constants [Pa], density [kg/m^3] and Kelvin-Voigt time [s] of one layer."""

    lam: float
    mu: float
    rho: float
    beta: float = 0.0
