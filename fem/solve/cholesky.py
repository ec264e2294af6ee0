"""Cholesky in blocks of d x d of a matrix that one rank holds, the order of its rows, and what a step needs in it.

PETSc's solves with blocks take less time than those with single entries (``python -m softgrasp.study.bench forward``
prints both): one index serves d^2 numbers, and d unknowns at a time. But PETSc takes such a matrix in the order in
which it comes, so the rows are put in order first (:func:`dissect`); and it multiplies by inverses of
the blocks on the diagonal, which is stable only while these are well conditioned [DHS95]. So two solves are measured,
and a factor of single entries is made where blocks would lose digits.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError, agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, rows_on_all, to_scipy, whole_copy
from softgrasp.fem.system import BlockSystem


@dataclass(frozen=True)
class NodeOrder:
    """Nested dissection [GL81] of the nodes of one rank; the d rows of a node stay together."""

    nodes: NDArray[np.intp]  # the node at each place, (nodes,)
    places: NDArray[np.intp]  # the place of each node, its inverse
    d: int  # rows of a node

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) in this order, a copy."""
        return x[_rows(self.nodes, self.d)]

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) of this order as they were before, a copy."""
        return x[_rows(self.places, self.d)]

    def places_of(self, first: int, last: int) -> NDArray[np.intp]:
        """Places of the nodes that had the rows from first to before last."""
        return self.places[first // self.d : last // self.d]

    def rows_of(self, first: int, last: int) -> NDArray[np.intp]:
        """Where the rows from first to before last are now."""
        return _rows(self.places_of(first, last), self.d)


@dataclass(frozen=True)
class Dissection:
    """An order and the pattern of blocks of d x d in it, for as long as matrices are put in order."""

    order: NodeOrder  # of the nodes
    before: tuple[NDArray[Any], NDArray[Any]]  # row pointers and columns of the blocks before
    after: tuple[NDArray[Any], NDArray[Any]]  # the same in this order
    source: NDArray[np.intp]  # where each block of ``after`` stood before

    def matrix(self, A: PETSc.Mat) -> PETSc.Mat:
        """A of the same pattern with rows and columns in this order, in blocks of d x d (BAIJ).

        Raises ValueError: A has another pattern.
        """
        blocks = to_scipy(A).tobsr((self.order.d, self.order.d))
        if not all(np.array_equal(a, b) for a, b in zip(self.before, (blocks.indptr, blocks.indices), strict=True)):
            raise ValueError("the matrix does not have the pattern that was dissected")
        csr = (*self.after, blocks.data[self.source])
        result = PETSc.Mat().createBAIJ(A.getSize(), self.order.d, csr=csr, comm=PETSc.COMM_SELF)
        result.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
        return result


def dissect(A: PETSc.Mat, d: int) -> Dissection:
    """Nested dissection of the nodes of a matrix on one rank, d rows a node, with symmetric pattern."""
    blocks = to_scipy(A).tobsr((d, d))
    before = blocks.indptr, blocks.indices
    count = len(blocks.indices)
    size = (len(blocks.indptr) - 1,) * 2
    graph = PETSc.Mat().createAIJ(size, csr=(*before, np.ones(count)), comm=PETSc.COMM_SELF)
    by_row, by_column = graph.getOrdering("nd")
    nodes = by_row.getIndices().astype(np.intp)
    for item in (by_row, by_column, graph):
        item.destroy()
    numbered = scipy.sparse.csr_matrix((np.arange(count), blocks.indices, blocks.indptr), shape=size)
    moved = numbered[nodes][:, nodes]
    moved.sort_indices()
    after = tuple(part.astype(PETSc.IntType) for part in (moved.indptr, moved.indices))
    return Dissection(NodeOrder(nodes, np.argsort(nodes), d), before, after, moved.data)


def _rows(nodes: NDArray[np.intp], d: int) -> NDArray[np.intp]:
    return (nodes[:, None] * d + np.arange(d)).ravel()


@dataclass(frozen=True)
class Held:
    """Stiffness, damping matrix and coupling as one rank steps them."""

    layout: BlockLayout
    whole: bool  # all rows are here, on a communicator of this rank alone
    order: NodeOrder | None  # of the rows held; None: that of the layout
    rows: slice | NDArray[np.intp]  # places of the owned rows among those held
    K: PETSc.Mat  # stiffness, a copy, in blocks of d x d on one rank: a quarter less memory traffic than single entries
    G: Array  # coupling to the hand, (rows held, n_s)
    S: PETSc.Mat  # matrix of the step; whoever factors it owns it
    D: PETSc.Mat | None
    M: PETSc.Mat | None  # mass, only beside D
    parts: tuple[PETSc.Mat, ...] = ()  # further matrices that were asked for, on the same rows; whoever asked owns them

    def agree(self) -> AbstractContextManager[None]:
        """Guard of a block that is a rank's own affair when it holds everything, and collective otherwise. Collective.

        The block must not communicate by itself.
        """
        return agree(self.layout.comm) if self.whole else nullcontext()

    def gather(self, local: Array) -> Array:
        """Rows held of a vector given by its owned rows. Collective."""
        return self.enter(rows_on_all(self.layout.comm, local)) if self.whole else local

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows in the order of the layout as they are held."""
        return x if self.order is None else self.order.enter(x)

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows held in the order of the layout."""
        return x if self.order is None else self.order.leave(x)

    def destroy(self) -> None:
        """Free what is not the system's own. Collective."""
        self.K.destroy()
        if self.whole:
            for A in (self.D, self.M):
                if A is not None:
                    A.destroy()


