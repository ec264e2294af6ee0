"""Small dense systems E x' = A x + B u + f and their implicit midpoint steps, the same rule as that of the full model.

(E - dt/2 A) x_{n+1} = (E + dt/2 A) x_n + dt (B u_n + f)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from typing import Any, Self

import numpy as np

from softgrasp.fem.columns import TURNS, Columns, hand_of
from softgrasp.fem.errors import SoftgraspError, SolverError
from softgrasp.fem.petsc import Array
from softgrasp.fem.pymor import operator, port, pymor_models
from softgrasp.fem.shown import Card, Shown, drawn, listed

STEPS = 8  # in one product: more would not gain at N = 30, where a product needs the time of the call
BLOCK_ENTRIES = 32_768  # of the matrix of several steps: 256 kB stay in a core's own cache


class ReducedSystemError(SoftgraspError):
    """A reduced system has not what a call needs, or has no unique solution."""


def midpoint_map(E: Array, A: Array, loads: Array, dt: float) -> Array:
    """[P, Q] of x_{n+1} = P x_n + Q u_n: [1, 0] + dt (E - dt/2 A)^-1 [A, loads], (..., N, N + m). Not collective.

    P is (E - dt/2 A)^-1 (E + dt/2 A); written so, it keeps what A does not move, as the place of a free hand, exactly.

    Args:
        E: matrix of the rates, (N, N).
        A: matrix of the states, (..., N, N), one or a stack.
        loads: matrix of the inputs, (..., N, m).
        dt: step [s].

    Raises:
        SolverError: E - dt/2 A is singular.
    """
    try:
        both = np.linalg.solve(E - dt / 2 * A, dt * np.concatenate([A, loads], axis=-1))
    except np.linalg.LinAlgError as error:
        raise SolverError(f"E - dt/2 A is singular at dt = {dt:g} s; use another step") from error
    i = np.arange(A.shape[-1])
    both[..., i, i] += 1
    return both


@dataclass(frozen=True)
class MidpointSteps:
    """Midpoint steps of E w' = A w + loads [u; 1], several in one product."""

    dt: float  # step [s]
    E: Array  # matrix of the rates, (k, k)
    A: Array  # matrix of the states, (k, k)
    loads: Array  # matrix of the inputs and the constant load, (k, m + 1)

    @property
    def size(self) -> int:
        """Length k of w."""
        return len(self.E)

    @property
    def steps(self) -> int:
        """Number of steps b in one product with ``block``."""
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


@dataclass(frozen=True, repr=False)
class StateSpace(Shown):
    """E x' = A x + B u, y = C x, dense, of dimension N."""

    E: Array
    """Matrix of the rates, regular, (N, N)."""
    A: Array
    """Matrix of the states, (N, N)."""
    B: Array
    """Matrix of the inputs, (N, m); of force and torque on the hand m = n_s."""
    C: Array
    """Matrix of the outputs, (p, N)."""

    @property
    def N(self) -> int:
        """Dimension of the first-order system."""
        return len(self.A)


