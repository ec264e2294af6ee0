"""Isotropic linear elastic materials: conversions and a small library with its sources.

lambda = E nu / ((1 + nu) (1 - 2 nu)),  mu = E / (2 (1 + nu)),  nu = lambda / (2 (lambda + mu)).

Soft tissue and silicone are nearly incompressible; the library states nu = 0.45 to 0.49, a choice for
displacement elements and not a measurement. The small-strain moduli of tissue scatter over a decade between
subjects, loading rates and methods, so they are orders of magnitude.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass


@dataclass(frozen=True)
class LibraryMaterial:
    """One material of the library."""

    young: float  # Young's modulus E [Pa]
    poisson: float  # Poisson's ratio nu [1]
    rho: float  # density [kg/m3]
    source: str  # origin of the numbers


def lame(young: float, poisson: float) -> tuple[float, float]:
    """(lambda, mu) [Pa] from Young's modulus [Pa] and Poisson's ratio [1]."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def young_poisson(lam: float, mu: float) -> tuple[float, float]:
    """(E [Pa], nu [1]) from the Lame constants [Pa]."""
    return mu * (3 * lam + 2 * mu) / (lam + mu), lam / (2 * (lam + mu))


_TISSUE = "order of magnitude; {}"
_SMOOTH_ON = (
    "modulus at 100 % strain and density from the Smooth-On technical bulletin of the {}; the secant "
    "modulus at 100 % is used as E, nu chosen"
)

LIBRARY: dict[str, LibraryMaterial] = {
    "paper": LibraryMaterial(
        *young_poisson(50.0, 50.0), 1.0, "lambda = mu = 50, rho = 1: the dimensionless values of the paper"
    ),
    "muscle": LibraryMaterial(
        20e3, 0.45, 1060.0, _TISSUE.format("passive muscle is 1e4 to 1e5 Pa; density of MendezKeys1960")
    ),
    "fat": LibraryMaterial(
        3e3, 0.45, 920.0, _TISSUE.format("adipose tissue is 1e3 to 1e4 Pa (Samani2007); density rounded")
    ),
    "skin": LibraryMaterial(100e3, 0.45, 1100.0, _TISSUE.format("skin is 1e4 to 1e6 Pa by method; density rounded")),
    "ecoflex-00-30": LibraryMaterial(69e3, 0.49, 1070.0, _SMOOTH_ON.format("Ecoflex series (SmoothOnEcoflex)")),
    "dragon-skin-30": LibraryMaterial(
        593e3, 0.49, 1080.0, _SMOOTH_ON.format("Dragon Skin series (SmoothOnDragonSkin)")
    ),
}


def lookup(name: str) -> LibraryMaterial:
    """The library entry of this name. Raises ValueError: the name is unknown; the message suggests the nearest one."""
    if name in LIBRARY:
        return LIBRARY[name]
    near = difflib.get_close_matches(name.lower(), LIBRARY, n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'?" if near else "the library has " + ", ".join(LIBRARY)
    raise ValueError(f"'{name}' is not a material of the library; {hint}")
