"""What holds exactly for every mesh, material and damping, and the numbers a result reports.

With x_T = [I; 0; 0; 0] (the whole body displaced rigidly by unit motions of the hand) and v_T = [0; I; 0; 0] (moving
rigidly), in hand-relative coordinates, A x_T = 0 and A v_T = E x_T (no damping against space), so that the Riccati
equation between them says

    (K x_T)' R (K x_T) = C_s' Q C_s,      (K x_T)' R (K v_T) = x_T' E'XE x_T.
"""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution


def rigid_gains(problem: RiccatiProblem, solution: RiccatiSolution) -> tuple[Array, Array]:
    """Gain u for the whole body displaced by unit translations [N/m], and moving so [N s/m], (n_s, d) each."""
    n_s, d, K = problem.layout.n_s, problem.layout.dimension, solution.gain.K_s
    return K[:, :d], K[:, n_s : n_s + d]


def translation_defect(problem: RiccatiProblem, solution: RiccatiSolution) -> float:
    """||(K x_T)'R(K x_T) - C_s'QC_s|| / ||C_s'QC_s||."""
    K = solution.gain.K_s[:, : problem.layout.n_s]
    exact = problem.C_s.T @ problem.Q @ problem.C_s
    return float(np.linalg.norm(K.T @ problem.R @ K - exact) / (np.linalg.norm(exact) or 1.0))


def velocity_defect(problem: RiccatiProblem, solution: RiccatiSolution) -> float | None:
    """||(K x_T)'R(K v_T) - x_T'E'XE x_T|| / ||x_T'E'XE x_T||.

    None when the damping drags against space: the identity does not hold then.
    """
    if problem.system.damping.in_space and problem.system.damping.alpha > 0:
        return None
    n_s = problem.layout.n_s
    left = solution.gain.K_s[:, :n_s].T @ problem.R @ solution.gain.K_s[:, n_s:]
    right = solution.factor.hand[:n_s] @ solution.factor.hand[:n_s].T
    return float(np.linalg.norm(left - right) / (np.linalg.norm(right) or 1.0))
