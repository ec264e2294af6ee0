"""E x' = A x + B u, y = C x in the paper's absolute coordinates, the form of other codes."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.lqr.plant.problem import RiccatiProblem


def paper_form(problem: RiccatiProblem) -> tuple[Any, Any, Array, Array]:
    """Sparse E, A, shape (2n, 2n), and dense B, (2n, n_s), C, (outputs, 2n), of x = [q_s, v_s, q_e, v_e]. One rank.

    M_s v_s' = u, M_es v_s' + M_ee v_e' = -K_es q_s - D_es v_s - K_ee q_e - D_ee v_e: the hand moves the tissue and
    does not feel it. Raises ValueError: more than one rank, or two-way coupling.
    """
    system, n_s = problem.system, problem.layout.n_s
    if system.two_way or system.layout.comm.size > 1:
        raise ValueError("the paper's matrices are those of one-way coupling, on one rank")
    M, K = to_scipy(system.M_ee), to_scipy(system.K_ee)
    matrix = system.damping.matrix
    D = system.damping.alpha * M + (system.damping.beta * K if matrix is None else to_scipy(matrix))
    n, csc = M.shape[0], scipy.sparse.csc_matrix
    (one_s, zero_s), (one, zero) = ((scipy.sparse.identity(k), csc((k, k))) for k in (n_s, n))
    M_es, K_es, D_es = csc(system.G - M @ system.T), csc(-(K @ system.T)), csc(-(D @ system.T))
    E = [
        [one_s, None, None, None],
        [None, csc(problem.M_s), None, None],
        [None, None, one, None],
        [None, M_es, None, M],
    ]
    A = [[None, one_s, None, None], [zero_s, None, None, None], [None, None, zero, one], [-K_es, -D_es, -K, -D]]
    B = np.zeros((2 * (n + n_s), n_s))
    B[n_s : 2 * n_s] = np.eye(n_s)
    C = np.zeros((problem.C_s.shape[0], len(B)))
    C[:, :n_s] = problem.C_s - problem.C_z.T @ system.T
    C[:, 2 * n_s : 2 * n_s + n] = problem.C_z.T
    return scipy.sparse.bmat(E).tocsc(), scipy.sparse.bmat(A).tocsc(), B, C
