"""Sampled cells of a body and the reduced energy they carry, W_r(a) = sum_q weight_q W(I + B_q a; lambda_q, mu_q).

With weight_q = xi vol_q >= 0, xi of its cell, W_r is a sum of the law's own energies: bounded below with it, affine in
lambda and mu as the whole body is, and its discrete gradient is the sum of theirs. xi = 1 in every cell is Galerkin's
model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from mpi4py import MPI

from softgrasp.fem.compiled import LANES
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.strain.laws import LAWS, Start

BLOCK = 1 << 20  # entries of H at a time


@dataclass(frozen=True)
class Cells:
    """Points of some cells in reduced coordinates."""

    law: str  # name of the law of the material
    B: Array  # grad z = B_q a, (k, d, d, q)
    weight: Array  # xi vol [m^d], (q,)
    xi: Array  # weight of the point's cell, (q,)
    layer: np.ndarray  # layer of the point's material, (q,)
    cell: np.ndarray  # number of the cell among those of this rank, or of the body once they are gathered, (q,)
    centre: Array  # centre of the point's cell [m], (q, d)

    @property
    def count(self) -> int:
        """Number of cells."""
        return len(np.unique(self.cell))

    def sampled(self, xi: Array) -> Cells:
        """The points of cells with xi > 0, their weights multiplied; xi by the number of the cell."""
        keep = np.flatnonzero(xi[self.cell] > 0)
        return replace(
            self,
            B=np.ascontiguousarray(self.B[..., keep]),
            weight=self.weight[keep] * xi[self.cell[keep]],
            xi=self.xi[keep] * xi[self.cell[keep]],
            layer=self.layer[keep],
            cell=self.cell[keep],
            centre=self.centre[keep],
        )

    def leading(self, k: int) -> Cells:
        """In the first k coordinates: bases are nested."""
        return replace(self, B=np.ascontiguousarray(self.B[:k]))


class Potential:
    """W_r and its derivatives at one set of materials.

    ``comm``: ranks whose cells are summed up; None where every rank has all of them.
    """

    def __init__(self, cells: Cells, materials: tuple[LayerMaterial, ...], comm: MPI.Intracomm | None = None) -> None:
        self.cells, self.comm, self.law = cells, comm, LAWS[cells.law]
        self.lam = np.array([m.lam for m in materials])[cells.layer]
        self.mu = np.array([m.mu for m in materials])[cells.layer]
        self.k, self.d = cells.B.shape[0], cells.B.shape[1]
        self._rows = cells.B.reshape(self.k, -1)
        self._start: Start | None = None

    def _sum(self, x: Array) -> Array:
        return x if self.comm is None else np.asarray(self.comm.bcast(total(self.comm, x)))

    @cached_property
    def rounding(self) -> float:
        """What rounding in the stress mu F leaves of a force, in the norm of all coordinates. Collective."""
        sizes = self._sum(np.abs(self.cells.B).sum(axis=(1, 2)) @ (self.cells.weight * self.mu))
        return float(2 * np.finfo(float).eps * np.linalg.norm(sizes))

    def gradient(self, a: Array) -> Array:
        """H = B a, (d, d, q)."""
        return np.asarray(a @ self._rows).reshape(self.d, self.d, -1)

    def energy(self, a: Array) -> Array:
        """W_r [J] of coordinates (m, k), (m,)."""
        q, m = len(self.cells.weight), len(a)
        W, width = np.zeros(m), max(1, BLOCK // max(self.d**2 * q, 1))
        for first in range(0, m, width):
            part = a[first : first + width]
            H = np.moveaxis((part @ self._rows).reshape(len(part), self.d, self.d, q), 0, -1)
            repeated = [np.repeat(x, len(part)) for x in (self.lam, self.mu)]
            with np.errstate(invalid="ignore", divide="ignore"):
                density = self.law.energy(H.reshape(self.d, self.d, -1), *repeated).reshape(q, -1)
            W[first : first + width] = self.cells.weight @ density
        return self._sum(W)

    def _states(self, a: Array) -> tuple[Array, Array, Array]:
        """H (d, d, m q) of coordinates (m, k), the points of a state side by side, with lam and mu (m q,)."""
        H = (a @ self._rows).reshape(len(a), self.d, self.d, -1).transpose(1, 2, 0, 3)
        return H.reshape(self.d, self.d, -1), np.tile(self.lam, len(a)), np.tile(self.mu, len(a))

    def forces(self, a: Array) -> Array:
        """dW_r / da of coordinates (m, k) at once, (m, k)."""
        return self._pulled(self.law.stress(*self._states(a)), len(a))

    def discrete_forces(self, a: Array, w: Array) -> Array:
        """f_alg of steps from a to a + 2 w, (m, k) each, at once, (m, k); infinite where a point of any has J <= 0."""
        H, lam, mu = self._states(a)
        P, _ = self.law.step(self.law.start(H), self._states(w)[0], lam, mu)
        if P is None:
            return np.full_like(a, np.inf)
        return self._pulled(P, len(a))

    def _pulled(self, P: Array, m: int) -> Array:
        """B' P of every state from the stress of :meth:`_states`, (m, k)."""
        P = P.reshape(self.d, self.d, m, -1) * self.cells.weight
        return self._sum(P.transpose(2, 0, 1, 3).reshape(m, -1) @ self._rows.T)

    def tangents(self, a: Array) -> Array:
        """d^2 W_r / da^2 of coordinates (m, k) at once, (m, k, k)."""
        n = self.d**2
        A = self.law.tangent(*self._states(a)).reshape(n, n, len(a), -1) * self.cells.weight
        B = np.ascontiguousarray(self._rows.reshape(self.k, n, -1).transpose(2, 1, 0))  # (q, n, k)
        stiff = A.transpose(2, 3, 0, 1) @ B  # products of matrices, which einsum has none of here
        return self._sum(B.reshape(-1, self.k).T @ stiff.reshape(len(a), -1, self.k))

    def weighted_stress(self, a: Array) -> Array:
        """Stress times its weight, xi vol P(I + B a), (d, d, q)."""
        return np.asarray(self.cells.weight * self.law.stress(self.gradient(a), self.lam, self.mu))

    def force(self, a: Array) -> Array:
        """dW_r / da [N in the coordinates], (k,)."""
        return np.asarray(self.forces(a[None])[0])

    def tangent(self, a: Array) -> Array:
        """d^2 W_r / da^2, (k, k)."""
        return np.asarray(self.tangents(a[None])[0])

    def begin(self, a: Array) -> None:
        """Start a step at a."""
        with np.errstate(invalid="ignore", divide="ignore"):
            self._start = self.law.start(self.gradient(a))

    def discrete(self, w: Array) -> tuple[Array | None, int]:
        """f_alg of the step from a to a + 2 w, (k,), and -1; or None and a point with J <= 0."""
        assert self._start is not None  # begin() comes first
        with np.errstate(invalid="ignore", divide="ignore"):
            P, J = self.law.step(self._start, self.gradient(w), self.lam, self.mu)
        if self.comm is not None and self.comm.allreduce(P is None, MPI.LOR):
            return None, -1 if P is not None else int(np.argmin(J))
        if P is None:
            return None, int(np.argmin(J))
        return self._sum(self._rows @ (self.cells.weight * P).ravel()), -1

    @cached_property
    def packed(self) -> tuple[Array, Array, Array, Array]:
        """B (p / LANES, k, d d, LANES), weight, lam, mu (p,) for `stepper.c`; what fills up p weighs nothing."""
        q = len(self.cells.weight)
        p = -(-q // LANES) * LANES

        def padded(x: Array) -> Array:
            return np.ascontiguousarray(np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, p - q)]))

        B = padded(self.cells.B.reshape(self.k, self.d**2, q)).reshape(self.k, self.d**2, -1, LANES)
        B = np.ascontiguousarray(B.transpose(2, 0, 1, 3))
        return B, padded(self.cells.weight), padded(self.lam), padded(self.mu)
