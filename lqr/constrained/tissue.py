"""The tissue of a one-way plant in all its modes, and in a few shapes: static answers to the hand, then modes by cost.

One-way the tissue hears the hand through its acceleration a = M_s^{-1} (u - u_bar) alone, in full and in reduced form:

    eta'' + 2 delta eta' + omega^2 eta = -g a,    y_j = Y_j + q_s - q_bar + S_j eta

for the place y_j of node j, Y_j at the target, eta = 0 in equilibrium, 2 delta = alpha + beta omega^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.plant.checks import ControlError

INDEPENDENT = 1e-8  # of a column: what the others leave of it is rounding below


@dataclass(frozen=True)
class ModalTissue:
    """eta'' + (alpha + beta omega^2) eta' + omega^2 eta = -g a."""

    omega: Array  # natural frequencies [1/s], ascending, (k,)
    alpha: float  # mass-proportional damping [1/s]
    beta: float  # stiffness-proportional damping [s]
    g: Array  # coupling to the hand, (k, n_s)
    seen: Array  # S, displacement of the nodes in each mode, (nodes, d, k)
    c: Array  # outputs of the modes, (p, k)

    @property
    def delta(self) -> Array:
        """Decay of every mode without feedback [1/s], (k,)."""
        return np.asarray((self.alpha + self.beta * self.omega**2) / 2)

    def reduced(self, k: int) -> ModalTissue:
        """K^{-1} G and modes in the order |c|^2 |g|^2 / (delta omega^2), as k modes of their own.

        The static shapes make the answer to a constant acceleration exact.

        Raises ControlError: there are no k shapes.
        """
        n, n_s = self.g.shape
        if not n_s < k <= n:
            raise ControlError(f"a plan needs {n_s + 1} to {n} shapes of the tissue, not {k}")
        cost = np.sum(self.c**2, axis=0) * np.sum(self.g**2, axis=1) / (self.delta * self.omega**2)
        order = np.argsort(-cost, kind="stable")
        static = self.g / self.omega[:, None] ** 2
        shapes = np.linalg.qr(np.eye(n)[:, order[: k - n_s]])[0]
        for column in (static / np.linalg.norm(static, axis=0)).T:  # those that the modes leave something of
            for _ in range(2):
                column = column - shapes @ (shapes.T @ column)
            size = np.linalg.norm(column)
            if size > INDEPENDENT:
                shapes = np.column_stack([shapes, column / size])
        squares, T = np.linalg.eigh(shapes.T @ (self.omega[:, None] ** 2 * shapes))
        V = shapes @ T
        return ModalTissue(np.sqrt(squares), self.alpha, self.beta, V.T @ self.g, self.seen @ V, self.c @ V)

    def answer(self, a: Array, grid: float, parts: int) -> Array:
        """eta at the instants of all intervals under accelerations held from rest, exactly; (H, parts + 1, k).

        ``a``: acceleration u - u_bar over M_s of every interval [m/s2], (H, n_s).
        """
        root = np.sqrt((self.delta**2 - self.omega**2).astype(complex))
        root = np.where(np.abs(root) < 1e-6 * self.omega, 1e-6 * self.omega, root)  # equal roots, moved by 1e-12
        p, m = -self.delta + root, -self.delta - root
        s = grid * np.arange(parts + 1)[:, None] / parts
        slow, fast = np.exp(p * s), np.exp(m * s)
        eta, rate = np.zeros(len(p)), np.zeros(len(p))
        result = np.empty((len(a), parts + 1, len(p)))
        for k, static in enumerate(-(a @ self.g.T) / self.omega**2):
            first = (rate - m * (eta - static)) / (p - m)  # eta - static = first e^{ps} + second e^{ms}
            second = eta - static - first
            result[k] = (first * slow + second * fast).real + static
            eta, rate = result[k, -1], (p * first * slow[-1] + m * second * fast[-1]).real
        return result
