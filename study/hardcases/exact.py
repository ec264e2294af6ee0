"""Gains of small plants to thirty digits: Newton's method on residuals in decimal arithmetic."""

from __future__ import annotations

from decimal import Decimal, localcontext
from typing import Any

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.care import care, lyapunov
from softgrasp.lqr.dense.modal import assemble_space, dense_modes, gather_tissue
from softgrasp.lqr.plant.problem import RiccatiProblem

DIGITS = 50  # of the residuals; terms of the equation cancel by up to twenty of them
ACCURATE = 1e-30  # correction of the gain over its norm; that for the tissue is up to twelve decades smaller
STEPS = 10  # a correction in doubles gains six to thirteen digits, so three are the rule
NOTHING = 1e-20  # share of the whole gain below which a block is zero

_exact: Any = np.frompyfunc(Decimal, 1, 1)  # a double is a decimal fraction; the conversion does not round


def exact_gain(problem: RiccatiProblem) -> Array:
    """Gain K = -R^{-1} B'XE of u = K [q_s, v_s, z, v_z] with z measured from the hand, right to the last digit.

    A'XE + E'XA - K'RK + C'QC is evaluated in :data:`DIGITS` decimal digits from the matrices as they are in doubles;
    the correction by Newton's method needs a few right digits only and is computed in doubles, in modal coordinates.
    What starts it does not matter: the limit solves the equation, and its closed loop decays. For some fifty states.

    Raises:
        ValueError: more than one rank, R with entries beside the diagonal, or corrections that do not die out.
        ControlError: there is no stabilising gain.
    """
    tissue = gather_tissue(problem)
    if tissue is None or np.count_nonzero(problem.R - np.diag(np.diag(problem.R))):
        raise ValueError("the exact gain needs one rank and a diagonal R")
    space = assemble_space(problem, tissue)
    modal = dense_modes(problem, tissue)
    start = care(modal.space.A, modal.space.B, modal.space.C, problem.Q, problem.R, modal.space.E)
    one = np.eye(2 * problem.layout.n_s)
    S = scipy.linalg.block_diag(one, modal.Phi / modal.omega, modal.Phi)
    L = scipy.linalg.block_diag(one, modal.omega[:, None] * modal.massed.T, modal.Phi.T)
    F = np.linalg.solve(modal.space.E, modal.space.A + modal.space.B @ start.K)
    T, U = scipy.linalg.schur(F, output="real")
    back = np.linalg.solve(modal.space.E, L)  # E^{-1} L
    with localcontext(prec=DIGITS):
        E, A, B, C, Q, R = (_exact(M) for M in (space.E, space.A, space.B, space.C, problem.Q, problem.R))
        inverse = np.diag(1 / np.diag(R))
        constant = C.T @ Q @ C
        X: Any = _exact(L.T @ start.X @ L)
        X = (X + X.T) / 2
        for _ in range(STEPS):
            moved = X @ E
            K = -inverse @ (B.T @ moved)
            driven = A.T @ moved
            residual = np.asarray(driven + driven.T - K.T @ R @ K + constant, dtype=float)
            N = back.T @ lyapunov(T, U, S.T @ residual @ S) @ back
            change = np.linalg.solve(problem.R, space.B.T @ N @ space.E)
            gain = np.asarray(K, dtype=float)
            if np.linalg.norm(change) <= ACCURATE * np.linalg.norm(gain):
                return gain
            X = X + _exact((N + N.T) / 2)
    raise ValueError(f"the exact gain is not settled after {STEPS} corrections")


def worst_part_error(K: Array, exact: Array, n_s: int) -> float:
    """Largest relative error among the gains for q_s, v_s, z and v_z, each over its own norm.

    The gain for the hand is up to twelve decades larger; over the norm of all, gains for the tissue could be left
    out and nobody would see it. A block that is zero is measured over the norm of all.
    """
    half = (K.shape[1] - 2 * n_s) // 2
    ends = [n_s, 2 * n_s, 2 * n_s + half]
    whole, worst = float(np.linalg.norm(exact)), 0.0
    for part, right in zip(np.split(K, ends, axis=1), np.split(exact, ends, axis=1), strict=True):
        size = float(np.linalg.norm(right))
        worst = max(worst, float(np.linalg.norm(part - right)) / (size if size > NOTHING * whole else whole))
    return worst
