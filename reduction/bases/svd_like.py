"""SVD-like decomposition of a small dense matrix, by deflation so that small pairs keep their digits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.petsc import Array, on_root
from softgrasp.reduction.bases.engines import EPS, SNAPSHOT_ROUNDING
from softgrasp.reduction.bases.states import BasisError

# eigenvalues of X'JX carry an absolute error eps * |X|^2: a stage uses those that keep about ten digits
STAGE = 1e-6
# V'JV = J can be true to about eps |s|^2 only: vectors that are almost J-orthogonal make no pair with each other
LONGEST = 200.0  # |s|^2 + |t|^2
# |U'JU| |T'JT| up to which directions U without partner are used together: at 1 [U T] may have no symplectic polar
# factor, and what then grew left infinite remainders
BENT = 0.1
DROP = 0.1  # directions without partner are used together down to this share of the largest


def apply_j(Y: Array) -> Array:
    """J Y for rows (q; p), J = [0 I; -I 0]."""
    q, p = np.split(Y, 2)
    return np.vstack([p, -q])


def symplectic_form(X: Array, Y: Array) -> Array:
    """X' J Y."""
    return X.T @ apply_j(Y)


def svd_like_pairs(
    comm: MPI.Intracomm, X: Array, limit: int | None = None, share: float | None = None
) -> tuple[Array, Array]:
    """Symplectic S = [s_1 .. s_k, t_1 .. t_k] that spans X, ordered by the weight of the pairs. Collective.

    X = S D Q with orthogonal Q; D has sigma_i twice for every hyperbolic pair, +-i sigma_i^2 the eigenvalues of the
    skew matrix X'JX, and 1 for directions that have no partner in X [BBH19]. One eigenvalue problem loses every pair
    below sqrt(eps) sigma_1, so each stage uses only the large ones, and the next works on X - S S^+ X with the
    symplectic inverse S^+ = J' S' J; the stages together are the same decomposition. A direction u without partner
    in X gets the one that is J-orthogonal to all others, t = (I - S S^+) J' u.

    Args:
        comm: ranks, all with the same X.
        X: rows (q; p), shape (2 r, m).
        limit: number of pairs that are enough; None for all.
        share: part of |X|_F^2 that may be left out beyond the ``limit``; None sets no goal.

    Returns S (2 r, 2 k), S' J S = J, and w (k,) descending; sum w^2 = |X|_F^2 when all are used and have partners.
    """
    return on_root(comm, lambda: _pairs(X, limit, share))


def _pairs(X: Array, limit: int | None, share: float | None) -> tuple[Array, Array]:
    # q and p of equal size lose the fewest digits; (q / t, p t) is canonical
    r = len(X) // 2
    q, p = np.linalg.norm(X[:r]), np.linalg.norm(X[r:])
    ratio = float(q / p) ** 0.5 if q > 0 and p > 0 else 1.0
    units = np.repeat([ratio, 1 / ratio], r)[:, None]
    pool = _PairSelection(X / units, lambda Y: np.linalg.norm(units * Y, axis=0))
    pool.collect(limit, share)
    S, T = balanced(units * pool.S, units * pool.T)
    order = np.argsort(-pool.weights, kind="stable")
    # a pair not looked for may outweigh the lightest that were found
    order = order[pool.weights[order] > pool.unseen]
    return np.hstack([S[:, order], T[:, order]]), pool.weights[order]


