"""Integrals of the inertia loads in the hand's frame, and the momenta of hand and tissue that they give.

A point at r from the reference point moves against space by u = V + Omega x (r + z) + z' in the axes of the hand,
xi = [V; Omega]. With y = z' + Omega x z on the nodes, u = V + Omega x r + y, and

    P = int rho u,             L = int rho (r + z) x u  about the reference point, the linear and angular momentum
    [P; L] = (M_hand + M_rigid) xi + G'y + [0; m x V + tr(B) Omega - B'Omega + int rho z x y]
    m = int rho z,        B_kl = int rho z_k r_l = S_kl'z,          S_kl = int rho phi_k r_l  (d^2 numbers a mode)

The load of a turning frame on z is -G [A - g; Omega'] - sum_kl S_kl (W^2)_kl with W the matrix of Omega x; what is
linear in z needs no integral of its own, since the mass matrix of the nodes commutes with rotations of all nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.frame.rotation import cross_matrix, freedoms, spatial
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array


@dataclass(frozen=True)
class FrameIntegrals:
    """First moments of the shape functions about the reference point, by layer at density 1."""

    parts: tuple[Array, ...]  # int phi_k r_l of each layer, local rows (n_local, d^2), column k d + l [m^(d+1)]

    def moments(self, materials: tuple[LayerMaterial, ...]) -> Array:
        """S = int rho phi_k r_l, local rows (n_local, d^2) [kg m]."""
        layers = materials[: len(self.parts)]  # own terms come behind
        return np.asfortranarray(sum(m.rho * part for m, part in zip(layers, self.parts, strict=True)))


def crossed(x: Array, y: Array, d: int) -> Array:
    """Sum over the nodes of x x y, rows blocked by node (d n,), as in space (3,)."""
    a, b = x.reshape(-1, d), y.reshape(-1, d)
    C = a.T @ b
    if d == 2:
        return np.array([0.0, 0.0, C[0, 1] - C[1, 0]])
    return np.array([C[1, 2] - C[2, 1], C[2, 0] - C[0, 2], C[0, 1] - C[1, 0]])


def square(x: Array, d: int) -> Array:
    """d^2 numbers as a matrix in space, (3, 3)."""
    full = np.zeros((3, 3))
    full[:d, :d] = x.reshape(d, d)
    return full


@dataclass(frozen=True)
class Sums:
    """What a state of the tissue contributes to the momenta, summed over all nodes; vectors in space."""

    drift: Array  # G'y, (6,) [kg m/s, kg m2/s]
    first: Array  # int rho z, (3,) [kg m]
    B: Array  # int rho z_k r_l, (3, 3) [kg m2]
    turning: Array  # int rho z x y, (3,) [kg m2/s]

    @staticmethod
    def of(row: Array, n_s: int) -> Sums:
        """From a row of numbers [G'y, int rho z, B, int rho z x y], see :func:`row_length`."""
        d = 2 if n_s == 3 else 3
        drift, first, B, turning = np.split(row[: row_length(n_s)], np.cumsum([n_s, d, d * d]))
        m = np.zeros(3)
        m[:d] = first
        t = np.zeros(3)
        t[6 - n_s if d == 3 else 2 :] = turning
        return Sums(spatial(drift), m, square(B, d), t)

    def momenta(self, M: Array, xi: Array) -> Array:
        """[P; L] (6,) [kg m/s, kg m2/s] for M = M_hand + M_rigid in space, (6, 6), and xi = [V; Omega] (6,)."""
        V, spin = xi[:3], xi[3:]
        result = M @ xi + self.drift
        result[3:] += cross_matrix(self.first) @ V + np.trace(self.B) * spin - self.B.T @ spin + self.turning
        return np.asarray(result)


def row_length(n_s: int) -> int:
    """Numbers in a row of :class:`Sums`: n_s + d + d^2 and one for each turn."""
    d = 2 if n_s == 3 else 3
    return n_s + d + d * d + (n_s - d)


def in_space(M: Array) -> Array:
    """A matrix of the hand's degrees of freedom in space, (6, 6)."""
    if len(M) == 6:
        return np.asarray(M, dtype=float)
    full = np.zeros((6, 6))
    full[np.ix_(freedoms(2), freedoms(2))] = M
    return full


def coadjoint(xi: Array) -> Array:
    """The matrix of ad* with P' = P x Omega, L' = L x Omega + P x V for [P; L]' = ad* [P; L], (6, 6)."""
    V, W = cross_matrix(xi.reshape(2, 3))
    full = np.zeros((6, 6))
    full[:3, :3] = full[3:, 3:] = -W
    full[3:, :3] = -V
    return full


def turned_momentum(momenta: Array) -> Array:
    """The matrix of xi -> ad*(xi) [P; L] for given momenta (6,), (6, 6)."""
    P, L = cross_matrix(momenta.reshape(2, 3))
    full = np.zeros((6, 6))
    full[:3, 3:] = full[3:, :3] = P
    full[3:, 3:] = L
    return full
