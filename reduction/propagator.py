"""The midpoint rule of small models as one small matrix, w_{n+1} = P w_n + Q u_n, several steps in one product.

The implicit midpoint rule of the full model, (E - dt/2 A) x_{n+1} = (E + dt/2 A) x_n + dt (B u_n + f), in coordinates
in which the energy of the tissue is |w|^2 / 2: rounding in a step then is small against the energy, and P of a damped
model is a contraction. An undamped structured block is turned into plane rotations [HLW06, IX.1] whose c^2 + s^2 = 1 to
far below eps, so that the energy neither grows nor decays systematically over any number of steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fem.petsc import Array
from reduction.model import ModelError, SmallModel
from reduction.spectrum import balanced, energy_factor, is_skew, skew_modes

STEPS = 8  # in one product: more would not gain at N = 30, where a product costs as much as the call
BLOCK_ENTRIES = 32_768  # of the matrix of several steps: 256 kB stay in a core's own cache

SLOW = 0.01  # sine or cosine below which one unit in the last place of the other turns by 1e-12 of the angle


@dataclass(frozen=True)
class Propagator:
    """One step in energy coordinates, w_{n+1} = matrix [w_n; u_n; 1], and b of them at once.

    Attributes:
        model: what it steps.
        dt: step [s].
        matrix: (k, k + m + 1) for m inputs, C order.
        block: [w_{n+1}; ...; w_{n+b}] = block [w_n; u_n; ...; u_{n+b-1}; 1], (b k, k + b m + 1), C order.
        X: x = X w, (N or the tissue's own coordinates, k).
        X_inverse: w = X_inverse x.
        driven: the hand is prescribed: w holds the tissue only, and the inputs are the hand's in a step.
    """

    model: SmallModel
    dt: float
    matrix: Array
    block: Array
    X: Array
    X_inverse: Array
    driven: bool = False

    @property
    def size(self) -> int:
        """Length k of w."""
        return len(self.matrix)

    @property
    def steps(self) -> int:
        """Steps b in one product with ``block``."""
        return len(self.block) // len(self.matrix)


def rotation(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine whose squares add up to 1 to about 1e-18, at worst (near 45 degrees) 1e-16.

    Plain rounding leaves |c^2 + s^2 - 1| ~ 1e-16, a systematic growth of 1e-11 over 1e5 steps. Here the larger of the
    two moves by units in the last place and the smaller one follows on the circle; the angle changes by less than
    1e-12 of itself. Below :data:`SLOW` that cannot be had, and the angle stays as it is.
    """
    wide = np.longdouble  # 64 bits of mantissa or more; where it is a plain double the growth stays at rounding
    c, s = np.cos(angle), np.sin(angle)
    large, small = np.where(np.abs(c) > np.abs(s), c, s), np.where(np.abs(c) > np.abs(s), s, c)
    moves = np.array(sorted(range(-200, 201), key=abs), dtype=float)
    larges = large[:, None] + moves * np.spacing(np.abs(large))[:, None]
    squares = np.maximum(1 - larges.astype(wide) ** 2, 0)
    smalls = np.copysign(np.sqrt(squares), small[:, None]).astype(float)
    defects = np.abs(squares - smalls.astype(wide) ** 2)
    # the smallest move that does, else the best one
    best = np.where((defects < 1e-18).any(axis=1), (defects < 1e-18).argmax(axis=1), defects.argmin(axis=1))
    rows, fast = np.arange(len(c)), np.abs(small) > SLOW
    large, small = np.where(fast, larges[rows, best], large), np.where(fast, smalls[rows, best], small)
    swap = np.abs(c) > np.abs(s)
    return np.where(swap, large, small), np.where(swap, small, large)


def _coordinates(model: SmallModel, block: slice) -> tuple[Array, Array, Array]:
    """X with x = X w, its inverse, and omega of the modes of a conservative block (empty when there is none).

    Modes come as pairs in the block's first coordinates.
    """
    op, N = model.operators, model.N
    X, X_inverse, omega = np.eye(N), np.eye(N), np.zeros(0)
    if not model.fixed_solid:
        return X, X_inverse, omega
    L = energy_factor(op.energy[block, block])
    if L is None:
        return X, X_inverse, omega
    U = np.eye(len(L))
    if model.structured and not model.two_way:
        S = balanced(op.E[block, block], op.A[block, block], L)
        if is_skew(S):
            U, omega = skew_modes((S - S.T) / 2)
    X[block, block] = np.linalg.solve(L.T, U)
    X_inverse[block, block] = U.T @ L.T
    return X, X_inverse, omega


def _rotate(P: Array, first: int, angle: Array, often: bool) -> None:
    """Overwrite the modes of a conservative block by plane rotations, well rounded ones if applied again and again."""
    c, s = rotation(angle) if often else (np.cos(angle), np.sin(angle))
    i, end = first + 2 * np.arange(len(angle)), first + 2 * len(angle)
    P[first:end, first:end] = 0.0
    P[i, i], P[i, i + 1], P[i + 1, i], P[i + 1, i + 1] = c, -s, s, c


def propagator(model: SmallModel, dt: float, driven: bool = False) -> Propagator:
    """Precompute a step of size dt. Online; not collective.

    Args:
        model: the small model.
        dt: step [s].
        driven: the hand follows a table instead of a force; needs fixed solid modes. The inputs of a step are then
            [mean q_s, mean v_s, mean a_s].

    Raises:
        ModelError: E or the midpoint matrix is singular, or ``driven`` without fixed solid modes.
    """
    op, k = model.operators, 2 * model.n_s
    if driven and not model.fixed_solid:
        raise ModelError(f"{model.name}: the hand is inside the basis, so it cannot be prescribed; give a force")
    model.check_independent()
    tissue = slice(k, model.N)
    X, X_inverse, omega = _coordinates(model, tissue)
    E, A, n_s = op.E, op.A, model.n_s
    if driven:
        X, X_inverse, first = X[tissue, tissue], X_inverse[tissue, tissue], 0
        # E_yq q_s' with q_s' = mean v_s, E_yv v_s' with v_s' = mean a_s
        inputs = np.hstack([A[tissue, :n_s], A[tissue, n_s:k] - E[tissue, :n_s], -E[tissue, n_s:k]])
        f = model.f[tissue]
        E, A = E[tissue, tissue], A[tissue, tissue]
    else:
        first, inputs, f = k, op.B, model.f
    loads = np.hstack([inputs, f[:, None]])
    implicit = (E - dt / 2 * A) @ X
    try:
        matrix = np.linalg.solve(implicit, np.hstack([(E + dt / 2 * A) @ X, dt * loads]))
    except np.linalg.LinAlgError as error:
        raise ModelError(f"{model.name}: E - dt/2 A is singular at dt = {dt:g} s; take another step") from error
    angle = 2 * np.arctan(omega * dt / 2)
    free = n_s if model.fixed_solid and not model.two_way and not driven else 0

    def exact(P: Array, steps: int) -> Array:
        """Entries of P^steps that are known: rotations, and the free hand."""
        if len(omega):
            _rotate(P, first, steps * angle, steps in (1, count))
        if free:
            P[:k] = 0.0
            P[:k, :k] = np.eye(k) + np.diag(np.full(free, steps * dt), free)
        return P

    size = len(X)
    count = int(np.clip(BLOCK_ENTRIES // max(size, 1) ** 2, 1, STEPS))
    matrix[:, :size] = exact(matrix[:, :size], 1)
    block = several(matrix, count, exact)
    return Propagator(model, dt, np.ascontiguousarray(matrix), block, X, X_inverse, driven)


def several(matrix: Array, steps: int, exact: Callable[[Array, int], Array]) -> Array:
    """Matrix of several steps from that of one, [P Q f]; ``exact`` corrects the powers of P."""
    k, m = len(matrix), matrix.shape[1] - len(matrix) - 1
    P, Q, f = matrix[:, :k], matrix[:, k:-1], matrix[:, -1]
    powers = [np.eye(k)]
    for i in range(1, steps + 1):
        powers.append(exact(P @ powers[-1], i))
    block = np.zeros((steps, k, k + steps * m + 1))
    for i in range(steps):
        block[i, :, :k] = powers[i + 1]
        block[i, :, -1] = sum(powers[: i + 1]) @ f
        for j in range(i + 1):
            block[i, :, k + j * m : k + (j + 1) * m] = powers[i - j] @ Q
    return block.reshape(steps * k, -1)


def march(step: Propagator, inputs: Array, start: Array) -> Array:
    """States w of all steps, (steps + 1, k), for inputs (steps, m) and a start (k,): one small product a block.

    A row of the table is [w of the block; inputs of the next block; 1], so that neither inputs nor results are copied
    in the loop.
    """
    k, b, (steps, m) = step.size, step.steps, inputs.shape
    blocks = -(-steps // b)
    rows = np.zeros((blocks + 1, b * k + b * m + 1))
    padded = np.zeros((blocks * b, m))
    padded[:steps] = inputs
    rows[:-1, b * k : -1] = padded.reshape(blocks, b * m)
    rows[:, -1] = 1.0
    rows[0, (b - 1) * k : b * k] = start
    product, block = np.dot, step.block
    for old, new in zip(list(rows[:-1, (b - 1) * k :]), list(rows[1:, : b * k]), strict=True):
        product(block, old, new)
    states = np.empty((steps + 1, k))
    states[0] = start
    states[1:] = rows[1:, : b * k].reshape(-1, k)[:steps]
    return states
