"""Hyperelastic laws as plain arrays over quadrature points: energy, stress, tangent, and a discrete gradient.

Tensors are arrays (d, d, Q), the points last. With F = I + H, H = grad z, J = det F, j = J - 1, and W the energy per
volume of the rest state:

    neo-hooke            W = mu/2 (|F|^2 - d) - mu ln J + lam/2 (ln J)^2      [BW08]
    neo-hooke-quadratic  W = mu/2 (|F|^2 - d) - mu ln J + lam/2 (J - 1)^2     keeps its convexity in J beyond J = e
    stvk                 W = mu E:E + lam/2 (tr E)^2,  E = (F'F - I)/2        (St. Venant-Kirchhoff)

All have the Hessian of linear elasticity at F = I. For a step from F_0 to F_1 = F_0 + 2 grad w with F_m between them, a
discrete gradient [G96] is a stress with P : (F_1 - F_0) = W_1 - W_0 in every point. The first two laws are
mu/2 |F|^2 + g(J), and J is quadratic or cubic in F, so

    P = mu F_m + gbar C,   gbar = (g(J_1) - g(J_0)) / (J_1 - J_0),   C = Cof F_m [+ Cof(grad w) / 3 in 3D],

where C : (F_1 - F_0) = J_1 - J_0 exactly and gbar is smooth at J_1 = J_0: log1p(x)/x is right to rounding however small
x = (J_1 - J_0)/J_0 is. St. Venant-Kirchhoff has P = F_m C:(E_0 + E_1)/2 [ST92].
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])[:, :, None]


def identity(H: Array) -> Array:
    """F = I + H."""
    F = H.copy()
    for i in range(len(H)):
        F[i, i] += 1.0
    return F


def double_dot(A: Array, B: Array) -> Array:
    """A : B, (Q,)."""
    return np.asarray(np.einsum("ijq,ijq->q", A, B))


def cofactor(A: Array) -> Array:
    """Cof A = det(A) A^-T, (d, d, Q)."""
    if len(A) == 2:
        return np.asarray(SIGNS * A[::-1, ::-1])
    C = np.empty_like(A)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            np.multiply(A[a, k], A[b, m], out=C[i, j])
            C[i, j] -= A[a, m] * A[b, k]
    return C


def invariants(H: Array) -> tuple[Array, Array]:
    """Tr H and det(I + H) - 1 - tr H, (Q,) each: their sum is J - 1 without cancellation."""
    if len(H) == 2:
        return H[0, 0] + H[1, 1], H[0, 0] * H[1, 1] - H[0, 1] * H[1, 0]
    C = cofactor(H)
    rest = C[0, 0] + C[1, 1] + C[2, 2] + H[0, 0] * C[0, 0] + H[0, 1] * C[0, 1] + H[0, 2] * C[0, 2]
    return H[0, 0] + H[1, 1] + H[2, 2], rest


def volume_change(H: Array) -> Array:
    """J = det(I + H) - 1, (Q,)."""
    trace, rest = invariants(H)
    return trace + rest


LawName = Literal["neo-hooke", "neo-hooke-quadratic", "stvk"]
TINY = 1e-300  # instead of x = 0 in log1p(x)/x
LEAST_STRETCH = 0.65  # of St. Venant-Kirchhoff, whose stress in compression falls again below 1/sqrt(3) = 0.577


@dataclass(frozen=True)
class Start:
    """A law at the start of a step."""

    H: Array  # H_0, (d, d, Q)
    j: Array  # J_0 - 1, (Q,)
    log: Array  # ln J_0, (Q,); of no use to St. Venant-Kirchhoff


class Law(ABC):
    """A law of the material; the moduli of a point, lam and mu [Pa] of the built-in laws, are numbers or (Q,)."""

    name: str  # name of the law in scenes
    barrier = True  # W has no value where J <= 0
    least_stretch = 0.0  # principal stretch below which the law is no model of a solid; 0 where there is none

    @abstractmethod
    def energy(self, H: Array, *moduli: Array) -> Array:
        """W(I + H) [J/m^d], (Q,), without cancellation at small strain."""

    @abstractmethod
    def stress(self, H: Array, *moduli: Array) -> Array:
        """First Piola-Kirchhoff stress P = dW/dF [Pa], (d, d, Q)."""

    @abstractmethod
    def tangent(self, H: Array, *moduli: Array) -> Array:
        """A = dP/dF [Pa], (d, d, d, d, Q) with A[i, J, k, L] = dP_iJ/dF_kL."""

    def stiffness(self, *moduli: Array) -> Array:
        """Size of the terms of the stress, of which rounding leaves a part [Pa], (Q,): mu of the built-in laws."""
        return moduli[1]

    def kernel(self, points: Any, moduli: tuple[Array, ...]) -> Any:
        """Compiled steps of an own law as `body.Kernel` has them; None where there is no compiler."""
        return None

    def start(self, H: Array) -> Start:
        """Values at H_0 that :meth:`step` needs."""
        j = volume_change(H)
        with np.errstate(invalid="ignore", divide="ignore"):  # an inverted start is refused by its J
            return Start(H.copy(), j, np.log1p(j))

    def defined(self, H: Array, *moduli: Array) -> bool:
        """Whether the law has a tangent at H in all points."""
        return not self.barrier or bool(volume_change(H).min(initial=0.0) > -1)

    @abstractmethod
    def step(self, start: Start, half: Array, *moduli: Array) -> tuple[Array | None, Array]:
        """Stress P of the discrete gradient from H_0 to H_0 + 2 half and J_1, (Q,); None where some J_1 forbids it."""


class NeoHooke(Law):
    """W = mu/2 (|F|^2 - d) + g(J), g(J) = -mu ln J + lam/2 (ln J)^2, or with lam/2 (J - 1)^2 where quadratic."""

    def __init__(self, name: str, quadratic: bool) -> None:
        self.name, self.quadratic = name, quadratic

    def energy(self, H: Array, *moduli: Array) -> Array:
        """See :class:`Law`: mu/2 (|H|^2 + 2 tr H - 2 j) + (g(J) + mu j), where both terms are of second order."""
        lam, mu = moduli
        trace, rest = invariants(H)
        j = trace + rest
        return np.asarray(mu * (double_dot(H, H) / 2 - rest) + mu * (j - np.log1p(j)) + self.volume_energy(j, lam))

    def stress(self, H: Array, *moduli: Array) -> Array:
        """See :class:`Law`: P = mu F + g'(J) Cof F."""
        lam, mu = moduli
        F = identity(H)
        return np.asarray(mu * F + self.slopes(volume_change(H), lam, mu)[0] * cofactor(F))

    def tangent(self, H: Array, *moduli: Array) -> Array:
        """See :class:`Law`: A = mu I + g'' Cof F (x) Cof F + g' dCof F/dF."""
        lam, mu = moduli
        d, F = len(H), identity(H)
        C, (p, q) = cofactor(F), self.slopes(volume_change(H), lam, mu)
        A = C[:, :, None, None] * (q * C)
        diagonal = np.einsum("iJiJq->iJq", A)
        diagonal += mu
        for i in range(d):
            for k in range(d):
                if i != k:  # Cof is linear in every row: its derivative has no diagonal
                    A[i, :, k, :] += p * _turned(F, i, k)
        return A

    def step(self, start: Start, half: Array, *moduli: Array) -> tuple[Array | None, Array]:
        """See :class:`Law`."""
        lam, mu = moduli
        F = identity(start.H + half)
        C = cofactor(F)
        if len(half) == 3:
            C += cofactor(half) / 3
        dj = double_dot(C, half)
        dj *= 2
        old = 1 + start.j
        new = old + dj
        if not np.minimum.reduce(new, initial=np.inf) > 0:  # also where it is not a number
            return None, new
        x = dj / old
        x += TINY
        dl = np.log1p(x)
        x *= old
        C *= self.quotient(dl / x, start, dj, dl, lam, mu)
        F *= mu
        F += C
        return F, new

    def volume_energy(self, j: Array, lam: Array) -> Array:
        """g(J) + mu ln J."""
        return np.asarray(lam / 2 * j * j if self.quadratic else lam / 2 * np.log1p(j) ** 2)

    def slopes(self, j: Array, lam: Array, mu: Array) -> tuple[Array, Array]:
        """g'(J) and g''(J)."""
        J = 1 + j
        if self.quadratic:
            return lam * j - mu / J, lam + mu / (J * J)
        p = lam * np.log1p(j) - mu
        return p / J, (lam - p) / (J * J)

    def quotient(self, log: Array, start: Start, dj: Array, dl: Array, lam: Array, mu: Array) -> Array:
        """(g(J_1) - g(J_0)) / dj with dj = J_1 - J_0, given ``log``, that of ln J, and dl = ln J_1/J_0, scratch."""
        if self.quadratic:
            return np.asarray(lam * (start.j + dj / 2) - mu * log)
        dl *= 0.5
        dl += start.log
        dl *= lam
        dl -= mu
        dl *= log
        return dl


