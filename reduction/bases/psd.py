"""Proper symplectic decompositions: complex SVD, cotangent lift, SVD-like, in canonical coordinates (q, p).

V is symplectic: V' J V = J. In a weighted inner product A (mass or stiffness) everything is done for q~ = sqrt(c) q and
y~ = A^-1 p / sqrt(c), both measured in A; the map (q, p) -> (L' q~, L' y~), A = L L', is canonical, so that

    V_q = E_q / sqrt(c),  V_p = sqrt(c) A E_y

is symplectic again, and orthonormal in blkdiag(c A, A^-1 / c) when E is in blkdiag(A, A). The paper's variant does the
same on (q, v) with y = v, c = 1, and V_v = E_y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.reduction.bases.engines import magnitude, numerical_rank, small_svd
from softgrasp.reduction.bases.inner import Rows, Weight, weights
from softgrasp.reduction.bases.pod import PartsRequest
from softgrasp.reduction.bases.stack import Stack, cholesky_of
from softgrasp.reduction.bases.states import BasisError, Columns
from softgrasp.reduction.bases.svd_like import svd_like_pairs, symplectic_repair
from softgrasp.reduction.bases.truncation import Part


@dataclass(frozen=True)
class Canonical:
    """Snapshots q~ and y~ in the columns of one A-orthonormal basis, those of the stack [q~, y~]."""

    stack: Stack  # rows of one half, with the snapshots side by side
    C_q: Array  # coordinates of q~, (r, m), on every rank
    C_y: Array  # coordinates of y~, (r, m), on every rank
    rate: float  # c
    scale: float  # power of two divided out of the snapshots
    momenta: bool  # whether V_p needs the factor A (canonical coordinates)

    @property
    def rows(self) -> Rows:
        """Order in which the rows of one half are stacked."""
        return self.stack.rows

    @property
    def by(self) -> Weight | None:
        """The weight A, or None."""
        return self.stack.by

    def vectors(self, C: Array) -> Array:
        """Local rows of the vectors with coordinates C."""
        return self.stack.vectors(C)

    def weigh(self, X: Array) -> Array:
        """A X. Collective."""
        return self.rows.weigh(X, self.by)

    def place(self, E_q: Array, E_y: Array) -> Columns:
        """Columns of V from q~ and y~ rows. Collective."""
        root = self.rate**0.5
        s_q, e_q = self.rows.split(E_q / root if root != 1.0 else E_q)
        E_p = self.weigh(E_y) if self.momenta else E_y
        s_p, e_p = self.rows.split(E_p * root if root != 1.0 else E_p)
        return Columns(s_q, s_p, e_q, e_p)


def canonical(request: PartsRequest) -> Canonical:
    """Factor [q~, y~] once, as real columns side by side: no Gram matrix, no complex arithmetic. Collective.

    Raises BasisError: all snapshots are zero.
    """
    b, system = request.snapshots, request.states.system
    rows, m = Rows(system.layout, request.hand), b.e_q.shape[1]
    both = weights(system, request.inner)
    by = None if both is None else both[0]
    momenta = request.coordinates == "qp"
    scale = magnitude(system.layout.comm, b.s_q, b.s_p, b.e_q, b.e_p)
    s_p = b.s_p if by is None or not momenta else np.linalg.solve(by.hand, b.s_p / scale) * scale

    def tissue() -> Array:
        Z = np.empty((system.layout.n_local, 2 * m), order="F")
        Z[:, :m] = b.e_q
        Z[:, m:] = b.e_p
        Z /= scale
        if by is not None and momenta:
            Z[:, m:] = solve_columns(by.tissue, system.layout, Z[:, m:])
        return Z

    stack = request.stack("canonical", rows, np.hstack([b.s_q, s_p]) / scale, tissue, by)
    if not stack.R.any():
        raise BasisError("all snapshots are zero; there is nothing to build a basis from")
    C, rate = stack.orthonormal, 1.0
    C_q, C_y = C[:, :m], C[:, m:]
    if by is not None and momenta:
        q, y = (float(np.linalg.norm(part)) for part in (C_q, C_y))
        rate = y / q if q > 0 and y > 0 else 1.0  # of all snapshots in A
        C_q, C_y = C_q * rate**0.5, C_y / rate**0.5
    return Canonical(stack, C_q, C_y, rate, scale * stack.scale, momenta)


def complex_svd_parts(request: PartsRequest) -> tuple[Part, ...]:
    """PSD complex SVD [PM16, Algorithm 2]: q + i p = E S C^H, V = [Re E, -Im E; Im E, Re E].

    V' V = I and V' J V = J at once (orthosymplectic); span of V is that of the leading left singular vectors of
    Y = [X, J X] [SBRH21], where every singular value comes twice. With fixed solid modes V = blkdiag(I, V_e), I of
    order 2 n_s for the hand, V_e the same of the tissue's rows. Collective.
    """
    c = canonical(request)
    comm = request.states.layout.comm
    u, s, _ = small_svd(comm, c.C_q + 1j * c.C_y)

    def columns(k: int) -> tuple[Columns, ...]:
        E_r, E_i = c.vectors(np.ascontiguousarray(u[:, :k].real)), c.vectors(np.ascontiguousarray(u[:, :k].imag))
        if c.by is not None and k:
            W_r, W_i = c.weigh(E_r), c.weigh(E_i)
            g = total(comm, np.array([E_r.T @ W_r + E_i.T @ W_i, E_r.T @ W_i - E_i.T @ W_r]))
            fix = np.linalg.inv(cholesky_of(comm, g[0] + 1j * g[1]).conj().T)
            E_r, E_i = E_r @ fix.real - E_i @ fix.imag, E_r @ fix.imag + E_i @ fix.real
        return c.place(E_r, E_i), c.place(-E_i, E_r)

    return (_part("phase space", c, s, columns),)


def cotangent_lift_parts(request: PartsRequest) -> tuple[Part, ...]:
    """PSD cotangent lift [PM16, Algorithm 1]: Phi = POD_k([q, p]), V = blkdiag(Phi, Phi).

    Phi' Phi = I, so that V' V = I and V' J V = J; weighted, V = blkdiag(Phi / sqrt(c), sqrt(c) A Phi) with
    Phi' A Phi = I. Collective.
    """
    c = canonical(request)
    comm = request.states.layout.comm
    u, s, _ = small_svd(comm, np.hstack([c.C_q, c.C_y]))

    def columns(k: int) -> tuple[Columns, ...]:
        Phi = c.vectors(u[:, :k])
        if c.by is not None and k:
            Phi = Phi @ np.linalg.inv(cholesky_of(comm, total(comm, Phi.T @ c.weigh(Phi))).T)
        zero = np.zeros_like(Phi)
        return c.place(Phi, zero), c.place(zero, Phi)

    return (_part("phase space", c, s, columns),)


def svd_like_parts(request: PartsRequest) -> tuple[Part, ...]:
    """PSD SVD-like decomposition [BBH19, Algorithm 1]: X = S D Q with S symplectic, the pairs of largest weight.

    V' J V = J; V is not orthonormal. Directions without a well-conditioned partner in the snapshots get one from
    outside, see :func:`softgrasp.reduction.bases.svd_like.svd_like_pairs`. The two columns of a pair are balanced to
    equal norm and pairs are ordered by w_k = sigma_k sqrt(|s_k|^2 + |s_n+k|^2), in the inner product, for which
    |X|_F^2 = sum w_k^2. Collective.
    """
    c = canonical(request)
    comm = request.states.layout.comm
    S, w = svd_like_pairs(comm, np.vstack([c.C_q, c.C_y]), (request.count or 0) // 2, request.share)
    r, half = c.C_q.shape[0], S.shape[1] // 2

    def columns(k: int) -> tuple[Columns, ...]:
        pairs = (S[:, :k], S[:, half : half + k])
        E_q, E_y = (c.vectors(np.hstack(part)) for part in ([P[:r] for P in pairs], [P[r:] for P in pairs]))
        W_y = c.weigh(E_y) if c.momenta else E_y
        B = total(comm, E_q.T @ W_y)
        if c.momenta or c.by is None:
            # products with Q and A leave rounding times |s|^2
            C = on_root(comm, lambda: symplectic_repair(B - B.T))
            E_q, E_y = E_q @ C, E_y @ C
        return c.place(E_q[:, :k], E_y[:, :k]), c.place(E_q[:, k:], E_y[:, k:])

    total_square = float(np.sum(c.C_q**2) + np.sum(c.C_y**2))
    return (Part("phase space", w, total_square, numerical_rank(w), columns, c.scale, c.rate),)


def _part(title: str, c: Canonical, s: Array, columns: Callable[[int], tuple[Columns, ...]]) -> Part:
    return Part(title, s, float(np.sum(s**2)), numerical_rank(s, c.stack.factor.noise), columns, c.scale, c.rate)
