"""The textbook ways that the hard cases are compared with, written as a textbook has them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.sparse.linalg

from softgrasp.study.hardcases.cases import Array, Outcome


def conjugate_gradients(K: Any, f: Array) -> tuple[Array, int]:
    """SciPy's CG to a relative residual of 1e-8, at most 10 n iterations; solution and exit code."""
    z, info = scipy.sparse.linalg.cg(K, f, rtol=1e-8, maxiter=10 * len(f))
    return z, int(info)


def linear_triangles(nodes: Array, cells: Any, mu: float) -> tuple[Any, Array]:
    """Stiffness 2 mu eps:eps and weight for rho g = 1 downwards of linear triangles, dofs x, y of each node in turn.

    Assembled as in a first course: gradients by the inverse of each cell's map, no look at its area.
    """
    p = nodes[cells]
    J = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=2)
    area = np.linalg.det(J) / 2
    grad = np.array([[-1.0, -1.0], [1.0, 0.0], [0.0, 1.0]]) @ np.linalg.inv(J)
    B = np.zeros((len(cells), 3, 6))
    B[:, 0, 0::2], B[:, 1, 1::2] = grad[..., 0], grad[..., 1]
    B[:, 2, 0::2], B[:, 2, 1::2] = grad[..., 1], grad[..., 0]
    local = np.einsum("c,cai,ab,cbj->cij", area, B, mu * np.diag([2.0, 2.0, 1.0]), B)
    dofs = (2 * cells[:, :, None] + np.arange(2)).reshape(len(cells), 6)
    i, j = np.repeat(dofs, 6, axis=1).ravel(), np.tile(dofs, (1, 6)).ravel()
    n = 2 * len(nodes)
    f = np.bincount(2 * cells.ravel() + 1, weights=np.repeat(area / 3, 3), minlength=n)
    return scipy.sparse.csr_matrix((local.ravel(), (i, j)), shape=(n, n)), np.asarray(f, dtype=float)


def leapfrog(M: Any, K: Any, D: Any | None, z: Array, dt: float, steps: int) -> Outcome:
    """Explicit central differences from rest; |E_N + lost - E_0| / E_0.

    v_(n+1/2) = v_(n-1/2) + dt M^-1 (-K z_n - D v_(n-1/2)), z_(n+1) = z_n + dt v_(n+1/2), stable for dt < 2 / omega_max.
    """
    solve = scipy.sparse.linalg.splu(M.tocsc()).solve
    start = energy = float(z @ (K @ z)) / 2
    v, lost = np.zeros_like(z), 0.0
    for n in range(steps):
        force = -(K @ z)
        if D is not None:
            force = force - D @ v
        new = v + (dt / 2 if n == 0 else dt) * solve(force)
        if D is not None:
            lost += dt * float(new @ (D @ new))
        # kinetic energy of both half steps, so that the energy belongs to z_n
        energy = (float(z @ (K @ z)) + float(new @ (M @ v) if n else 0.0)) / 2
        v = new
        z = z + dt * v
        if not energy + lost < 1e100 * start:
            return Outcome(math.inf, f"blows up, over 1e100 times the energy after {n + 1} steps")
    return Outcome(abs(energy + lost - start) / start)


def textbook_midpoint(M: Any, K: Any, z: Array, dt: float, steps: int) -> float:
    """The implicit midpoint rule as usually written, M v computed anew in every step; |E_N - E_0| / E_0.

    (K + s^2 M) w = s M v_n - K z_n, z_(n+1) = z_n + 2 w, v_(n+1) = 2 s w - v_n, s = 2 / dt.
    """
    s = 2 / dt
    solve = scipy.sparse.linalg.splu((K + s * s * M).tocsc()).solve
    v = np.zeros_like(z)
    start = float(z @ (K @ z)) / 2
    for _ in range(steps):
        w = solve(s * (M @ v) - K @ z)
        z = z + 2 * w
        v = 2 * s * w - v
    return abs((float(z @ (K @ z)) + float(v @ (M @ v))) / 2 - start) / start


def staggered_hand(
    M: Any, K: Any, G: Array, M_rigid: Array, M_hand: Array, impulse: Array, dt: float, steps: int
) -> Outcome:
    """Hand and tissue solved in turn, the hand with the reaction of the last step; error of the momentum.

    M_hand a = u - r_(n-1), r = G' z'' + M_rigid a; the tissue by the midpoint rule under the new a. The force acts in
    the first step only, so that afterwards the momentum of hand and tissue must stay u dt.
    """
    s = 2 / dt
    solve = scipy.sparse.linalg.splu((K + s * s * M).tocsc()).solve
    inverse = np.linalg.inv(M_hand)
    z, v, v_s = np.zeros(len(G)), np.zeros(len(G)), np.zeros(len(M_hand))
    reaction = np.zeros(len(M_hand))
    for n in range(steps):
        a = inverse @ ((impulse / dt if n == 0 else 0.0) - reaction)
        w = solve(s * (M @ v) - K @ z - G @ a)
        new = 2 * s * w - v
        reaction = G.T @ ((new - v) / dt) + M_rigid @ a
        z, v, v_s = z + 2 * w, new, v_s + dt * a
        if not np.abs(v_s).max() < 1e100:
            return Outcome(math.inf, f"blows up after {n + 1} steps")
    momentum = (M_hand + M_rigid) @ v_s + G.T @ v
    return Outcome(float(np.abs(momentum - impulse).max() / np.abs(impulse).max()))