class StVenantKirchhoff(Law):
    """W = mu E:E + lam/2 (tr E)^2: softens in compression, so it is refused where it folds."""

    name = "stvk"
    barrier = False
    least_stretch = LEAST_STRETCH

    def energy(self, H: Array, *moduli: Array) -> Array:
        """See :class:`Law`."""
        lam, mu = moduli
        E = green(H)
        return np.asarray(mu * double_dot(E, E) + lam / 2 * np.einsum("iiq->q", E) ** 2)

    def stress(self, H: Array, *moduli: Array) -> Array:
        """See :class:`Law`: P = F S."""
        lam, mu = moduli
        return _push(identity(H), second_stress(green(H), lam, mu))

    def tangent(self, H: Array, *moduli: Array) -> Array:
        """See :class:`Law`: A_iJkL = lam F_iJ F_kL + mu (F_iL F_kJ + (F F')_ik d_JL) + d_ik S_JL."""
        lam, mu = moduli
        F, S, one = identity(H), second_stress(green(H), lam, mu), np.eye(len(H))
        A = np.einsum("iLq,kJq->iJkLq", F, F)
        A += np.einsum("imq,kmq,JL->iJkLq", F, F, one)
        A *= mu
        A += lam * F[:, :, None, None] * F
        return np.asarray(A + np.einsum("ik,JLq->iJkLq", one, S))

    def step(self, start: Start, half: Array, *moduli: Array) -> tuple[Array | None, Array]:
        """See :class:`Law`."""
        lam, mu = moduli
        end = start.H + 2 * half
        E = (green(start.H) + green(end)) / 2
        return _push(identity(start.H + half), second_stress(E, lam, mu)), 1 + volume_change(end)