@dataclass(frozen=True, repr=False)
class ReducedSystem(StateSpace):
    """E x' = A x + B u + f, y = C x, q_s = S_q x, v_s = S_v x: hand and tissue in N coordinates, at one parameter.

    Transfer functions, closed loops and the objects of other packages are of deviations from a state of rest, in which
    the constant load f drops out.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> system = sg.reduce(model, sg.simulate(model), "craig_bampton", N=12).at()
    >>> system.inputs, system.transfer([1j]).shape
    (('force_x [N]', 'force_y [N]'), (1, 2, 2))
    """

    f: Array
    """Constant load of gravity, (N,)."""
    S_q: Array
    """Displacement of the hand, (n_s, N)."""
    S_v: Array
    """Velocity of the hand, (n_s, N)."""
    names: tuple[str, ...] = ()
    """Names of the outputs, "tip_x"; y_1.. where their number does not fit."""

    def card(self) -> Card:
        """Dimension, inputs and outputs."""
        rows = (("states", str(self.N)), ("inputs", listed(self.inputs)), ("outputs", listed(self.outputs)))
        return Card("ReducedSystem E x' = A x + B u + f, y = C x", rows)

    @property
    def n_s(self) -> int:
        """Degrees of freedom of the hand."""
        return len(self.S_q)

    @cached_property
    def hand_first(self) -> bool:
        """Whether the state begins with q_s [m, rad] and v_s [m/s, rad/s]."""
        one = np.eye(2 * self.n_s, self.N)
        return np.array_equal(np.vstack([self.S_q, self.S_v]), one)

    def midpoint(self, dt: float) -> MidpointSteps:
        """Its midpoint steps under the inputs u of the steps (steps, n_s). Not collective."""
        return MidpointSteps(dt, self.E, self.A, np.column_stack([self.B, self.f]))

    def rest_at(self, q_bar: Array) -> tuple[Array, Array]:
        """x_bar (N,) and u_bar (n_s,) with 0 = A x + B u + f and S_q x = q_bar.

        Raises ReducedSystemError: the system has no such state, or more than one.
        """
        K = np.block([[self.A, self.B], [self.S_q, np.zeros((self.n_s, self.n_s))]])
        scale = np.abs(K).max(axis=1)
        right = np.concatenate([-self.f, np.asarray(q_bar, dtype=np.float64)])
        if (scale == 0).any() or not np.linalg.cond(K / scale[:, None]) < 1e14:  # rounding: no digit would be right
            raise ReducedSystemError("the reduced plant has no unique state of rest for a position of the hand")
        solution = np.linalg.solve(K / scale[:, None], right / scale)
        return solution[: self.N], solution[self.N :]

    def transfer(self, s: Sequence[complex] | np.ndarray) -> np.ndarray:
        """Transfer function C (s E - A)^{-1} B at points s [1/s], (len(s), p, n_s)."""
        points = np.asarray(s, dtype=complex).reshape(-1, 1, 1)
        return np.asarray(
            self.C @ np.linalg.solve(points * self.E - self.A, np.broadcast_to(self.B, (len(points), *self.B.shape)))
        )

    def bode(self) -> Any:
        """Gain and phase from each input to each output, as ``matplotlib`` figure."""
        return drawn("system_bode", self)

    def under(self, K: Array) -> Self:
        """The closed loop u = K x + r with the extra load r as input. python-control's own functions use -K.

        Raises ReducedSystemError: K (n_s, N) does not fit, or is not finite.
        """
        shape = self.B.T.shape
        if K.shape != shape or not np.isfinite(K).all():
            raise ReducedSystemError(
                f"the gain has the shape {K.shape}; this plant needs finite numbers of shape {shape}"
            )
        return replace(self, A=self.A + self.B @ K)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states with their units, "q_x [m]"; those of the tissue have none."""
        hand = self._hand if self.hand_first else ()
        units = [(c.axis, c.unit) for c in hand]
        first = (*(f"q_{axis} [{unit}]" for axis, unit in units), *(f"v_{axis} [{unit}/s]" for axis, unit in units))
        return first + tuple(f"x_{i + 1}" for i in range(len(first), self.N))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs with their units, "force_x [N]", (n_s,)."""
        return tuple(f"{'torque' if c.rotation else 'force'}_{c.axis} [{c.load_unit}]" for c in self._hand)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs with their units, "tip_x [m]"."""
        return tuple(f"{name} [{'rad' if name.rsplit('_', 1)[-1] in TURNS else 'm'}]" for name in self._labels)

    @property
    def _labels(self) -> tuple[str, ...]:
        fits = len(self.names) == len(self.C)
        return self.names if fits else tuple(f"y_{i + 1}" for i in range(len(self.C)))

    @property
    def _hand(self) -> Columns:
        return hand_of(self.n_s, self._labels)

    def to_control(self) -> Any:
        """The system as ``control.StateSpace`` with named inputs, states and outputs.

        Raises ReducedSystemError: python-control is not installed.
        """
        try:
            control: Any = import_module("control")  # by name: optional, and without type hints
        except ImportError as error:
            raise ReducedSystemError("python-control is not installed; `pip install control` brings it") from error
        A, B = np.split(np.linalg.solve(self.E, np.hstack([self.A, self.B])), [self.N], axis=1)
        # python-control may drop states that it thinks uncontrollable, and its names have no dots
        names = {
            key: [name.replace(".", "_") for name in getattr(self, key)] for key in ("states", "inputs", "outputs")
        }
        D = np.zeros((len(self.C), B.shape[1]))
        return control.ss(A, B, self.C, D, remove_useless_states=False, **names)

    def to_drake(self, dt: float) -> Any:
        """Midpoint steps of dt [s] as ``pydrake.systems.primitives.LinearSystem`` of discrete time.

        Raises ReducedSystemError: Drake is not installed.
        """
        try:
            primitives: Any = import_module("pydrake.systems.primitives")  # as above
        except ImportError as error:
            raise ReducedSystemError("Drake is not installed; `pip install drake` brings it") from error
        steps = self.midpoint(dt).matrix
        D = np.zeros((len(self.C), self.n_s))
        return primitives.LinearSystem(steps[:, : self.N], steps[:, self.N : -1], self.C, D, dt)

    def to_pymor(self) -> Any:
        """The system as ``pymor.models.iosys.LTIModel``, without its constant load, in programs of one rank.

        The operators B and C are called as their columns and rows, with units.

        Raises SoftgraspError: pyMOR is not installed, or the program runs on several ranks.
        """
        models = pymor_models()
        E, A = (operator([((), 0, X)], 1, name) for X, name in ((self.E, "E"), (self.A, "A")))
        return models.LTIModel(A, port(self.B, self.inputs), port(self.C, self.outputs), E=E, name=type(self).__name__)
