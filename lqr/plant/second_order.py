"""Riccati problems of second-order systems that come from no scene: benchmark examples, frames, matrices at hand."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.errors import SolverError, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.system import BlockSystem, Damping
from softgrasp.lqr.plant.problem import RiccatiProblem

SYMMETRIC = 1e-12  # relative to the largest entry: rounding of an assembly


def second_order(
    matrices: tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat],
    B: Array,
    C: Array,
    Q: Array | None = None,
    R: Array | None = None,
    damping: Damping | None = None,
) -> RiccatiProblem:
    """M z'' + D z' + K z = B u, y = C z as a Riccati problem without a hand: x = [z, z'], E = blkdiag(I, M).

    Assumptions: M and K symmetric positive definite, D symmetric positive semidefinite, all distributed by the same
    rows. The copies that are kept share one sparsity pattern. NewtonADI, RADI, StructuredGalerkin, DenseRiccati,
    modal_lqr and the diagnosis apply; targets, closed loops and the certified abscissa belong to a hand. The start of
    NewtonADI starts from the lowest modes: where others matter more, RADI is the faster one. Collective.

    Args:
        matrices: mass M, damping D and stiffness K, AIJ matrices (n_e, n_e).
        B: forces of unit inputs, local rows (n_local, m).
        C: outputs of the displacement, transposed, local rows (n_local, p).
        Q: weight of the outputs, (p, p), symmetric positive semidefinite; None: I.
        R: weight of the inputs, (m, m), symmetric positive definite; None: I.
        damping: coefficients of D = alpha M + beta K, which leaves modes uncoupled; the matrix D is ignored then.

    Returns:
        The problem, which owns copies of M, D and K and has no degrees of freedom of a hand.

    Raises SolverError: the shapes do not fit, or a matrix is not symmetric.
    """
    M, D, K = matrices
    comm = M.comm.tompi4py()
    first, last = M.getOwnershipRange()
    n, n_e = last - first, M.getSize()[0]
    with raise_on_all_ranks(comm):
        for name, A in (("M", M), ("D", D), ("K", K)):
            if A.getSize() != (n_e, n_e) or A.getOwnershipRange() != (first, last):
                raise SolverError(f"{name} is {A.getSize()} with rows {A.getOwnershipRange()}; it must match M")
        if len(B) != n or len(C) != n:
            raise SolverError(f"B and C have {len(B)} and {len(C)} local rows; this rank owns {n}")
    for name, A in (("M", M), ("D", D), ("K", K)):
        if not A.isSymmetric(SYMMETRIC * A.norm(PETSc.NormType.INFINITY)):
            raise SolverError(f"{name} is not symmetric; gyroscopic and circulatory terms are not covered")
    M, D, K = _one_pattern(M, D, K)
    for A in (M, K):
        A.setOption(PETSc.Mat.Option.SPD, True)
    nodes = np.arange(first, last, dtype=np.float64)[:, None] / n_e  # a line, so that start vectors differ by row
    layout = BlockLayout(comm, 1, 0, n_e, n, first, nodes, np.zeros(1))
    nothing, small = np.zeros((n, 0)), np.zeros((0, 0))
    if damping is None:
        damping = Damping(matrix=D)
    else:
        D.destroy()
    system = BlockSystem(layout, (), (), M, K, nothing, nothing, small, small, damping)
    C, B = np.asfortranarray(C, dtype=np.float64), np.asfortranarray(B, dtype=np.float64)
    Q = np.eye(C.shape[1]) if Q is None else Q
    R = np.eye(B.shape[1]) if R is None else R
    return RiccatiProblem(system, np.zeros((C.shape[1], 0)), C, Q, R, B_z=B)


def _one_pattern(*matrices: PETSc.Mat) -> list[PETSc.Mat]:
    """Copies with the union of all patterns. Collective."""
    union = matrices[0].copy()
    for A in matrices[1:]:
        union.axpy(1.0, A, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    union.zeroEntries()
    result = []
    for A in matrices:
        same = union.copy()
        same.axpy(1.0, A, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        result.append(same)
    union.destroy()
    return result
