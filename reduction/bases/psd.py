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
import scipy.linalg

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.reduction.bases.engines import Factor, magnitude, numerical_rank, small_svd
from softgrasp.reduction.bases.inner import Rows, Weight, weights
from softgrasp.reduction.bases.pod import PartsRequest, cholesky_of, weighted_factor
from softgrasp.reduction.bases.states import Columns
from softgrasp.reduction.bases.svd_like import svd_like_pairs, symplectic_repair
from softgrasp.reduction.bases.truncation import Part


@dataclass(frozen=True)
class Canonical:
    """Snapshots q~ = Q L^-T C_q and y~ = Q L^-T C_y in the columns of one A-orthonormal basis."""

    rows: Rows  # order in which the rows of one half are stacked
    by: Weight | None  # the weight A, or None
    factor: Factor  # Q and R = [R_q, R_y]
    inverse: Array | None  # L^-T, or None
    C_q: Array  # coordinates of q~, (r, m), on every rank
    C_y: Array  # coordinates of y~, (r, m), on every rank
    rate: float  # c
    scale: float  # power of two divided out of the snapshots
    momenta: bool  # whether V_p needs the factor A (canonical coordinates)

    def vectors(self, C: Array) -> Array:
        """Q L^-T C, local rows."""
        return np.asfortranarray(self.factor.Q @ (C if self.inverse is None else self.inverse @ C))

    def weigh(self, X: Array) -> Array:
        """A X. Collective."""
        return self.rows.weigh(X, None if self.by is None else (self.by,))

    def place(self, E_q: Array, E_y: Array) -> Columns:
        """Columns of V from q~ and y~ rows. Collective."""
        root = self.rate**0.5
        ((s_q, e_q),) = self.rows.split(E_q / root if root != 1.0 else E_q)
        E_p = self.weigh(E_y) if self.momenta else E_y
        ((s_p, e_p),) = self.rows.split(E_p * root if root != 1.0 else E_p)
        return Columns(s_q, s_p, e_q, e_p)


def canonical(request: PartsRequest) -> Canonical:
    """Factor [q~, y~] once, as real columns side by side: no Gram matrix, no complex arithmetic. Collective."""
    b, system = request.snapshots, request.states.system
    rows, m = Rows(system.layout, 1, request.hand), b.e_q.shape[1]
    both = weights(system, request.inner)
    by = None if both is None else both[0]
    momenta = request.coordinates == "qp"
    comm = system.layout.comm
    scale = magnitude(comm, b.s_q, b.s_p, b.e_q, b.e_p) if request.hand else magnitude(comm, b.e_q, b.e_p)
    Z = np.empty((rows.local, 2 * m), order="F")
    rows.fill(Z[:, :m], 0, b.s_q, b.e_q)
    if by is not None and momenta:
        hand = np.linalg.solve(by.hand, b.s_p / scale)
        rows.fill(Z[:, m:], 0, hand, solve_columns(by.tissue, system.layout, b.e_p / scale))
        Z[:, m:] *= scale
    else:
        rows.fill(Z[:, m:], 0, b.s_p, b.e_p)
    Z /= scale
    rate = 1.0
    if by is not None and momenta:
        rate = _rate(rows, Z, by, m)
        Z[:, :m] *= rate**0.5
        Z[:, m:] /= rate**0.5
    f, L = weighted_factor(rows, Z, None if by is None else (by,), request.engine)
    inverse = None if L is None else scipy.linalg.solve_triangular(L.T, np.eye(len(L)))
    C = f.R if L is None else L.T @ f.R
    return Canonical(rows, by, f, inverse, C[:, :m], C[:, m:], rate, scale * f.scale, momenta)


def _rate(rows: Rows, Z: Array, by: Weight, m: int) -> float:
    """Rate c = |y|_A / |q|_A over all snapshots; 1 when one of them is zero. Collective."""
    W_Z = rows.weigh(Z, (by,))
    squares = np.array([np.vdot(Z[:, :m], W_Z[:, :m]), np.vdot(Z[:, m:], W_Z[:, m:])])
    q, y = np.sqrt(np.maximum(total(rows.layout.comm, squares), 0.0))
    return float(y / q) if q > 0 and y > 0 else 1.0


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
    return Part(title, s, float(np.sum(s**2)), numerical_rank(s, c.factor.noise), columns, c.scale, c.rate)