def held_operators(
    system: BlockSystem, S: PETSc.Mat, whole: bool, ordered: bool, parts: tuple[PETSc.Mat, ...] = ()
) -> Held:
    """Operators of a system on the owned rows, or on all. Collective.

    Args:
        S: matrix of the step, consumed.
        ordered: in the order of elimination; all rows then.
    """
    layout, D = system.layout, system.damping.matrix
    beside = () if D is None else (D, system.M_ee)
    first, last = layout.start, layout.start + layout.n_local
    if not (whole or ordered):
        K = system.K_ee.copy()
        if K.comm.size == 1:  # the conversion of a parallel matrix takes its source apart
            K.convert("baij")
        G, M = np.asfortranarray(system.G), None if D is None else system.M_ee
        return Held(layout, False, None, slice(0, layout.n_local), K, G, S, D, M, parts)
    every = [whole_copy(A) for A in (system.K_ee, S, *beside, *parts)]
    for A in (S, *parts):
        A.destroy()
    G, order = rows_on_all(layout.comm, system.G), None
    rows: slice | NDArray[np.intp] = slice(first, last)
    if ordered:
        dissection = dissect(every[0], layout.dimension)
        for i, A in enumerate(every):
            every[i] = dissection.matrix(A)
            A.destroy()
        order = dissection.order
        G, rows = order.enter(G), order.rows_of(first, last)
    else:
        every[0].convert("baij")
    K, S, *rest = every
    D, M = rest[: len(beside)] or (None, None)
    return Held(layout, True, order, rows, K, np.asfortranarray(G), S, D, M, tuple(rest[len(beside) :]))


# Stable factors leave below 1e-15, in whatever units and however ill-conditioned; blocks may leave 1e-14 and more, as
# in the hard cases with layers or nu near 0.5. Ten rounding units tell them apart.
BACKWARD_ERROR = 10 * float(np.finfo(float).eps)
VANISHING_PIVOT = (71, 81)  # PETSC_ERR_MAT_LU_ZRPVT, PETSC_ERR_MAT_CH_ZRPVT


def factor_blocks(P: PETSc.Mat, prefix: str, entries: Literal["petsc", "mumps"] = "petsc") -> PETSc.KSP:
    """Factor P = P' > 0 in the order of its rows, in blocks where that is stable.

    Args:
        P: the matrix in blocks of d x d (BAIJ), on this rank alone.
        entries: who factors single entries where blocks are not stable.

    Raises SolverError: a pivot vanishes, or PETSc gives up.
    """
    ksp = make_ksp(P.convert("sbaij", PETSc.Mat()), prefix)
    if _factored(ksp) and (P.getBlockSize() == 1 or backward_error(P, ksp) <= BACKWARD_ERROR):
        return ksp
    ksp.destroy()
    single = P.convert("aij", PETSc.Mat())
    single.setOption(PETSc.Mat.Option.SPD, True)
    ksp = make_ksp(single, prefix, entries)
    if not _factored(ksp):
        ksp.destroy()
        raise SolverError(
            f"cholesky: the factorisation of the tissue matrix (n_e = {P.getSize()[0]}) failed; the matrix is singular "
            "or not definite: check material and mesh"
        )
    return ksp


