"""Coulomb's law in 2D by an interior point method, for wide bodies with many nodes.

With a = (x_n, b_+, b_-, l), x_t = b_+ - b_-, and

    s = (y_n, y_t + l, l - y_t, mu x_n - b_+ - b_-),   0 <= a,  0 <= s,  a_i s_i = 0,   y = W x + q,

which is Coulomb's law as `lemke.py` has it, predictor and corrector [NW06] follow a_i s_i = tau as tau goes to 0. Each
step eliminates b and l from every node and factors one matrix of the size of W. Some 15 steps tell which nodes are
open, stick and slip, where Newton's method moves the borders of sets node by node, or finds none. Where friction of 10
and more couples all nodes to each other, the path may end before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from softgrasp.fem.obstacles.newton import OPEN, SLIP, STICK

Array = NDArray[Any]
STEPS = 40
SMALL = 1e-12  # mean product a_i s_i, scaled, that ends the path
LEAST = 1e-3  # friction of the path, at least: without any, b has no inside
SHORT = 0.9  # share of the way to the border that a step goes


def interior_sets(W: Array, q: Array, mu: Array) -> tuple[Array, NDArray[np.intc]] | None:
    """Forces (k, 2) near the law, and sets (k,) of their nodes; None where the path breaks off.

    Args:
        W: symmetric, positive definite, (2 k, 2 k).
        q: half the gap and half the slip without forces, (2 k,) [m].
        mu: coefficients of friction, (k,).
    """
    k, size, stiff = len(mu), float(np.abs(q).max(initial=0.0)), float(W.diagonal().mean())
    if not size > 0:
        return None
    A, p, m = W / stiff, q / size, np.maximum(mu, LEAST)
    a, s = np.ones((4, k)), np.ones((4, k))
    a[1:3] = m / 4
    for _ in range(STEPS):
        x = np.column_stack([a[0], a[1] - a[2]])
        y = (A @ x.ravel() + p).reshape(k, 2)
        lacks = np.array([y[:, 0], y[:, 1] + a[3], a[3] - y[:, 1], m * a[0] - a[1] - a[2]]) - s
        mean = float((a * s).mean())
        if mean < SMALL:
            break
        newton = _Newton(A, m, a, s, lacks)
        da, ds = newton.solve(-a * s)
        if not np.isfinite(da).all():
            return None
        step = min(_way(a, da), _way(s, ds))
        tau = mean * (float(((a + step * da) * (s + step * ds)).mean()) / mean) ** 3
        da, ds = newton.solve(tau - a * s - da * ds)
        step = min(1.0, SHORT * min(_way(a, da), _way(s, ds)))
        if not step > 0:
            return None
        a, s = a + step * da, s + step * ds
    kind = np.where(a[0] < s[0], OPEN, np.where(a[3] < s[3], STICK, SLIP)).astype(np.intc)
    return np.column_stack([a[0], a[1] - a[2]]) * (size / stiff), kind


def _way(a: Array, da: Array) -> float:
    """Share of da at which a first is 0."""
    shrinks = da < 0
    return float((-a[shrinks] / da[shrinks]).min(initial=1.0 / SHORT))


class _Newton:
    """The equations J da - ds = -lacks, s da + a ds = c of a step, for two right sides c."""

    def __init__(self, A: Array, m: Array, a: Array, s: Array, lacks: Array) -> None:
        self.A, self.m, self.a, self.s, self.lacks = A, m, a, s, lacks
        D, n, t = s / a, np.arange(0, len(A), 2), np.arange(1, len(A), 2)
        self.i, self.j = 1 / D[1], 1 / D[2]
        self.h = D[3] + self.i + self.j
        self.e = self.h / ((self.i + self.j) * D[3] + 4 * self.i * self.j)
        B = A.copy()
        B[n, n] += D[0]
        B[t, t] += self.e
        B[t, n] -= m * (self.i - self.j) / self.h * self.e
        self.factor = lu_factor(B, overwrite_a=True, check_finite=False)

    def solve(self, c: Array) -> tuple[Array, Array]:
        """Both changes, (4, k) each."""
        i, j, R = self.i, self.j, c / self.a - self.lacks
        own, right = R[3] + R[1] * i + R[2] * j, np.empty(len(self.A))
        right[0::2] = R[0]
        right[1::2] = (R[1] * i - R[2] * j - own * (i - j) / self.h) * self.e
        dx = lu_solve(self.factor, right, check_finite=False)
        dy = (self.A @ dx)[1::2]
        dl = (own - self.m * dx[0::2] - dy * (i - j)) / self.h
        da = np.array([dx[0::2], (R[1] - dy - dl) * i, (R[2] + dy - dl) * j, dl])
        return da, (c - self.s * da) / self.a
