"""Gains of the hand: those that are right to the last digit, errors part by part, and what bounds these errors.

To first order a residual W of A'XE + E'XA - K'RK + C'QC = 0 moves Y = E'XE by N and the gain K = -R^{-1} B'E^{-T} Y by

    F'N + N F = -W,   dK = -R^{-1} B'E^{-T} N,   dK_ij = <L_ij, W>,   F = E^{-1}(A + B K).

All L_ij are computed, so that each part of the gain has a bound of its own from the entries of a residual, in modal
coordinates, whose squares are energies: rounding is graded there as the gain is. A norm of the residual through the
norm of the operator would promise 5 to 9 decades less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.care import WeightedSystem, care, care_of, lyapunov
from softgrasp.lqr.dense.modal import ModalPlant, assemble_space, dense_modes, gather_tissue
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from tests.hardcases.cases import EPS

DIGITS = 50  # of the residuals; terms of the equation cancel by up to twenty of them
ACCURATE = 1e-30  # correction of the gain over its norm; that for the tissue is up to twelve decades smaller
STEPS = 10  # a correction in doubles gains six to thirteen digits, so three are the rule
NOTHING = 1e-20  # share of the whole gain below which a block is zero

_exact: Any = np.frompyfunc(Decimal, 1, 1)  # a double is a decimal fraction; the conversion does not round


def _spaces(problem: RiccatiProblem) -> tuple[WeightedSystem, ModalPlant]:
    """The plant relative to the hand, and in its modes. Raises ValueError: more than one rank."""
    tissue = gather_tissue(problem)
    if tissue is None:
        raise ValueError("gains are bounded on one rank")
    return assemble_space(problem, tissue), dense_modes(problem, tissue)


def _residual(space: WeightedSystem, X: Any) -> tuple[Any, Array]:
    """K and A'XE + E'XA - K'RK + C'QC for a decimal X, in the digits of the context; the residual in doubles."""
    E, A, B, C, Q, R = (_exact(M) for M in (space.E, space.A, space.B, space.C, space.Q, space.R))
    moved = X @ E
    K = -np.diag(1 / np.diag(R)) @ (B.T @ moved)
    driven = A.T @ moved
    return K, np.asarray(driven + driven.T - K.T @ R @ K + C.T @ Q @ C, dtype=float)


def exact_gain(problem: RiccatiProblem) -> Array:
    """Gain K = -R^{-1} B'XE of u = K [q_s, v_s, z, v_z] with z measured from the hand, right to the last digit.

    A'XE + E'XA - K'RK + C'QC is evaluated in :data:`DIGITS` decimal digits from the matrices as they are in doubles;
    the correction by Newton's method needs a few right digits only and is computed in doubles, in modal coordinates.
    What starts it does not matter: the limit solves the equation, and its closed loop decays. For some fifty states.

    Raises:
        ValueError: more than one rank, R with entries beside the diagonal, or corrections that do not die out.
        ControlError: there is no stabilising gain.
    """
    if np.count_nonzero(problem.R - np.diag(np.diag(problem.R))):
        raise ValueError("the exact gain needs a diagonal R")
    space, modal = _spaces(problem)
    start = care(modal.space.A, modal.space.B, modal.space.C, problem.Q, problem.R, modal.space.E)
    one = np.eye(2 * problem.layout.n_s)
    S = scipy.linalg.block_diag(one, modal.Phi / modal.omega, modal.Phi)
    L = scipy.linalg.block_diag(one, modal.omega[:, None] * modal.massed.T, modal.Phi.T)
    F = np.linalg.solve(modal.space.E, modal.space.A + modal.space.B @ start.K)
    T, U = scipy.linalg.schur(F, output="real")
    back = np.linalg.solve(modal.space.E, L)  # E^{-1} L
    with localcontext(prec=DIGITS):
        X: Any = _exact(L.T @ start.X @ L)
        X = (X + X.T) / 2
        for _ in range(STEPS):
            K, residual = _residual(space, X)
            N = back.T @ lyapunov(T, U, S.T @ residual @ S) @ back
            change = np.linalg.solve(problem.R, space.B.T @ N @ space.E)
            gain = np.asarray(K, dtype=float)
            if np.linalg.norm(change) <= ACCURATE * np.linalg.norm(gain):
                return gain
            X = X + _exact((N + N.T) / 2)
    raise ValueError(f"the exact gain is not settled after {STEPS} corrections")


def parts(exact: Array, n_s: int) -> Iterator[tuple[slice, float]]:
    """Columns of the gains for q_s, v_s, z and v_z, and the norm that errors of each are measured over: its own.

    The gain for the hand is up to twelve decades larger; over the norm of all, gains for the tissue could be left
    out and nobody would see it. A block that is zero is measured over the norm of all.
    """
    half, whole = (exact.shape[1] - 2 * n_s) // 2, float(np.linalg.norm(exact))
    ends = [0, n_s, 2 * n_s, 2 * n_s + half, exact.shape[1]]
    for part in map(slice, ends, ends[1:]):
        size = float(np.linalg.norm(exact[:, part]))
        yield part, size if size > NOTHING * whole else whole


def worst_part_error(K: Array, exact: Array, n_s: int) -> float:
    """Largest relative error among the gains for q_s, v_s, z and v_z."""
    return max(float(np.linalg.norm((K - exact)[:, part])) / size for part, size in parts(exact, n_s))


@dataclass(frozen=True)
class GainBounds:
    """Bounds on :func:`worst_part_error`, to first order."""

    problem: RiccatiProblem  # plant and weights
    exact: Array  # gain, (m, states)

    @cached_property
    def _plant(self) -> tuple[WeightedSystem, ModalPlant, Array]:
        """The plant relative to the hand and in its modes xi, and S of x = S xi."""
        space, modal = _spaces(self.problem)
        one = np.eye(2 * self.problem.layout.n_s)
        return space, modal, scipy.linalg.block_diag(one, modal.Phi / modal.omega, modal.Phi)

    @cached_property
    def _descriptor_free(self) -> tuple[Array, Array]:
        """E^{-1} A and E^{-1} B in modes."""
        m = self._plant[1].space
        return np.linalg.solve(m.E, m.A), np.linalg.solve(m.E, m.B)

    @cached_property
    def _functionals(self) -> Array:
        """L_ij of every entry of the gain as the solver's columns have it, (m, states, states, states)."""
        (A, B), S = self._descriptor_free, self._plant[2]
        T, U = scipy.linalg.schur((A + B @ self.exact @ S).T, output="real")
        inputs, one = np.linalg.solve(self.problem.R, B.T), np.eye(len(A))
        pairs = [[np.outer(e, b) / 2 for e in one] for b in inputs]
        L = np.array([[lyapunov(T, U, W + W.T) for W in row] for row in pairs])
        return np.asarray(np.einsum("ijab,jc->icab", L, np.linalg.inv(S)))

    def _worst(self, errors: Array) -> float:
        return max(
            float(np.linalg.norm(errors[:, part])) / size for part, size in parts(self.exact, self.problem.layout.n_s)
        )

    def rounding(self) -> float:
        """What roundings of a solver in modal coordinates may leave, taken as a random walk.

        Entries of the residual are sums of N products, sqrt(N) eps times |A|'|Y| + |Y||A| + |Y||G||Y| + |H|; modes have
        the backward error sqrt(N) eps |K_ee| = sqrt(N) eps omega_max^2 of a symmetric eigenvalue solver; and the gain
        is brought back from modes by one more sum.
        """
        _, plant, S = self._plant
        (A, B), m, h = self._descriptor_free, plant.space, 2 * self.problem.layout.n_s
        k, omega = len(plant.omega), plant.omega
        Y = abs(m.E.T @ care_of(m).X @ m.E)
        G, H = abs(B @ np.linalg.solve(m.R, B.T)), abs(m.C.T @ m.Q @ m.C)
        wrong = np.zeros_like(A)
        wrong[h + k :, h : h + k] = omega[-1] ** 2 / omega
        product = (abs(A) + abs(np.linalg.solve(m.E, wrong))).T @ Y
        terms = product + product.T + Y @ G @ Y + H
        moved = np.sqrt(np.einsum("icab,ab->ic", self._functionals**2, terms**2))
        formed = abs(self.exact @ S) @ abs(np.linalg.inv(S))
        return math.sqrt(len(A)) * EPS * self._worst(moved + formed)

    def of_factor(self, Z: Block) -> tuple[float, float]:
        """What the residual of X = Z Z' leaves undecided, sum of |L_ij||W|, and that residual over |C'QC|, 2-norms.

        The residual is evaluated in :data:`DIGITS` digits, so nothing is shared with the solver but its answer.
        """
        space, _, S = self._plant
        with localcontext(prec=DIGITS):
            rows = _exact(np.vstack([Z.hand, Z.tall]))
            _, W = _residual(space, rows @ rows.T)
        moved = np.einsum("icab,ab->ic", abs(self._functionals), abs(S.T @ W @ S))
        size = float(np.linalg.norm(space.C.T @ space.Q @ space.C, 2))
        return self._worst(moved), float(np.linalg.norm(W, 2)) / size