class _PairSelection:
    """Symplectic pairs found so far, and the rest of X that they leave.

    Attributes:
        norms: Euclidean norm of each column in the units of X.
        S: first vectors of the pairs, (2 r, pairs).
        T: second vectors of the pairs, (2 r, pairs).
        weights: contribution of each pair to |X|_F, (pairs,).
        rest: columns that span X - S S^+ X, U diag(s) by its singular value decomposition.
        size: largest singular value of the rest.
        largest: largest singular value of X.
        square: |X|_F^2 in the units of X.
    """

    def __init__(self, X: Array, norms: Callable[[Array], Array]) -> None:
        self.norms = norms
        self.S: Array = np.zeros((len(X), 0))
        self.T: Array = np.zeros((len(X), 0))
        self.weights: Array = np.zeros(0)
        self.largest = 0.0
        self.unseen = 0.0  # largest possible weight of pairs that were not looked for
        self.square = float(np.sum(norms(X) ** 2))
        self._compress(X)
        self.largest = self.size

    def _compress(self, rest: Array) -> None:
        """Set rest, U, s and size to the few columns that span the same space; X'JX is rotated only."""
        U, s, _ = np.linalg.svd(rest, full_matrices=False)
        keep = s > max(EPS * s[0], 0.01 * SNAPSHOT_ROUNDING * self.largest) if len(s) else s > 0
        self.U, self.s = U[:, keep], s[keep]
        self.rest = self.U * self.s
        self.size = float(self.s[0]) if keep.any() else 0.0

    def collect(self, limit: int | None, share: float | None) -> None:
        """Find pairs until the rest is rounding, or until no later pair can be among those that are wanted."""
        while 2 * self.S.shape[1] < len(self.S):
            left = float(np.linalg.norm(self.norms(self.rest)))
            if limit is not None and self._enough(limit, share, left):
                self.unseen = left
                break
            if len(self.weights):
                self._compress(self.rest)
            if not self.size > SNAPSHOT_ROUNDING * self.largest:
                break
            if not self._stage():
                self._alone()
        # what the stages lost to each other
        pair = _symplectic(np.hstack([self.S, self.T]))
        self.S, self.T = np.hsplit(pair, 2)

    def _enough(self, limit: int, share: float | None, unseen: float) -> bool:
        """Whether the heaviest ``limit`` pairs, or as many as leave ``share`` of the energy, are among those found."""
        heaviest = np.sort(self.weights)[::-1]
        if share is not None:
            dropped = self.square - np.cumsum(heaviest**2)
            limit = max(limit, 1 + int(np.count_nonzero(dropped > share * self.square)))
        return len(heaviest) >= max(limit, 1) and unseen < heaviest[max(limit, 1) - 1]

    def _stage(self) -> bool:
        """Add the hyperbolic pairs of the rest that are large and well conditioned; whether there were any."""
        B = symplectic_form(self.rest, self.rest)
        # i B is Hermitian; for an eigenvalue lambda > 0, u = (b + i a) / sqrt(2) gives a'Bb = lambda, a, b orthonormal
        # +-lambda come in pairs, so that the largest is at least |B|_F / sqrt(columns): vectors of fewer are made
        least = STAGE * float(np.linalg.norm(B)) / max(len(B), 1) ** 0.5
        values, vectors = scipy.linalg.eigh(1j * (B - B.T) / 2, subset_by_value=(least, np.inf))
        if not len(values):
            return False
        pick = values > max(STAGE * values[-1], 100 * EPS * self.size**2)
        values, vectors = values[pick][::-1], np.sqrt(2) * vectors[:, pick][:, ::-1]
        sigma = np.sqrt(values)
        S, T = self.rest @ (vectors.imag / sigma), self.rest @ (vectors.real / sigma)
        good = np.sum(S**2, axis=0) + np.sum(T**2, axis=0) <= LONGEST
        if not good.any():
            return False
        S, T = np.hsplit(_symplectic(np.hstack([S[:, good], T[:, good]])), 2)
        self._add(S, T, sigma[good] * np.hypot(self.norms(S), self.norms(T)))
        return True

    def _alone(self) -> None:
        """Add the largest directions of the rest, almost J-orthogonal to each other, with partners from outside."""
        room = (len(self.S) - 2 * self.S.shape[1]) // 2
        k = min(int(np.count_nonzero(self.s > DROP * self.size)), room)
        U, s = self.U[:, :k], self.s[:k]
        T = -apply_j(U)  # J' U, for which U'JT = U'U = I
        for _ in range(2):
            T = self._complement(T)
        bent = symplectic_form(T, T)
        if np.linalg.norm(symplectic_form(U, U)) * np.linalg.norm(bent) > BENT:
            U, T, s, bent = U[:, :1], T[:, :1], s[:1], bent[:1, :1]
        T = T + U @ bent / 2  # now T'JT = 0 up to U'JU
        S, T = np.hsplit(_symplectic(np.hstack([U, T])), 2)
        self._add(S, T, s * self.norms(U))

    def _add(self, S: Array, T: Array, weights: Array) -> None:
        self.S, self.T = np.hstack([self.S, S]), np.hstack([self.T, T])
        self.weights = np.concatenate([self.weights, weights])
        rest = self.rest
        for _ in range(2):  # the second pass removes the rounding of the first
            rest = self._complement(rest)
        self.rest = rest

    def _complement(self, Y: Array) -> Array:
        """(I - S S^+) Y."""
        return Y - self.T @ symplectic_form(self.S, Y) + self.S @ symplectic_form(self.T, Y)


def symplectic_repair(B: Array) -> Array:
    """C = (J^-1 B)^(-1/2) with C' B C = J for a skew B near J: S C is symplectic when S' J S = B.

    Raises BasisError: B is singular, far from J.
    """
    try:
        return np.linalg.inv(np.real(scipy.linalg.sqrtm(-apply_j(B))))
    except np.linalg.LinAlgError as error:
        raise BasisError(
            "SVD-like pairs of these snapshots are linearly dependent to rounding; use a smaller N or another basis"
        ) from error


def _symplectic(S: Array) -> Array:
    """Nearest symplectic columns, the symplectic polar factor."""
    k = S.shape[1] // 2
    J = np.eye(2 * k, k=k) - np.eye(2 * k, k=-k)
    for _ in range(3):
        B = symplectic_form(S, S)
        if np.abs(B - J).max(initial=0.0) < 4 * EPS:
            break
        S = S @ symplectic_repair(B)
    return S


def balanced(S: Array, T: Array) -> tuple[Array, Array]:
    """Rotate every pair (s, t) so that |s| = |t|; s'Jt and the span stay.

    s cos + t sin and -s sin + t cos have equal norms when tan(2 phi) = (|s|^2 - |t|^2) / (-2 s't).
    """
    difference = np.sum(S**2, axis=0) - np.sum(T**2, axis=0)
    phi = 0.5 * np.arctan2(difference, -2 * np.sum(S * T, axis=0))
    return S * np.cos(phi) + T * np.sin(phi), T * np.cos(phi) - S * np.sin(phi)
