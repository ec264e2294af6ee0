"""Cholesky of a matrix that one rank holds, in blocks of d x d, and its solves for distributed vectors.

In blocks PETSc's solves take half the time of those with single entries, for each index it reads serves d^2 numbers.
But it takes such a matrix in the order in which it comes, so the rows are put in order first (:mod:`fem.order`); and it
multiplies by inverses of the blocks on the diagonal, which is stable only while these are well conditioned [DHS95]. So
one solve is measured, and a factor of single entries made where blocks would lose digits.
"""

from __future__ import annotations

import numpy as np

from fem.errors import SolverError
from fem.order import NodeOrder
from fem.petsc import PETSc

# Stable factors leave 1e-16 to 7e-16, in whatever units and however ill-conditioned (study.hardcases, families
# contrast and locking, are where blocks leave more): ten rounding units tell them apart.
BACKWARD_ERROR = 10 * float(np.finfo(float).eps)


def factor_blocks(P: PETSc.Mat, prefix: str) -> PETSc.KSP:
    """Factor P = P' > 0 in the order of its rows, in blocks where that is stable. Not collective.

    Args:
        P: the matrix in blocks of d x d (BAIJ), on this rank alone.
        prefix: PETSc options prefix.

    Raises:
        SolverError: a pivot vanishes.
    """
    blocks = P.convert("sbaij", PETSc.Mat())
    ksp = _natural(blocks, prefix)
    blocks.destroy()  # the ksp holds it
    if _factored(ksp) and backward_error(P, ksp) <= BACKWARD_ERROR:
        return ksp
    ksp.destroy()
    entries = P.convert("aij", PETSc.Mat())
    entries.setOption(PETSc.Mat.Option.SPD, True)
    ksp = _natural(entries, prefix)
    entries.destroy()
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
    the scaling of rows [VDS69]. A generic r shows it. Collective.
    """
    w, r = S.createVecs()
    y, D = r.duplicate(), S.getDiagonal()
    first, last = r.owner_range
    r.array_w[:] = np.cos(1.3 * np.arange(first, last)) + 0.5
    ksp.solve(r, w)
    S.mult(w, y)
    y.aypx(-1.0, r)
    D.sqrtabs()
    y.pointwiseDivide(y, D)
    r.pointwiseDivide(r, D)
    w.pointwiseMult(w, D)
    value = y.norm() / (w.norm() + r.norm())
    for x in (w, r, y, D):
        x.destroy()
    return float(value)


def _natural(P: PETSc.Mat, prefix: str) -> PETSc.KSP:
    ksp = PETSc.KSP().create(P.comm)
    ksp.setOptionsPrefix(prefix)
    ksp.setOperators(P)
    ksp.setType("preonly")
    ksp.getPC().setType("cholesky")
    ksp.getPC().setFactorOrdering("natural")
    return ksp


def _factored(ksp: PETSc.KSP) -> bool:
    """Make the factor; whether no pivot vanished."""
    try:
        ksp.setUp()
    except PETSc.Error:
        return False
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
        self.places = order.places[first // order.d : last // order.d]
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
        """Free the vectors. Not collective."""
        self.r.destroy()
        self.w.destroy()
