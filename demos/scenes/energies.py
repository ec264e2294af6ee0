"""Energies per volume of the rest state in UFL, which scenes name by ``tissue.energy = "energies.py:fibres"``.

Each is a function of the deformation gradient F (d x d, in 2D plane strain) and of the parameters p: mu and lam [Pa] of
the layer's material, whatever ``tissue.parameters`` has, the place p.x at rest and the dimension p.d.
"""

from typing import Any

import ufl


def neo_hooke(F: Any, p: Any) -> Any:
    """W = mu/2 (|F|^2 - d) - mu ln J + lam/2 (ln J)^2, the built-in law."""
    log = ufl.ln(ufl.det(F))
    return p.mu / 2 * (ufl.inner(F, F) - p.d) - p.mu * log + p.lam / 2 * log**2


def fibres(F: Any, p: Any) -> Any:
    """Fibres along (cos angle, sin angle) in it: W + k1 / (2 k2) (exp(k2 (I4 - 1)^2) - 1), I4 = |F a|^2 [HGO00].

    k1 [Pa], k2 [1] and angle [rad]; the stiffness at rest is affine in k1 and does not depend on k2.
    """
    a = ufl.as_vector([ufl.cos(p.angle), ufl.sin(p.angle), 0][: p.d])
    stretch = ufl.dot(F * a, F * a)
    return neo_hooke(F, p) + p.k1 / (2 * p.k2) * (ufl.exp(p.k2 * (stretch - 1) ** 2) - 1)


def gent(F: Any, p: Any) -> Any:
    """Chains of limited length: W = -mu/2 limit ln(1 - (|F|^2 - d) / limit) - mu ln J + lam/2 (ln J)^2 [Gen96].

    limit [1]; no body reaches |F|^2 = d + limit.
    """
    log = ufl.ln(ufl.det(F))
    chains = -p.mu / 2 * p.limit * ufl.ln(1 - (ufl.inner(F, F) - p.d) / p.limit)
    return chains - p.mu * log + p.lam / 2 * log**2
