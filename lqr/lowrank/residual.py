"""The true residual of a low-rank Riccati solution, recomputed from Z; of the solvers' code it shares PETSc's products.

    Res = A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = U D U',   X = Z Z',   U = [A'Z, E'Z, C'],
    D = [0 I 0; I -Z'B R^{-1} B'Z 0; 0 0 Q]

and with the thin QR factorisation U = q r the 2-norm is the largest |eigenvalue| of r D r', a matrix of order
2 rank + p. Nothing of the order n x n is formed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, folded, on_root, times_columns
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem

ROWS = 4_000  # rows of U that are reduced at a time
BLOCK = 32  # columns whose reflections LAPACK applies at once


def residual(problem: RiccatiProblem, Z: Block) -> float:
    """||A'XE + E'XA - E'XB R^{-1} B'XE + C'QC||_2 / ||C'QC||_2 for X = Z Z'.

    Collective. Inputs are not changed. ``Z``: factor, (2 n_s, rank) on every rank and local rows (2 n_local, rank).

    Returns the relative residual; 2-norm in hand-relative coordinates.
    """
    system, comm = problem.system, problem.layout.comm
    a_s, b_s, Z_z, Z_v = Z.parts
    n_s, n, rank, p = len(a_s), len(Z_z), Z.columns, problem.C_s.shape[0]
    B_Z = b_s if problem.B_z is None else comm.allreduce(problem.B_z.T @ Z_v)
    h = 2 * n_s if comm.rank == 0 else 0
    U = np.zeros((h + 2 * n, 2 * rank + p), order="F")
    _fill_tissue(problem, Z, U[h : h + n], U[h + n :])
    G_b = comm.allreduce(system.G.T @ Z_v)
    drag = system.damping.alpha if system.damping.in_space else 0.0
    own = drag * (system.M_rigid @ b_s) if system.two_way else 0.0
    if comm.rank == 0:
        U[n_s:h, :rank] = a_s - drag * G_b - own
        U[:n_s, rank : 2 * rank] = a_s
        U[n_s:h, rank : 2 * rank] = problem.M_s @ b_s + G_b
        U[:n_s, 2 * rank :] = problem.C_s.T
    r = _triangular(comm, U)

    def relative() -> float:
        rates, momenta, seen = r[:, :rank], r[:, rank : 2 * rank], r[:, 2 * rank :]
        product, pushed = rates @ momenta.T, momenta @ B_Z.T
        small = product + product.T - pushed @ np.linalg.solve(problem.R, pushed.T) + seen @ problem.Q @ seen.T
        size = float(np.abs(np.linalg.eigvalsh(small)).max())
        C = np.linalg.qr(seen, mode="r")
        return size / (float(np.linalg.norm(C @ problem.Q @ C.T, 2)) or 1.0)

    return on_root(comm, relative)


def _fill_tissue(problem: RiccatiProblem, Z: Block, top: Array, bottom: Array) -> None:
    """Local rows z and v_z of [A'Z, E'Z, C']. Collective."""
    system, damping = problem.system, problem.system.damping
    rank, (_, b_s, Z_z, Z_v) = Z.columns, Z.parts
    stiff, mass = times_columns(system.K_ee, Z_v), times_columns(system.M_ee, Z_v)
    np.negative(stiff, out=top[:, :rank])
    bottom[:, :rank] = Z_z - damping.beta * stiff - damping.alpha * mass
    if damping.matrix is not None:
        bottom[:, :rank] -= times_columns(damping.matrix, Z_v)
    top[:, rank : 2 * rank] = Z_z
    bottom[:, rank : 2 * rank] = mass
    top[:, 2 * rank :] = problem.C_z
    if system.two_way:
        G_b_s = system.G @ b_s
        bottom[:, rank : 2 * rank] += G_b_s
        if damping.in_space:
            bottom[:, :rank] -= damping.alpha * G_b_s


def _triangular(comm: MPI.Intracomm, U: Array) -> Array:
    """R of the thin QR factorisation of rows spread over the ranks, right on rank 0. Collective."""

    def own() -> Array:
        r = _reduced([U[:ROWS]])
        for first in range(ROWS, len(U), ROWS):
            r = _reduced([r, U[first : first + ROWS]])
        return r

    return folded(comm, own, lambda upper, lower: _reduced([upper, lower]))


def _reduced(parts: Sequence[Array]) -> Array:
    """R of the QR factorisation of a stack of rows, by SciPy's LAPACK, as NumPy's takes 1.5 times as long."""
    stack = np.empty((sum(map(len, parts)), parts[0].shape[1]), order="F")
    np.concatenate(parts, out=stack)
    least = min(stack.shape)
    if not least:  # a rank without nodes, which LAPACK refuses
        return stack
    factored, _, _, failed = scipy.linalg.lapack.dgeqrf(stack, lwork=BLOCK * stack.shape[1], overwrite_a=1)
    if failed:
        raise SolverError(f"the QR factorisation of a residual was refused by LAPACK (info {failed})")
    return np.triu(factored[:least])
