"""Cholesky of one matrix by several ranks: each eliminates the nodes of its own part, all share what separates them.

With I the nodes of a rank that have no neighbour on a higher rank, and G all other nodes, the separator,

    Sigma = S_GG - sum over ranks of C,   C = S_GI S_II^-1 S_IG,
    Sigma w_G = r_G - sum over ranks of S_GI S_II^-1 r_I,   S_II w_I = r_I - S_IG w_G.

A solve is a forward sweep on each rank, one sum of as many numbers as G has rows, a dense solve on every rank and a
backward sweep; each rank reads the factor of its own part. The sums have a fixed order: a run repeats its bits.

Each rank factors [S_II, S_IG; S_GI, S_GG] with the rows G that its part touches. With U and D of the last rows of this
factor, where S = U'D U, U with ones on its diagonal, U'D U = S_GG - C gives C; its forward sweep y = D^-1 U^-T r from
[r_I; 0] ends with U'D y = -S_GI S_II^-1 r_I, and its backward sweep may begin with U w_G [GL81].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.petsc import Array, PETSc, to_scipy, total, user_options
from softgrasp.fem.solve.cholesky import BACKWARD_ERROR, backward_error, make_ksp, nested_dissection, rows_of
from softgrasp.fem.solve.entries import definite, last_rows

INDEFINITE = "cholesky: the factorisation of the tissue matrix failed; it is not definite: check material and mesh"


class NoEntries(Exception):
    """PETSc does not show the entries of a factor, or some rank has none, or they are of no definite matrix."""


class SplitFactor:
    """Solves S w = r for distributed vectors.

    Args:
        S: symmetric positive definite, d rows a node, on two ranks or more.
        prefix: of the options of each rank's solver.
        d: rows of a node.

    Attributes:
        ksp: solver of this rank's part.
        top: Cholesky factor of Sigma, on every rank.

    Collective. Raises SolverError: S is not definite; NoEntries: see there.
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
            if not len(inner):
                raise NoEntries
            parts = rows[self.inner][:, self.inner + first * d], outer[:, self.touched]
            self.ksp = _factored(_bordered(*parts, sigma[at]), prefix, d)
            self.factor = self.ksp.getPC().getFactorMatrix()
            self.U, D = _last(self.factor, len(self.touched) // d)
            self.V = self.U.T @ D
        share = np.zeros_like(sigma)
        share[at] = sigma[at] - self.V @ self.U
        self.top = _dense_factor(sigma - total(self.comm, share))
        self.r, self.w = self.factor.createVecs()
        self.sum, self.solved = self.top.createVecs()
        self.share = np.zeros(len(G))

    def solve(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Solve S w = r. Collective."""
        rows, n = r.array_r, len(self.inner)
        right = self.r.array_w
        rows.take(self.inner, 0, right[:n], "clip")  # "raise" would copy
        right[n:] = 0.0
        self.factor.solveForward(self.r, self.w)
        swept = self.w.array_w
        self.share[:] = 0.0
        self.share[self.touched] = self.V @ swept[n:]
        self.share[self.mine] += rows[self.own]
        self.comm.Allreduce(self.share, self.sum.array_w)
        self.top.solve(self.sum, self.solved)
        solved = self.solved.array_r
        np.matmul(self.U, solved[self.touched], out=swept[n:])
        self.factor.solveBackward(self.w, self.r)
        result = w.array_w
        result[self.inner], result[self.own] = self.r.array_r[:n], solved[self.mine]

    def destroy(self) -> None:
        """Free the vectors and the factor of Sigma."""
        for item in (self.r, self.w, self.sum, self.solved, self.top):
            item.destroy()


def split_factor(S: PETSc.Mat, prefix: str, d: int) -> SplitFactor | None:
    """The factor with a subtree on each rank; None where the user gave options, or blocks lose digits. Collective.

    None too where PETSc does not show what it stores of a factor, and where some rank has no inner nodes.

    Raises SolverError: S is not definite; it is freed.
    """
    if user_options(prefix):
        return None
    try:
        factor = SplitFactor(S, prefix, d)
    except NoEntries:
        return None
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
    """[S_II, S_IG; S_GI, border], sparse, with every entry of the border, be it zero."""
    k = len(border)
    corner = scipy.sparse.csr_matrix((border.ravel(), np.tile(np.arange(k), k), np.arange(0, k * k + 1, max(k, 1))))
    return scipy.sparse.bmat([[inside, across], [across.T, corner]], format="csr")


def _last(factor: PETSc.Mat, nodes: int) -> tuple[Array, Array]:
    """U and D of the border. Raises NoEntries: PETSc does not show them."""
    found = last_rows(factor, nodes)
    if found is None:
        raise NoEntries
    return found


def _dense_factor(sigma: Array) -> PETSc.Mat:
    """The Cholesky factor of Sigma, which every rank has alike. Raises SolverError: it is not definite."""
    result = PETSc.Mat().createDense(sigma.shape, array=np.asfortranarray(sigma), comm=PETSc.COMM_SELF)
    result.setOption(PETSc.Mat.Option.SPD, True)
    try:
        result.factorCholesky(PETSc.IS())
    except PETSc.Error as error:
        raise SolverError(INDEFINITE) from error
    return result


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
    pc = ksp.getPC()
    if pc.getFailedReason():
        raise SolverError(INDEFINITE)
    if not definite(pc.getFactorMatrix()):  # by rounding too
        raise NoEntries
    return ksp
