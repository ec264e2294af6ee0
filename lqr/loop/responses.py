"""What the open plant answers to one step of every input: all gains of a plant are compared with these few runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.solve.solvers import ITERATIVE
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.loop.drive import OpenDrive
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopRun
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import Target

Notify = Callable[[int, int], None]
TOGETHER = 32  # states behind one product with the functionals


@dataclass(frozen=True)
class Responses:
    """f_n = W'x_n = free_n + sum_{k < n} kernel_{n-k} u_k of E x' = A x + B u, by the midpoint rule."""

    dt: float  # time step [s]
    kernel: Array  # W'x at the grid points under u_0 = e_j from rest, (steps + 1, f, n_s)
    free: Array  # W'x at the grid points from the start without input, (steps + 1, f)

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.free) - 1

    def part(self, columns: slice) -> Responses:
        """Some of the functionals."""
        return Responses(self.dt, self.kernel[:, columns], self.free[:, columns])

    def at_midpoints(self) -> Responses:
        """W'x_mid of step n = free_n + sum_{k <= n} kernel_{n-k} u_k, for n < steps."""
        return Responses(self.dt, (self.kernel[1:] + self.kernel[:-1]) / 2, (self.free[1:] + self.free[:-1]) / 2)


def causal(kernel: Array, x: Array) -> Array:
    """sum_{k <= n} kernel_{n-k} x_k for every n by FFT; kernel (steps, a, b), x (steps, b)."""
    steps = len(x)
    size = _fast_length(2 * steps)
    both = np.einsum("wab,wb->wa", np.fft.rfft(kernel, size, axis=0), np.fft.rfft(x, size, axis=0))
    return np.asarray(np.fft.irfft(both, size, axis=0)[:steps])


