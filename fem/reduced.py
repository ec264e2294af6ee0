"""Small dense systems E x' = A x + B u + f and their implicit midpoint steps, the same rule as that of the full model.

(E - dt/2 A) x_{n+1} = (E + dt/2 A) x_n + dt (B u_n + f)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array

STEPS = 8  # in one product: more would not gain at N = 30, where a product costs as much as the call
BLOCK_ENTRIES = 32_768  # of the matrix of several steps: 256 kB stay in a core's own cache


def midpoint_map(E: Array, A: Array, loads: Array, dt: float) -> Array:
    """[P, Q] of x_{n+1} = P x_n + Q u_n: (E - dt/2 A)^-1 [E + dt/2 A, dt loads], (..., N, N + m). Not collective.

    Args:
        E: matrix of the rates, (N, N).
        A: matrix of the states, (..., N, N), one or a stack.
        loads: matrix of the inputs, (..., N, m).
        dt: step [s].

    Raises:
        SolverError: E - dt/2 A is singular.
    """
    try:
        return np.linalg.solve(E - dt / 2 * A, np.concatenate([E + dt / 2 * A, dt * loads], axis=-1))
    except np.linalg.LinAlgError as error:
        raise SolverError(f"E - dt/2 A is singular at dt = {dt:g} s; take another step") from error


@dataclass(frozen=True)
class MidpointSteps:
    """Midpoint steps of E w' = A w + loads [u; 1], several in one product."""

    dt: float  # step [s]
    E: Array  # matrix of the rates, (n, n)
    A: Array  # matrix of the states, (n, n)
    loads: Array  # inputs and the constant load, (n, m + 1)

    @property
    def size(self) -> int:
        """Length k of w."""
        return len(self.E)

    @property
    def steps(self) -> int:
        """Steps b in one product with ``block``."""
        return int(np.clip(BLOCK_ENTRIES // max(self.size, 1) ** 2, 1, STEPS))

    @cached_property
    def matrix(self) -> Array:
        """One step, w_{n+1} = matrix [w_n; u_n; 1], (k, k + m + 1), C order. Raises SolverError: see midpoint_map."""
        matrix = midpoint_map(self.E, self.A, self.loads, self.dt)
        matrix[:, : self.size] = self.exact(matrix[:, : self.size], 1)
        return np.ascontiguousarray(matrix)

    def exact(self, P: Array, steps: int) -> Array:
        """P^steps with the entries overwritten that are known without rounding: here none."""
        return P

    @cached_property
    def block(self) -> Array:
        """[w_{n+1}; ...; w_{n+b}] = block [w_n; u_n; ...; u_{n+b-1}; 1], (b k, k + b m + 1), C order."""
        k, b, m = self.size, self.steps, self.loads.shape[1] - 1
        P, Q, f = self.matrix[:, :k], self.matrix[:, k:-1], self.matrix[:, -1]
        powers = [np.eye(k)]
        for i in range(1, b + 1):
            powers.append(self.exact(P @ powers[-1], i))
        block = np.zeros((b, k, k + b * m + 1))
        for i in range(b):
            block[i, :, :k] = powers[i + 1]
            block[i, :, -1] = sum(powers[: i + 1]) @ f
            for j in range(i + 1):
                block[i, :, k + j * m : k + (j + 1) * m] = powers[i - j] @ Q
        return block.reshape(b * k, -1)

    def march(self, inputs: Array, start: Array) -> Array:
        """States w of all steps, (steps + 1, k), for inputs (steps, m) and a start (k,)."""
        return np.asarray(march_together([self], inputs[None], start)[0])


def march_together(steps: Sequence[MidpointSteps], inputs: Array, start: Array) -> Array:
    """States (runs, steps + 1, k) for inputs (runs, steps, m) and one start (k,): one product for all runs a block.

    A row of the table is [w of the block; inputs of the next block; 1], so that a single run copies neither inputs nor
    results in the loop.

    ``steps``: one object for all runs, or one for each.
    """
    (runs, number, m), k, b = inputs.shape, steps[0].size, steps[0].steps
    blocks = -(-number // b)
    rows = np.zeros((blocks + 1, runs, b * k + b * m + 1))
    padded = np.zeros((runs, blocks * b, m))
    padded[:, :number] = inputs
    rows[:-1, :, b * k : -1] = padded.reshape(runs, blocks, b * m).swapaxes(0, 1)
    rows[:, :, -1] = 1.0
    rows[0, :, (b - 1) * k : b * k] = start
    before, after = rows[:-1, :, (b - 1) * k :], rows[1:, :, : b * k]
    if runs == 1:
        product, block = np.dot, steps[0].block
        for old, new in zip(list(before[:, 0]), list(after[:, 0]), strict=True):
            product(block, old, new)
    elif len(steps) == 1:
        right = np.ascontiguousarray(steps[0].block.T)
        for old, new in zip(before, after, strict=True):
            new[:] = old @ right
    else:
        stack = np.stack([s.block for s in steps])
        for old, new in zip(before, after, strict=True):
            new[:] = np.matmul(stack, old[:, :, None])[:, :, 0]
    states: Array = np.empty((runs, number + 1, k))
    states[:, 0] = start
    states[:, 1:] = after.swapaxes(0, 1).reshape(runs, blocks * b, k)[:, :number]
    return states
