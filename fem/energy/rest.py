"""An energy at rest: whether it is one of a solid, and the parameters that its tangent is affine in.

With A(p) the tangent at F = I, A(p) = A_0 + sum over some parameters i of p_i A_i, A_i = dA/dp_i. A parameter is one
of the sum where A_i does not change with it, nor with those of the sum before it; exact derivatives at drawn values
decide.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from softgrasp.fem.energy.law import EnergyLaw
from softgrasp.fem.errors import SceneError
from softgrasp.fem.petsc import Array

SAME = 1e-11  # relative difference of tangents that are equal but for rounding [1]
STRESS_FREE = 1e-9  # largest stress at rest over the largest modulus [1]
POSITIVE = 1e-9  # smallest modulus over the largest, below which a strain costs nothing [1]
DRAWS = 3  # sets of drawn parameters
VOIGT = {2: ((0, 0), (1, 1), (0, 1)), 3: ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))}


@dataclass(frozen=True)
class Affine:
    """Parameters of an energy by what they do to its tangent at rest."""

    parameters: tuple[str, ...] = ()  # those of the sum, A_i their derivative
    inert: tuple[str, ...] = ()  # those without effect at rest
    other: dict[str, str] = field(default_factory=dict)  # why each of the others is not in the sum, in words


def affine_parameters(law: EnergyLaw, values: Mapping[str, Array]) -> Affine:
    """Which parameters the tangent at rest is affine in, near these values, numbers or (Q,), and at these places."""
    names, rng = law.parameters, np.random.default_rng(0)
    scale = max((float(np.abs(values[key]).max(initial=0.0)) for key in names), default=1.0) or 1.0

    def drawn(keys: tuple[str, ...]) -> dict[str, Array]:
        own = {key: np.where(values[key] == 0, scale, values[key]) * rng.uniform(0.7, 1.4) for key in keys}
        return {**values, **own}

    A = law.at_rest(dict(values))
    size = float(np.abs(A).max(initial=0.0))
    if not np.isfinite(size):
        raise SceneError(f"{law.name}: the tangent at rest is no number; check the energy at F = I and its parameters")
    by = {key: law.at_rest(dict(values), key) for key in names}

    def effect(key: str, change: Array) -> float:
        most = float(np.abs(np.where(values[key] == 0, scale, values[key])).max())
        value = float(np.abs(change).max(initial=0.0)) * most
        return value if np.isfinite(value) else np.inf

    def changes(key: str, others: tuple[str, ...]) -> bool:
        return any(
            effect(key, law.at_rest(drawn(others), key) - by[key]) > SAME * max(size, effect(key, by[key]))
            for _ in range(DRAWS)
        )

    inert = tuple(
        key
        for key in names
        if effect(key, by[key]) <= SAME * size
        and all(effect(key, law.at_rest(drawn(names), key)) <= SAME * size for _ in range(DRAWS))
    )
    found: list[str] = []
    other: dict[str, str] = {}
    for key in names:
        if key in inert:
            continue
        if changes(key, (key,)):
            other[key] = "it is not linear in it"
        elif conflict := next((old for old in found if changes(key, (old,))), None):
            other[key] = f"it is linear in its product with {conflict}"
        else:
            found.append(key)
    if found and any(changes(key, tuple(found)) for key in found):  # beyond pairs
        other |= dict.fromkeys(found[1:], "it is linear in a product of several")
        del found[1:]
    return Affine(tuple(found), inert, other)


def check_solid(law: EnergyLaw, values: Mapping[str, Array], where: str) -> None:
    """Refuse what is no energy of a solid at rest.

    Raises SceneError: a stress at rest, a change of the energy by a rotation, or a strain that costs no energy.
    """
    d = law.d
    A, P = law.at_rest(dict(values)), law.stress_at_rest(dict(values))
    size = float(np.abs(A).max(initial=0.0))
    if not (np.isfinite(A).all() and np.isfinite(P).all()):
        raise SceneError(f"{law.name}: stress and tangent at rest in {where} are no numbers; check W near F = I")
    if np.abs(P).max(initial=0.0) > STRESS_FREE * size:
        i, j = np.unravel_index(int(np.abs(P).reshape(d * d, -1).max(axis=1).argmax()), (d, d))
        worst = float(np.abs(P[i, j]).max())
        raise SceneError(
            f"{law.name}: the stress at rest in {where} is {worst:.3g} Pa ({'xyz'[i]}{'xyz'[j]}); W needs a term that "
            "makes it zero, as -mu ln(det F) does for mu/2 |F|^2"
        )
    spin = np.abs(A - A.swapaxes(2, 3)).max(initial=0.0)
    if spin > STRESS_FREE * size:
        raise SceneError(f"{law.name}: in {where} a rotation changes the energy; write W in C = F.T*F and det F")
    rng = np.random.default_rng(1)
    shape = np.broadcast_shapes(*(np.shape(x) for x in values.values()))
    moduli = tuple(np.broadcast_to(values[key], shape).reshape(-1)[:1] for key in law.inputs)
    F = np.eye(d) + 0.1 * rng.uniform(-1, 1, (d, d))
    Q = np.linalg.qr(rng.standard_normal((d, d)))[0]
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    ends = (law.inputs_at((X - np.eye(d))[..., None], moduli) for X in (F, Q @ F))
    one, two = (law.programs["energy"].run(each, (1,))[0, 0] for each in ends)
    if abs(one - two) > STRESS_FREE * size:
        raise SceneError(f"{law.name}: in {where} a rotation changes the energy; write W in C = F.T*F and det F")
    eigenvalues = np.linalg.eigvalsh(np.moveaxis(on_strains(A), (0, 1), (-2, -1)))
    low = float(eigenvalues[..., 0].min(initial=np.inf))
    if low <= POSITIVE * float(eigenvalues[..., -1].max(initial=0.0)):
        raise SceneError(
            f"{law.name}: the tangent at rest in {where} has the modulus {low:.3g} Pa for some strain; every strain "
            "must cost energy, check W and its parameters"
        )


def on_strains(A: Array) -> Array:
    """The moduli (d, d, d, d, ...) on symmetric strains in an orthonormal basis, (3, 3, ...) or (6, 6, ...)."""
    pairs = VOIGT[len(A)]
    weight = [1.0 if i == j else np.sqrt(2.0) for i, j in pairs]
    result = np.empty((len(pairs), len(pairs), *A.shape[4:]))
    for a, (i, j) in enumerate(pairs):
        for b, (k, m) in enumerate(pairs):
            result[a, b] = weight[a] * weight[b] * A[i, j, k, m]
    return result


def ordered(lower: Array, upper: Array) -> bool:
    """Whether 0 <= lower <= upper as moduli (d, d, d, d, ...), to rounding: what certificates need of lambda and mu."""
    size = POSITIVE * max(np.abs(lower).max(initial=0.0), np.abs(upper).max(initial=0.0))
    return all(
        float(np.linalg.eigvalsh(np.moveaxis(on_strains(X), (0, 1), (-2, -1))).min(initial=0.0)) >= -size
        for X in (lower, upper - lower)
    )