def green(H: Array) -> Array:
    """E = (H + H' + H'H) / 2, (d, d, Q)."""
    return np.asarray((H + H.swapaxes(0, 1) + np.einsum("kiq,kjq->ijq", H, H)) / 2)


def second_stress(E: Array, lam: Array, mu: Array) -> Array:
    """S = 2 mu E + lam tr(E) I [Pa], (d, d, Q)."""
    S = 2 * mu * E
    diagonal = np.einsum("iiq->iq", S)
    diagonal += lam * np.einsum("iiq->q", E)
    return np.asarray(S)


def _push(F: Array, S: Array) -> Array:
    """P = F S, (d, d, Q)."""
    return np.asarray(np.einsum("ikq,kjq->ijq", F, S))


def stretches(H: Array) -> Array:
    """Smallest principal stretch of I + H, (Q,)."""
    F = identity(H).transpose(2, 0, 1)
    return np.asarray(np.linalg.svd(F, compute_uv=False)[:, -1])


def _turned(F: Array, i: int, k: int) -> Array:
    """dCof_iJ/dF_kL for i != k, (d, d, Q): eps_ikm eps_JLn F_mn."""
    d = len(F)
    result = np.zeros_like(F)
    if d == 2:
        sign = 1.0 if i < k else -1.0
        result[0, 1], result[1, 0] = sign, -sign
        return result
    m = 3 - i - k
    sign = 1.0 if (k - i) % 3 == 1 else -1.0
    for J in range(3):
        L, n = (J + 1) % 3, (J + 2) % 3
        result[J, L], result[L, J] = sign * F[m, n], -sign * F[m, n]
    return result


LAWS: dict[str, Law] = {
    law.name: law for law in (NeoHooke("neo-hooke", False), NeoHooke("neo-hooke-quadratic", True), StVenantKirchhoff())
}
"""The laws by the name that a scene gives them; the first is the default."""
