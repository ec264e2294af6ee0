"""Cholesky of one matrix by several ranks: each eliminates the nodes of its own part, all share what separates them.

With I the nodes of a rank that have no neighbour on a higher rank, and G all other nodes, the separator,

    Sigma = S_GG - sum over ranks of C,   C = S_GI S_II^-1 S_IG,
    Sigma w_G = r_G - sum over ranks of S_GI S_II^-1 r_I,   S_II w_I = r_I - S_IG w_G.

A solve is a forward sweep on each rank, one sum of as many numbers as G has rows, a dense solve on every rank and a
backward sweep; each rank reads the factor of its own part. The sums have a fixed order: a run repeats its bits.

Each rank factors [S_II, S_IG; S_GI, C + t I], which leaves t I on G: its forward sweep from [r_I; 0] ends there with
-S_GI S_II^-1 r_I / t, and its backward sweep may begin there with w_G [GL81].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.petsc import Array, PETSc, to_scipy, total, user_options
from softgrasp.fem.solve.cholesky import BACKWARD_ERROR, backward_error, make_ksp, nested_dissection, rows_of

INDEFINITE = "cholesky: the factorisation of the tissue matrix failed; it is not definite: check material and mesh"


class SplitFactor:
    """Solves S w = r for distributed vectors.

    Args:
        S: symmetric positive definite, d rows a node, on two ranks or more.
        prefix: of the options of each rank's solver.
        d: rows of a node.

    Attributes:
        ksp: solver of this rank's part.
        top: lower Cholesky factor of Sigma.

    Collective. Raises SolverError: S is not definite.
    """

    def __init__(self, S: PETSc.Mat, prefix: str, d: int) -> None:
        self.comm, first = S.comm.tompi4py(), S.getOwnershipRange()[0] // d
        rows = to_scipy(S)
        inner, own = _divided(rows.tobsr((d, d)), first)
        G = rows_of(np.concatenate(self.comm.allgather(own + first)), d)
        self.inner, self.own = rows_of(inner, d), rows_of(own, d)
        self.mine = np.searchsorted(G, self.own + first * d)  # places of this rank's rows of the separator
        outer = rows[self.inner][:, G]
        self.touched = rows_of(np.unique(outer.indices // d), d)  # of those that its part has for neighbours
        sigma = np.zeros((len(G), len(G)))
        sigma[self.mine] = rows[self.own][:, G].toarray()
        sigma, at = total(self.comm, sigma), np.ix_(self.touched, self.touched)
        with raise_on_all_ranks(self.comm):
            parts = rows[self.inner][:, self.inner + first * d], outer[:, self.touched]
            C = _eliminated(*parts, sigma[at])
            self.t = float(np.abs(sigma.diagonal()).max(initial=1.0))
            self.ksp = _factored(_bordered(*parts, C + self.t * np.eye(len(C))), prefix, d)
        share = np.zeros_like(sigma)
        share[at] = C
        sigma -= total(self.comm, share)
        from scipy.linalg.lapack import dpotrf, dpotrs  # slow to import, and for ranks in 2D alone

        self.top, failed = dpotrf(sigma, lower=1)
        if failed:  # on every rank alike
            raise SolverError(INDEFINITE)
        self.dpotrs = dpotrs
        self.factor = self.ksp.getPC().getFactorMatrix()
        self.r, self.w = self.factor.createVecs()
        self.sum, self.share = np.zeros(len(G)), np.zeros(len(G))

    def solve(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Solve S w = r. Collective."""
        rows, n = r.array_r, len(self.inner)
        right = self.r.array_w
        rows.take(self.inner, 0, right[:n], "clip")  # "raise" would copy
        right[n:] = 0.0
        self.factor.solveForward(self.r, self.w)
        swept = self.w.array_w
        self.share[:] = 0.0
        self.share[self.touched] = self.t * swept[n:]
        self.share[self.mine] += rows[self.own]
        self.comm.Allreduce(self.share, self.sum)
        solved, _ = self.dpotrs(self.top, self.sum, lower=1)
        swept[n:] = solved[self.touched]
        self.factor.solveBackward(self.w, self.r)
        result = w.array_w
        result[self.inner], result[self.own] = self.r.array_r[:n], solved[self.mine]

    def destroy(self) -> None:
        """Free the vectors."""
        self.r.destroy()
        self.w.destroy()


def split_factor(S: PETSc.Mat, prefix: str, d: int) -> SplitFactor | None:
    """The factor with a subtree on each rank; None where the user gave options, or blocks lose digits. Collective.

    Raises SolverError: S is not definite; it is freed.
    """
    if user_options(prefix):
        return None
    try:
        factor = SplitFactor(S, prefix, d)
    except SolverError:
        S.destroy()
        raise
    if backward_error(S, factor) <= BACKWARD_ERROR:
        return factor
    factor.destroy()
    factor.ksp.destroy()
    return None


def _divided(blocks: Any, first: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Local numbers of a rank's inner nodes, in the order of elimination, and of its nodes in the separator."""
    nodes = len(blocks.indptr) - 1
    higher = np.add.reduceat(np.append(blocks.indices >= first + nodes, False), blocks.indptr[:-1]) > 0
    inner = np.flatnonzero(~higher)
    ones, size = np.ones(len(blocks.indices)), (nodes, blocks.shape[1] // blocks.blocksize[1])
    graph = scipy.sparse.csr_matrix((ones, blocks.indices, blocks.indptr), shape=size)[inner][:, inner + first]
    graph.sort_indices()
    return inner[nested_dissection(graph.indptr, graph.indices)], np.flatnonzero(higher)


def _bordered(inside: Any, across: Any, border: Array) -> Any:
    """[S_II, S_IG; S_GI, border], sparse."""
    return scipy.sparse.bmat([[inside, across], [across.T, scipy.sparse.csr_matrix(border)]], format="csr")


def _eliminated(inside: Any, across: Any, border: Array) -> Array:
    """C = S_GI S_II^-1 S_IG, dense, from a factor of [S_II, S_IG; S_GI, border], which leaves border - C."""
    from scipy.sparse.linalg import splu  # slow to import, and for ranks in 2D alone

    options = {"SymmetricMode": True, "Equil": False}
    try:
        lu = splu(
            _bordered(inside, across, border).tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0, options=options
        )
    except RuntimeError as error:
        raise SolverError(INDEFINITE) from error
    at = lu.perm_c[inside.shape[0] :]
    L, U = lu.L[:, at][at], lu.U[:, at][at]
    return np.asarray(border - (L @ U).toarray())


def _factored(A: Any, prefix: str, d: int) -> PETSc.KSP:
    """The factor of a matrix of this rank in blocks of d x d, in the order of its rows."""
    blocks = A.tobsr((d, d))
    blocks.sort_indices()
    csr = tuple(x.astype(PETSc.IntType) for x in (blocks.indptr, blocks.indices))
    P = PETSc.Mat().createBAIJ(A.shape, d, csr=(*csr, blocks.data), comm=PETSc.COMM_SELF)
    P.setOption(PETSc.Mat.Option.SPD, True)
    ksp = make_ksp(P.convert("sbaij", PETSc.Mat()), prefix)
    P.destroy()
    ksp.setUp()
    if ksp.getPC().getFailedReason():
        raise SolverError(INDEFINITE)
    return ksp
