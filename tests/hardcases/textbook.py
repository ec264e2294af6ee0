"""The textbook ways that the hard cases are compared with, written as a textbook has them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse.linalg

from tests.hardcases.cases import Array, Outcome


def solve_twice(K: Any, f: Array, error: Callable[[Array], float]) -> Outcome:
    """Error of SciPy's sparse direct solve; in words that of CG to 1e-8 with the diagonal as preconditioner."""
    direct = error(scipy.sparse.linalg.spsolve(K.tocsc(), f))
    M = scipy.sparse.diags_array(1 / K.diagonal())
    z, stopped = scipy.sparse.linalg.cg(K, f, rtol=1e-8, maxiter=10 * len(f), M=M)
    return Outcome(direct, f"Jacobi-CG {error(z):.0e}" + (f", stops after {stopped} steps" if stopped else ""))


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


def leapfrog(M: Any, K: Any, D: Any, z: Array, dt: float, steps: int) -> Outcome:
    """Explicit central differences from rest; |E_N + lost - E_0| / E_0.

    v_(n+1/2) = v_(n-1/2) + dt M^-1 (-K z_n - D v_(n-1/2)), z_(n+1) = z_n + dt v_(n+1/2), stable for dt < 2 / omega_max.
    """
    solve = scipy.sparse.linalg.splu(M.tocsc()).solve
    start = energy = float(z @ (K @ z)) / 2
    v, lost = np.zeros_like(z), 0.0
    for n in range(steps):
        new = v + (dt / 2 if n == 0 else dt) * solve(-(K @ z) - D @ v)
        lost += dt * float(new @ (D @ new))
        # kinetic energy of both half steps, so that the energy belongs to z_n
        energy = (float(z @ (K @ z)) + float(new @ (M @ v) if n else 0.0)) / 2
        v = new
        z = z + dt * v
        if not energy + lost < 1e100 * start:
            return Outcome(math.inf, f"blows up, over 1e100 times the energy after {n + 1} steps")
    return Outcome(abs(energy + lost - start) / start)


def newmark(M: Any, K: Any, D: Any, z: Array, dt: float, steps: int) -> Outcome:
    """Newmark's rule with the average acceleration, gamma = 1/2, beta = 1/4, from rest; |E_N + lost - E_0| / E_0.

    (M + dt/2 D + dt^2/4 K) a_(n+1) = -K (z + dt v + dt^2/4 a)_n - D (v + dt/2 a)_n, stable for every dt.
    """
    solve = scipy.sparse.linalg.splu((M + dt * dt / 4 * K + dt / 2 * D).tocsc()).solve
    start = float(z @ (K @ z)) / 2
    v, lost = np.zeros_like(z), 0.0
    a = scipy.sparse.linalg.spsolve(M.tocsc(), -(K @ z))
    for _ in range(steps):
        old = v
        z, v = z + dt * v + dt * dt / 4 * a, v + dt / 2 * a
        a = solve(-(K @ z) - D @ v)
        z, v = z + dt * dt / 4 * a, v + dt / 2 * a
        middle = (old + v) / 2
        lost += dt * float(middle @ (D @ middle))
    energy = (float(z @ (K @ z)) + float(v @ (M @ v))) / 2
    return Outcome(abs(energy + lost - start) / start)


def summary_of(outcome: Outcome) -> str:
    """A number in one digit, or that there is none."""
    return "blows up" if outcome.value == math.inf else f"{outcome.value:.0e}"


def implicit_and_explicit(M: Any, K: Any, D: Any, z: Array, dt: float, steps: int) -> Outcome:
    """Newmark's rule, and in words what leapfrog does."""
    return Outcome(newmark(M, K, D, z, dt, steps).value, f"leapfrog {summary_of(leapfrog(M, K, D, z, dt, steps))}")


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
    M: Any, K: Any, G: Array, M_rigid: Array, M_hand: Array, impulse: Array, dt: float, steps: int, *, repeat: int = 50
) -> Outcome:
    """Hand and tissue solved in turn, repeated in every step with Aitken's relaxation; error of the momentum.

    M_hand a = u - r, r = G' z'' + M_rigid a; the tissue by the midpoint rule under the new a. The force acts in the
    first step only, so that afterwards the momentum of hand and tissue must stay u dt. With ``repeat = 1`` the hand
    takes the reaction of the last step.
    """
    s = 2 / dt
    solve = scipy.sparse.linalg.splu((K + s * s * M).tocsc()).solve
    inverse = np.linalg.inv(M_hand)
    z, v, v_s = np.zeros(len(G)), np.zeros(len(G)), np.zeros(len(M_hand))
    reaction = np.zeros(len(M_hand))
    for n in range(steps):
        push = impulse / dt if n == 0 else 0.0
        relax, last = 1.0, np.zeros_like(reaction)
        for i in range(repeat):
            a = inverse @ (push - reaction)
            w = solve(s * (M @ v) - K @ z - G @ a)
            new = 2 * s * w - v
            gap = G.T @ ((new - v) / dt) + M_rigid @ a - reaction
            if i > 0 and float((gap - last) @ (gap - last)) > 0:
                relax = -relax * float(last @ (gap - last)) / float((gap - last) @ (gap - last))
            reaction, last = reaction + relax * gap, gap
            if np.abs(gap).max() <= 1e-12 * np.abs(reaction).max():
                break
        z, v, v_s = z + 2 * w, new, v_s + dt * a
        if not np.abs(v_s).max() < 1e100:
            return Outcome(math.inf, f"blows up after {n + 1} steps")
    momentum = (M_hand + M_rigid) @ v_s + G.T @ v
    return Outcome(float(np.abs(momentum - impulse).max() / np.abs(impulse).max()))


def staggered(*arguments: Any) -> Outcome:
    """Hand and tissue in turn until they agree, and in words what one turn a step does."""
    agreed, once = staggered_hand(*arguments), staggered_hand(*arguments, repeat=1)
    return Outcome(agreed.value, f"once: {summary_of(once)}" if math.isfinite(agreed.value or 0.0) else agreed.text)
