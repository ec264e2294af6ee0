"""Cholesky in blocks of d x d of a matrix that one rank stores, and the order of its rows.

PETSc's solves with blocks need less time than those with single entries (``python -m benchmarks forward``
prints both): one index serves d^2 numbers, and d unknowns at a time. But PETSc factors such a matrix in the order in
which it comes, so the rows are put in order first (:func:`dissect`); and it multiplies by inverses of
the blocks on the diagonal, which is stable only while these are well conditioned [DHS95]. So two solves are measured,
and a factor of single entries is made where blocks would lose digits. The pattern is found as that of an incomplete
factor (ICC) of which no level is left out: for blocks PETSc's Cholesky clears an array of all rows for each row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import PETSc, from_options, rows_on_all, to_scipy, user_options
from softgrasp.fem.solve.entries import definite


@dataclass(frozen=True)
class NodeOrder:
    """Nested dissection [GL81] of the nodes of one rank; the d rows of a node stay together."""

    nodes: NDArray[np.intp]  # the node at each place, (nodes,)
    places: NDArray[np.intp]  # the place of each node, its inverse
    d: int  # rows of a node

    def enter(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) in this order, a copy."""
        return x[rows_of(self.nodes, self.d)]

    def leave(self, x: NDArray[Any]) -> NDArray[Any]:
        """Rows (n, ...) of this order as they were before, a copy."""
        return x[rows_of(self.places, self.d)]

    def places_of(self, first: int, last: int) -> NDArray[np.intp]:
        """Places of the nodes that had the rows from first to before last."""
        return self.places[first // self.d : last // self.d]

    def rows_of(self, first: int, last: int) -> NDArray[np.intp]:
        """Where the rows from first to before last are now."""
        return rows_of(self.places_of(first, last), self.d)


@dataclass(frozen=True)
class Dissection:
    """An order and the pattern of blocks of d x d in it, for as long as matrices are put in order."""

    order: NodeOrder  # nodes in the order of elimination
    before: tuple[NDArray[Any], NDArray[Any]]  # row pointers and columns of the blocks before
    after: tuple[NDArray[Any], NDArray[Any]]  # row pointers and columns of the blocks in this order
    source: NDArray[np.intp]  # earlier place of each block of ``after``

    def blocks(self, A: PETSc.Mat) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """A of the same pattern with rows and columns in this order: row pointers, columns and blocks of d x d.

        Raises ValueError: A has another pattern.
        """
        blocks = to_scipy(A).tobsr((self.order.d, self.order.d))
        if not all(np.array_equal(a, b) for a, b in zip(self.before, (blocks.indptr, blocks.indices), strict=True)):
            raise ValueError("the matrix does not have the pattern that was dissected")
        return (*self.after, blocks.data[self.source])

    def matrix(self, A: PETSc.Mat) -> PETSc.Mat:
        """The same as a matrix (BAIJ). Raises ValueError: A has another pattern."""
        csr = self.blocks(A)
        result = PETSc.Mat().createBAIJ(A.getSize(), self.order.d, csr=csr, comm=PETSc.COMM_SELF)
        result.setOption(PETSc.Mat.Option.SPD, bool(A.isSymmetricKnown()[1]))
        return result


def dissect(A: PETSc.Mat, d: int) -> Dissection:
    """Nested dissection of the nodes of a matrix on one rank, d rows a node, with symmetric pattern."""
    blocks = to_scipy(A).tobsr((d, d))
    before = blocks.indptr, blocks.indices
    count = len(blocks.indices)
    size = (len(blocks.indptr) - 1,) * 2
    nodes = nested_dissection(*before)
    numbered = scipy.sparse.csr_matrix((np.arange(count), blocks.indices, blocks.indptr), shape=size)
    moved = numbered[nodes][:, nodes]
    moved.sort_indices()
    after = tuple(part.astype(PETSc.IntType) for part in (moved.indptr, moved.indices))
    return Dissection(NodeOrder(nodes, np.argsort(nodes), d), before, after, moved.data)


def nested_dissection(indptr: NDArray[Any], indices: NDArray[Any]) -> NDArray[np.intp]:
    """Nodes of a graph on one rank in the order of nested dissection, by its symmetric pattern."""
    size = (len(indptr) - 1,) * 2
    graph = PETSc.Mat().createAIJ(size, csr=(indptr, indices, np.ones(len(indices))), comm=PETSc.COMM_SELF)
    by_row, by_column = graph.getOrdering("nd")
    nodes: NDArray[np.intp] = by_row.getIndices().astype(np.intp)
    for item in (by_row, by_column, graph):
        item.destroy()
    return nodes


def rows_of(nodes: NDArray[np.intp], d: int) -> NDArray[np.intp]:
    """Rows of nodes with d rows each."""
    return (nodes[:, None] * d + np.arange(d)).ravel()


# Stable factors leave below 1e-15, in whatever units and however ill-conditioned; blocks may leave 1e-14 and more, as
# in the hard cases with layers or nu near 0.5. Ten rounding units separate them.
BACKWARD_ERROR = 10 * float(np.finfo(float).eps)
WIDTH = 16  # columns that MUMPS solves at once: 12 of 2e4 unknowns in 3D take a sixth of the time of one by one [1]
PACKAGES = {"petsc": "PETSc", "mumps": "MUMPS"}  # PETSc's names of those that factor
FACTORS = ("cholesky", "lu")  # PETSc's names of direct preconditioners
EVERY_LEVEL = 2**31 - 1  # levels of fill of an incomplete factor that is complete [1]
VANISHING_PIVOT = (71, 81)  # PETSC_ERR_MAT_LU_ZRPVT, PETSC_ERR_MAT_CH_ZRPVT


def factor_blocks(
    P: PETSc.Mat, prefix: str, entries: Literal["petsc", "mumps"] = "petsc", tangent: bool = False
) -> PETSc.KSP:
    """Factor P = P' > 0 in the order of its rows, in blocks where that is stable.

    Args:
        P: the matrix in blocks of d x d (BAIJ), on this rank alone.
        entries: who factors single entries where blocks are not stable, or where the user gave options for the prefix,
            which PETSc serves for single entries only.
        tangent: P may be indefinite.

    Raises SolverError: a pivot vanishes or is negative, or PETSc gives up.
    """
    if not user_options(prefix):
        ksp = make_ksp(P.convert("sbaij", PETSc.Mat()), prefix)
        if make_factor(ksp, tangent) and (P.getBlockSize() == 1 or backward_error(P, ksp) <= BACKWARD_ERROR):
            return ksp
        ksp.destroy()
    single = P.convert("aij", PETSc.Mat())
    single.setOption(PETSc.Mat.Option.SPD, True)
    ksp = make_ksp(single, prefix, entries)
    if not make_factor(ksp, tangent):
        ksp.destroy()
        raise SolverError(
            f"cholesky: the factorisation of the tissue matrix (n_e = {P.getSize()[0]}) failed; the matrix is singular "
            "or not definite: check material and mesh"
        )
    return ksp


def backward_error(S: PETSc.Mat, solver: Any) -> float:
    """Return |D^-1 (r - S w)| / (|D w| + |D^-1 r|) with D^2 = diag S, for the w that ``solver.solve(r, w)`` finds [1].

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
        solver.solve(r, w)
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
    ksp.setType("preonly")
    pc = ksp.getPC()
    pc.setType("cholesky")
    if by == "mumps":
        pc.setFactorSolverType("mumps")
    elif in_blocks(P) and not user_options(prefix):
        pc.setType("icc")
        pc.setFactorLevels(EVERY_LEVEL)
        pc.setFactorShift(PETSc.Mat.FactorShiftType.NONE)
    if by == "petsc":
        pc.setFactorOrdering("natural")
    P.destroy()  # the ksp owns it
    from_options(ksp)
    return ksp


def in_blocks(P: PETSc.Mat) -> bool:
    """Whether the matrix stores symmetric blocks."""
    return "sbaij" in P.getType() and P.getBlockSize() > 1


def is_factor(pc: PETSc.PC) -> bool:
    """Whether a preconditioner is a whole factor, as the incomplete one of blocks always is (:func:`make_ksp`)."""
    return pc.getType() in FACTORS or (pc.getType() == "icc" and in_blocks(pc.getOperators()[1]))


def package_of(pc: PETSc.PC) -> str:
    """Package that factors, or the preconditioner where none does, as PETSc reports it."""
    by = pc.getFactorSolverType() if is_factor(pc) else pc.getType().upper()
    return PACKAGES.get(by, str(by))


def solve_checked(ksp: PETSc.KSP, r: PETSc.Vec, w: PETSc.Vec, name: str) -> None:
    """Solve S w = r. Collective. Raises SolverError: the iteration does not converge."""
    ksp.solve(r, w)
    if ksp.getConvergedReason() < 0:
        advice = "choose time.solver = 'mumps' or a larger time.rtol"
        if user_options(prefix := ksp.getOptionsPrefix()):
            advice = f"change the PETSc options -{prefix}*, such as a larger ksp_max_it or ksp_rtol"
        raise SolverError(
            f"{name}: no convergence after {ksp.getIterationNumber()} iterations "
            f"(PETSc reason {ksp.getConvergedReason()}); {advice}"
        )


class AskedSolver:
    """A solver that the user's options may have made an iteration, in the place of a factor.

    Args:
        ksp: the solver; stays with its owner.
    """

    def __init__(self, ksp: PETSc.KSP) -> None:
        self.ksp, self.createVecs = ksp, ksp.getOperators()[0].createVecs

    def solve(self, r: PETSc.Vec, w: PETSc.Vec) -> None:
        """Solve S w = r. Collective where the solver is. Raises SolverError: the iteration does not converge."""
        solve_checked(self.ksp, r, w, self.ksp.getPC().getType())

    def matSolve(self, B: PETSc.Mat, X: PETSc.Mat) -> None:  # noqa: N802  (PETSc's name, as a factor has it)
        """Solve S X = B for dense columns. Collective. Raises SolverError: the iteration does not converge."""
        self.ksp.matSolve(B, X)
        if self.ksp.getConvergedReason() < 0:
            raise SolverError(
                f"{self.ksp.getPC().getType()}: no convergence for {B.getSize()[1]} columns; change the PETSc options "
                f"-{self.ksp.getOptionsPrefix()}*, such as a larger ksp_max_it or ksp_rtol"
            )


def block_solves(factor: PETSc.Mat, X: NDArray[Any]) -> NDArray[Any]:
    """S^-1 X of local rows (n_local, k) by a factor of S that takes several columns at once (MUMPS). Collective."""
    result = np.empty(X.shape, order="F")
    for first in range(0, X.shape[1], WIDTH):
        part = np.asfortranarray(X[:, first : first + WIDTH])
        B = PETSc.Mat().createDense((factor.getSizes()[0], (None, part.shape[1])), array=part, comm=factor.comm)
        solved = B.duplicate()
        factor.matSolve(B, solved)
        result[:, first : first + WIDTH] = solved.getDenseArray(readonly=True)
        B.destroy()
        solved.destroy()
    return result


def direct_solves(ksp: PETSc.KSP) -> PETSc.Mat | AskedSolver:
    """The factor of a solver, whose own solves skip its checks; the solver itself where the user gave options."""
    return AskedSolver(ksp) if user_options(ksp.getOptionsPrefix()) else ksp.getPC().getFactorMatrix()


def make_factor(ksp: PETSc.KSP, tangent: bool) -> bool:
    """Make the factor; whether no pivot vanished, nor is negative but in that of a tangent. Collective where ksp is.

    PETSc and MUMPS pass over negative ones. Raises SolverError: PETSc gives up.
    """
    try:
        ksp.setUp()
    except PETSc.Error as error:
        if error.ierr in VANISHING_PIVOT:
            return False
        raise SolverError(
            f"cholesky: PETSc gave up the factorisation of the tissue matrix with error {error.ierr} (55 is out of "
            "memory); try time.solver = 'mumps' or fewer ranks"
        ) from error
    pc = ksp.getPC()
    free = tangent or pc.getType() == "lu" or not is_factor(pc)
    return not pc.getFailedReason() and (free or definite(pc.getFactorMatrix()))


class OrderedFactor:
    """Triangular solves for distributed vectors, every rank with the whole factor of a matrix in another order.

    One gather a solve; every rank solves for all rows and keeps its own.

    Args:
        factor: of the permuted matrix (:func:`direct_solves`); stays with its solver.
        order: of its rows.
        like: a vector with the distribution of those to come.
    """

    def __init__(self, factor: PETSc.Mat | AskedSolver, order: NodeOrder, like: PETSc.Vec) -> None:
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

    def columns(self, X: NDArray[Any], at_once: bool = False) -> NDArray[Any]:
        """S^-1 X of local rows (n_local, k), Fortran order; each rank solves every size-th column. Collective.

        ``at_once``: several columns in one solve, by a factor of MUMPS.
        """
        comm = self.comm
        own = self.order.enter(rows_on_all(comm, X)[:, comm.rank :: comm.size])
        if at_once:
            solved = block_solves(self.factor, own)
        else:
            solved = np.empty(own.shape, order="F")
            for i in range(own.shape[1]):
                self.r.array_w[:] = own[:, i]
                self.factor.solve(self.r, self.w)
                solved[:, i] = self.w.array_r
        solved = self.order.leave(solved)
        result, ends = np.empty(X.shape, order="F"), np.cumsum(self.counts)
        parts = comm.alltoall([np.ascontiguousarray(part) for part in np.split(solved, ends[:-1])])
        for rank, part in enumerate(parts):
            result[:, rank :: comm.size] = part
        return result

    def destroy(self) -> None:
        """Free the vectors."""
        self.r.destroy()
        self.w.destroy()
