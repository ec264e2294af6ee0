"""Coulomb's law as a linear complementarity problem, which Lemke's method solves at any friction, but for rounding.

With m directions d_j of the tangents that span them with positive shares, x_t = sum_j b_j d_j, a node has

    0 <= x_n,  y_n >= 0;   0 <= b_j,  d_j'y_t + l >= 0;   0 <= l,  mu x_n - sum_j b_j >= 0,   each pair complementary.

For W positive definite the method ends at a solution for every mu [AP97], but for rounding, seen with mu of 1000 and
more; where a node touches two obstacles W is singular, and there may be none. In 2D, d = +-1, that is Coulomb's law
itself; in 3D the cone is a pyramid, whose solution says which nodes slip and where: pyramids with more and more edges
there lead to the law itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
LARGEST = 1500  # unknowns: above, a solve would take a minute
SIDES = 2, 8  # directions of the tangents, by their number
ENOUGH = 40  # pivots over the number of unknowns
COVERS = 20  # covering vectors that are tried: with 5 rounding refused 1 of 480 ill-conditioned problems
ANEW = 30  # pivots after which the tableau is computed anew from its basis
LEAST = 1e-11  # entry of a scaled column that may be a pivot


def pyramid_forces(
    W: Array, q: Array, mu: Array, tangents: int, near: Array | None = None, turn: float = 1.0
) -> Array | None:
    """Forces x (k, 1 + tangents) of k nodes under the law with pyramids; None for many nodes, or by rounding.

    Args:
        W: symmetric, positive definite, (k (1 + tangents),) squared.
        q: half the gap and half the slip without forces, (k (1 + tangents),) [m].
        mu: coefficients of friction, (k,).
        near: in 3D, direction of the force of each node around which its pyramid has edges ``turn`` and 3 ``turn``
            apart [rad], (k, 2); all edges are the same angle apart where it is None or not a number.
    """
    k, s, sides = len(mu), 1 + tangents, SIDES[tangents - 1]
    if k * (2 + sides) > LARGEST:
        return None
    pyramids = np.array([_pyramid(tangents, sides, None if near is None else near[i], turn) for i in range(k)])
    pushed, sums = 1 + sides, k * (1 + sides)
    M, right = np.zeros((sums + k,) * 2), np.zeros(sums + k)
    size, stiff = float(np.abs(q).max(initial=0.0)), float(W.diagonal().mean())
    if not size > 0:
        return np.zeros((k, s))
    E = np.zeros((k * s, sums))  # x from x_n and the shares of each node
    for i, d in enumerate(pyramids):
        E[i * s, i * pushed] = 1.0
        E[i * s + 1 : (i + 1) * s, i * pushed + 1 : (i + 1) * pushed] = d.T
    most = np.maximum(mu, 1.0)
    M[:sums, :sums], right[:sums] = E.T @ (W / stiff) @ E, E.T @ (q / size)
    for i in range(k):
        shares = slice(i * pushed + 1, (i + 1) * pushed)
        M[shares, sums + i], M[sums + i, shares] = 1 / most[i], -1 / most[i]  # both sides of the law over mu
        M[sums + i, i * pushed] = mu[i] / most[i]
    rng = np.random.default_rng(k)  # covers without ties; another one where rounding makes a ray
    for _ in range(COVERS):
        z = lemke(M, right, rng.uniform(0.5, 1.5, len(right)))
        if z is not None:
            return (E @ z[:sums]).reshape(k, s) * (size / stiff)
    return None


def _pyramid(tangents: int, sides: int, near: Array | None, turn: float) -> Array:
    """Edges (sides, tangents) of a pyramid."""
    if tangents == 1:
        return np.array([[1.0], [-1.0]])
    angle = 2 * np.pi / sides * np.arange(sides)
    if near is not None and np.isfinite(near).all():
        around = np.array([0, turn, -turn, 3 * turn, -3 * turn, np.pi / 2, np.pi, -np.pi / 2])
        angle = np.arctan2(near[1], near[0]) + around
    return np.column_stack([np.cos(angle), np.sin(angle)])


def lemke(M: Array, q: Array, cover: Array) -> Array | None:
    """Z (n,) with z >= 0, M z + q >= 0, z'(M z + q) = 0; None on a ray, by rounding, or after too many pivots.

    Complementary pivots with a covering vector > 0, (n,).
    """
    n = len(q)
    if (q >= 0).all():
        return np.zeros(n)
    # w - M z - z_0 cover = q; columns w, z, z_0, and the values of the basis
    first = np.hstack([np.eye(n), -M, -cover[:, None], q[:, None]])
    T = first.copy()
    basis = np.arange(n)
    row, entering = int(np.argmin(q / cover)), 2 * n
    for count in range(1, ENOUGH * n):
        leaving = int(basis[row])
        T[row] /= T[row, entering]
        factor = T[:, entering].copy()
        factor[row] = 0.0
        T -= np.outer(factor, T[row])
        basis[row] = entering
        if leaving == 2 * n:
            z = np.zeros(2 * n)
            z[basis] = T[:, -1]
            return z[n:]
        entering = leaving + n if leaving < n else leaving - n
        if count % ANEW == 0:
            try:
                T = np.linalg.solve(first[:, basis], first)
            except np.linalg.LinAlgError:  # rounding chose a pivot that is none
                return None
        row = _ratio(T, entering, basis == 2 * n)
        if row < 0:
            return None
    return None


def _ratio(T: Array, entering: int, artificial: NDArray[np.bool_]) -> int:
    """The row that leaves when a column enters; -1 for a ray. The artificial variable goes first of equals."""
    column = T[:, entering]
    may = np.flatnonzero(column > LEAST * max(1.0, float(np.abs(column).max())))
    if not len(may):
        return -1
    ratios = np.maximum(T[may, -1], 0.0) / column[may]
    least = ratios.min()
    near = may[ratios <= least + 1e-13 * (1 + abs(least))]
    if artificial[near].any():
        return int(near[artificial[near]][0])
    return int(near[np.argmax(column[near])])  # the largest pivot, for its rounding