def _fast_length(n: int) -> int:
    """Least 2^a 3^b 5^c >= n; scipy.fft has a function for it and takes a tenth of a second to import."""
    bits, least = n.bit_length(), 1 << n.bit_length()
    for odd in (3**b * 5**c for b in range(bits) for c in range(bits)):
        least = min(least, odd << max(0, (-(-n // odd) - 1).bit_length()))
    return least


def loop_inputs(law: Responses, actuation: Actuation, u_bar: Array) -> Array:
    """Inputs u_n - u_bar of every step under u = u_bar + K (x - x_bar) as it reaches the hand; (steps, n_s).

    The same inputs as those of :mod:`softgrasp.lqr.loop.drive`, row by row: sampled, held, late and limited, or at the
    midpoint of every step, u_n = clip(u_bar + K (x_mid - x_bar)).

    Args:
        law: responses of K' at the grid points.
        u_bar: steady input [N, N m], (n_s,).

    Raises ControlError, SolverError: as the loop itself does, see :class:`softgrasp.lqr.loop.actuation.ImplicitInput`.
    """
    every = actuation.ticks(law.dt)
    with np.errstate(over="ignore", invalid="ignore"):  # of a gain that does not stabilise
        return _held(law, actuation, u_bar, every) if every else _implicit(law.at_midpoints(), actuation, u_bar)


def _implicit(law: Responses, actuation: Actuation, u_bar: Array) -> Array:
    """(I - kernel_0) u_n = free_n + sum_{k < n} kernel_{n-k} u_k, between the limits."""
    steps, n_s = law.free.shape
    bound, u = actuation.bound(n_s), np.zeros((steps, n_s))
    step, steady = ImplicitInput(law.kernel[0], bound), np.zeros(n_s) if bound is None else u_bar
    backwards, past = _backwards(law.kernel), u.reshape(-1)
    shift, end = steady - law.kernel[0] @ steady, (steps - 1) * n_s
    for n in range(steps):
        u[n] = step.solve(shift + law.free[n] + backwards[:, end - n * n_s : end] @ past[: n * n_s]) - steady
    return u


def _held(law: Responses, actuation: Actuation, u_bar: Array, every: int) -> Array:
    """w_{m + delay} = free + sum_{j < m} (sum of the kernel over tick m - j) w_j at tick m, between the limits."""
    n_s, delay = len(u_bar), actuation.delay
    bound, ticks = actuation.bound(n_s), -(-law.steps // every)
    low, high = (-np.inf, np.inf) if bound is None else (-bound - u_bar, bound - u_bar)
    whole = law.kernel[1 : 1 + (ticks - 1) * every].reshape(ticks - 1, every, n_s, n_s).sum(axis=1)
    backwards, end = _backwards(whole), (ticks - 1) * n_s
    w = np.clip(np.zeros((ticks + delay, n_s)), low, high)
    past = w.reshape(-1)
    for m in range(ticks):
        wish = law.free[m * every] + backwards[:, end - m * n_s :] @ past[: m * n_s]
        w[m + delay] = np.clip(wish, low, high)
    return np.repeat(w[:ticks], every, axis=0)[: law.steps]


def _backwards(kernel: Array) -> Array:
    """[kernel_last, .., kernel_0] side by side, (n_s, len n_s)."""
    n_s = kernel.shape[-1]
    return np.ascontiguousarray(kernel[::-1].transpose(1, 0, 2)).reshape(n_s, len(kernel) * n_s)


def responses(
    problem: RiccatiProblem,
    W: Block,
    start: Block,
    dt: float,
    steps: int,
    notify: Notify | None = None,
    loop: ClosedLoop | None = None,
) -> Responses:
    """One factor and n_s runs of the full plant, one more where the start moves by itself. Collective.

    Args:
        W: functionals as columns of the size of the state.
        start: x(0) as a difference to a state of rest, one column.
        notify: called with the number of steps done and in all.
        loop: a loop of the plant, whose factor serves if it is exact and of this step; None for none.

    Raises SolverError: a solve failed.
    """
    made: ClosedLoop | None = None
    if loop is None or loop.dt != dt or loop.solver.name in ITERATIVE or problem.system.own_load is not None:
        # differences of two states feel no own loads
        layers = tuple(replace(layer, load=None) for layer in problem.system.layers)
        loop = made = ClosedLoop(replace(problem, system=replace(problem.system, layers=layers)), dt)
    try:
        return _answers(loop.of_differences(), W, start, steps, notify)
    finally:
        if made is not None:
            made.destroy()


def _answers(loop: ClosedLoop, W: Block, start: Block, steps: int, notify: Notify | None) -> Responses:
    """See :func:`responses`. Collective."""
    n_s, n, comm = loop.problem.layout.n_s, loop.problem.layout.n_local, loop.problem.layout.comm
    rest = PlantState(np.zeros(n_s), np.zeros(n_s), np.zeros(n), np.zeros(n))
    begin = PlantState(*(part[:, 0] for part in start.parts))
    inputs = np.zeros((n_s + 1, steps, n_s))
    inputs[range(n_s), 0, range(n_s)] = 1.0
    runs = [(rest, u) for u in inputs[:n_s]]
    still = total(comm, np.array([np.abs(start.tall).sum()]))[0] == 0 and not begin.v_s.any()
    if not still:
        runs.append((begin, inputs[-1]))
    values = list[Array]()

    def progress(run: Any) -> None:
        if notify is not None:
            notify(len(values) * steps + run.reached, len(runs) * steps)

    for state, u in runs:
        values.append(_Record(loop, W, state, u, LoopOptions(progress=progress)).values())
    # a body displaced rigidly stays there
    free = np.tile(start.hand[:, 0] @ W.hand, (steps + 1, 1)) if still else values[-1]
    return Responses(loop.dt, np.stack(values[:n_s], axis=-1), free)


class _Record(LoopRun):
    """A run under given inputs that keeps W'x of every step."""

    def __init__(self, loop: ClosedLoop, W: Block, start: PlantState, inputs: Array, options: LoopOptions) -> None:
        self.W = W
        self.values_here = np.zeros((len(inputs) + 1, W.columns))
        self.recent = np.zeros((len(W.tall), TOGETHER), order="F")
        target = Target(start, np.zeros(inputs.shape[1]), np.zeros(len(loop.problem.C_s)))
        super().__init__(loop, OpenDrive(loop.plant, inputs), start, len(inputs), options, target)

    def record(self, n: int) -> None:
        """Keep the state until there are enough of them for one product."""
        place = n % TOGETHER
        self.recent[:, place] = self.state.array
        if place == TOGETHER - 1 or n == self.steps:
            np.matmul(self.recent[:, : place + 1].T, self.W.tall, out=self.values_here[n - place : n + 1])

    def values(self) -> Array:
        """Run, and W'x at the grid points, (steps + 1, f). Collective."""
        self.execute()
        hand = np.hstack([self.drive.q, self.drive.v])
        return np.asarray(total(self.problem.layout.comm, self.values_here) + hand @ self.W.hand)