def backward_error(S: PETSc.Mat, ksp: PETSc.KSP) -> float:
    """Return |D^-1 (r - S w)| / (|D w| + |D^-1 r|) with D^2 = diag S, for the w that the solver finds [1].

    What it solved exactly is S with errors of this size, counted in units in which the diagonal is one, and so free of
    the scaling of rows [VDS69]. The larger value of two r: D g lets soft parts answer most, S D^-1 g all parts alike,
    with g generic. Collective.
    """
    w, r = S.createVecs()
    y, D = r.duplicate(), S.getDiagonal()
    D.sqrtabs()
    first, last = r.owner_range
    g = np.cos(1.3 * np.arange(first, last)) + 0.5
    values = []
    for soft in (True, False):
        r.array_w[:] = g
        if soft:
            r.pointwiseMult(r, D)
        else:
            r.pointwiseDivide(r, D)
            S.mult(r, y)
            y.copy(r)
        ksp.solve(r, w)
        S.mult(w, y)
        y.aypx(-1.0, r)
        y.pointwiseDivide(y, D)
        r.pointwiseDivide(r, D)
        w.pointwiseMult(w, D)
        values.append(y.norm() / (w.norm() + r.norm()))
    for x in (w, r, y, D):
        x.destroy()
    return float(np.max(values))  # not a number if one is none


def make_ksp(P: PETSc.Mat, prefix: str, by: Literal["petsc", "mumps"] = "petsc") -> PETSc.KSP:
    """A solver by Cholesky, PETSc's in the order of the rows, not factored yet; consumes P. Collective."""
    ksp = PETSc.KSP().create(P.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(P)
    P.destroy()  # the ksp holds it
    ksp.setType("preonly")
    pc = ksp.getPC()
    pc.setType("cholesky")
    if by == "mumps":
        pc.setFactorSolverType("mumps")
    else:
        pc.setFactorOrdering("natural")
    return ksp


def _factored(ksp: PETSc.KSP) -> bool:
    """Make the factor; whether no pivot vanished."""
    try:
        ksp.setUp()
    except PETSc.Error as error:
        if error.ierr in VANISHING_PIVOT:
            return False
        raise SolverError(
            f"cholesky: PETSc gave up the factorisation of the tissue matrix with error {error.ierr} (55 is out of "
            "memory); try time.solver = 'mumps' or fewer ranks"
        ) from error
    return not ksp.getPC().getFailedReason()


class OrderedFactor:
    """Triangular solves for distributed vectors, every rank with the whole factor of a matrix in another order.

    One gather a solve; every rank solves for all rows and keeps its own.

    Args:
        factor: of the permuted matrix; stays with its solver.
        order: of its rows.
        like: a vector with the distribution of those to come.
    """

    def __init__(self, factor: PETSc.Mat, order: NodeOrder, like: PETSc.Vec) -> None:
        self.factor, self.order = factor, order
        self.comm = like.comm.tompi4py()
        first, last = like.owner_range
        self.counts = self.comm.allgather(last - first)
        self.places = order.places_of(first, last)
        self.all = np.empty(like.getSize())
        self.r, self.w = factor.createVecs()
        self.r_nodes, self.w_nodes = (x.array_w.reshape(-1, order.d) for x in (self.r, self.w))

    def solve(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Solve S w = r. Collective."""
        d, rows = self.order.d, r.array_r
        if self.comm.size > 1:
            self.comm.Allgatherv(rows, [self.all, self.counts])
            rows = self.all
        rows.reshape(-1, d).take(self.order.nodes, 0, self.r_nodes, "clip")  # "raise" would copy
        self.factor.solve(self.r, self.w)
        self.w_nodes.take(self.places, 0, w.array_w.reshape(-1, d), "clip")

    def destroy(self) -> None:
        """Free the vectors."""
        self.r.destroy()
        self.w.destroy()
