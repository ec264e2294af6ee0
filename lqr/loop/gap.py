"""How much more than the least cost a feedback can cost, proved by the duality gap of its own run.

The run of N steps of the midpoint rule with u_n = K_hat x_mid costs

    J(u) = sum_n dt (y_n'Q y_n + u_n'R u_n) + |Z'E x_N|^2,    y_n = C x_mid,

the last term being what the Riccati solution X = ZZ' says is to come after t = N dt. J is a convex quadratic function
of all inputs, J(u + d) >= J(u) + 2 dt sum_n d_n'r_n + dt sum_n d_n'R d_n, so that for the input u* of least cost

    J(u) - J(u*) <= dt sum_n r_n'R^{-1} r_n,    r_n = R u_n + B'p_n,

with the adjoint state p of the midpoint rule, (E - dt/2 A)'p_{n-1} = (E + dt/2 A)'p_n + dt/2 C'Q (y_{n-1} + y_n), which
begins at the end with 2 (E - dt/2 A)'p_{N-1} = dt C'Q y_{N-1} + 2 E'Z Z'E x_N: weak duality of the linear-quadratic
problem. Nothing is assumed of Z, and no constant of stability enters. Every run gives such a lower bound of min J, and
the best of them serves all: beside the optimal run, whose gap is rounding, J(u) - max (J - gap) is the excess of any
other.

The midpoint rule keeps quadratic balances, so with X exact J(u*) is the optimal cost of the continuous problem without
end, for every dt. The proof covers the run to t = N dt and the optimal feedback after it; for a loop that goes on with
its own gain the bound has room for an excess after the end that is as many times what is to come as J(u) is min J.

B'p needs no run of the adjoint: by reciprocity it is the correlation of y with the responses of y to the inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.fft

from softgrasp.fem.petsc import Array, total
from softgrasp.lqr.loop.drive import OpenDrive
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopRun
from softgrasp.lqr.plant.gain import Block, Gain, PlantState
from softgrasp.lqr.plant.operators import descriptor_adjoint
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import Target

Notify = Callable[[int, int], None]
TOGETHER = 32  # states behind one product with the functionals
ROUNDING = 1e-12  # of a cost: sums over the steps with the growing responses of the hand


@dataclass(frozen=True)
class Responses:
    """f_n = W'x_n = free_n + sum_{k < n} kernel_{n-k} u_k of E x' = A x + B u, by the midpoint rule."""

    dt: float  # step [s]
    kernel: Array  # W'x at the grid points after u_0 = e_j, at rest before, (steps + 1, f, n_s)
    free: Array  # W'x from the start without input, (steps + 1, f)

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
    size = scipy.fft.next_fast_len(2 * steps, real=True)
    both = np.einsum("wab,wb->wa", scipy.fft.rfft(kernel, size, axis=0), scipy.fft.rfft(x, size, axis=0))
    return np.asarray(scipy.fft.irfft(both, size, axis=0)[:steps])


def feedback_inputs(law: Responses) -> Array:
    """u_n = K x_mid of every step, from the responses of K' at the midpoints; (steps, n_s).

    Row by row of (I - kernel_0) u_n = free_n + sum_{k < n} kernel_{n-k} u_k.
    """
    steps, n_s = law.free.shape
    inverse = np.linalg.inv(np.eye(n_s) - law.kernel[0])
    backwards = np.ascontiguousarray(law.kernel[::-1].transpose(1, 0, 2)).reshape(n_s, steps * n_s)
    u = np.zeros((steps, n_s))
    past, end = u.reshape(-1), (steps - 1) * n_s
    with np.errstate(over="ignore", invalid="ignore"):  # of a gain that does not stabilise
        for n in range(steps):
            u[n] = inverse @ (law.free[n] + backwards[:, end - n * n_s : end] @ past[: n * n_s])
    return u


def responses(
    problem: RiccatiProblem, W: Block, start: Block, dt: float, steps: int, notify: Notify | None = None
) -> Responses:
    """One factor and n_s runs of the full plant, one more where the start moves by itself. Collective.

    Args:
        W: functionals as columns of the size of the state.
        start: x(0) as a difference to a state of rest, one column.
        notify: called with the number of steps done and in all.

    Raises SolverError: a solve failed.
    """
    n_s, n = problem.layout.n_s, problem.layout.n_local
    # differences of two states feel no gravity
    problem = replace(problem, system=replace(problem.system, gravity=None, hand_weight=False))
    rest = PlantState(np.zeros(n_s), np.zeros(n_s), np.zeros(n), np.zeros(n))
    begin = PlantState(*(part[:, 0] for part in start.parts))
    inputs = np.zeros((n_s + 1, steps, n_s))
    inputs[range(n_s), 0, range(n_s)] = 1.0
    runs = [(rest, u) for u in inputs[:n_s]]
    still = total(problem.layout.comm, np.array([np.abs(start.tall).sum()]))[0] == 0 and not begin.v_s.any()
    if not still:
        runs.append((begin, inputs[-1]))
    loop, values = ClosedLoop(problem, dt), list[Array]()

    def progress(run: Any) -> None:
        if notify is not None:
            notify(len(values) * steps + run.reached, len(runs) * steps)

    try:
        for state, u in runs:
            values.append(_Record(loop, W, state, u, LoopOptions(progress=progress)).values())
    finally:
        loop.destroy()
    # a body displaced rigidly stays there
    free = np.tile(start.hand[:, 0] @ W.hand, (steps + 1, 1)) if still else values[-1]
    return Responses(dt, np.stack(values[:n_s], axis=-1), free)


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


@dataclass(frozen=True)
class DualityGap:
    """Proved bound on the excess cost of one run."""

    gap: float  # J(u) - min J is at most this; infinite when the run diverges
    cost: float  # J(u) with what is to come
    least: float  # proved lower bound of min J, J - gap of this run or of a better one from the same start
    to_come: float  # |Z'E x_N|^2, what is to come after the end
    end: float  # N dt [s]

    @property
    def cost_excess_proved(self) -> float:
        """Bound on J(u) / min J - 1 of the run and the optimal feedback after it; infinite without a lower bound."""
        return self._excess(0.0)

    @property
    def cost_excess_at_most(self) -> float:
        """The same for a loop that goes on with its own gain: with room for what is to come, which is an allowance."""
        return self._excess(self.to_come * self.cost / self.least if self.least > 0 else 0.0)

    def _excess(self, after: float) -> float:
        if not (self.least > 0 and np.isfinite(self.gap)):
            return float("inf")
        return min(self.gap, self.cost - self.least + after + ROUNDING * self.cost) / self.least


def duality_gaps(
    problem: RiccatiProblem,
    gains: Sequence[Gain],
    start: Block,
    dt: float,
    steps: int,
    factor: Block | None = None,
    notify: Notify | None = None,
) -> tuple[DualityGap, ...]:
    """Duality gaps of the runs under some gains from one start. Collective.

    One factor and n_s runs of the full plant serve all gains; each gain then takes O(steps^2) operations with what the
    plant answers to an input of one step.

    Args:
        problem: plant, outputs and weights; it has a hand.
        gains: u = K_hat x at the midpoint of every step.
        start: x(0) minus target, one column.
        factor: Z; None takes the cost up to the end alone.
        notify: called with the number of steps done and in all.

    Raises SolverError: a solve failed.
    """
    p, n_s, n = len(problem.Q), problem.layout.n_s, problem.layout.n_local
    hand, tall = np.zeros((2 * n_s, p)), np.zeros((2 * n, p))
    hand[:n_s], tall[:n] = problem.C_s.T, problem.C_z
    parts = [Block(hand, tall), *(gain.block for gain in gains)]
    if factor is not None:
        parts.append(descriptor_adjoint(problem, factor))
    seen = responses(problem, Block.join(parts), start, dt, steps, notify)
    first = p + len(gains) * n_s
    outputs, end = seen.part(slice(p)).at_midpoints(), seen.part(slice(first, None))
    laws = (seen.part(slice(p + i * n_s, p + (i + 1) * n_s)) for i in range(len(gains)))
    runs = [run_gap(outputs, end, feedback_inputs(law.at_midpoints()), problem.Q, problem.R) for law in laws]
    least = max((run.least for run in runs if np.isfinite(run.gap)), default=-np.inf)
    return tuple(replace(run, least=least) for run in runs)


def run_gap(outputs: Responses, end: Responses, u: Array, Q: Array, R: Array) -> DualityGap:
    """The duality gap of any inputs.

    Args:
        outputs: responses of y at the midpoints.
        end: responses of Z'E x at the grid points; without columns there is nothing to come.
        u: inputs, (steps, n_s).
    """
    dt, steps = outputs.dt, len(u)
    if not np.isfinite(u).all():
        return DualityGap(np.inf, np.inf, -np.inf, np.inf, dt * steps)
    y = outputs.free + causal(outputs.kernel, u)
    reach = end.kernel[:0:-1]  # of Z'E x_N to the input of every step
    last = end.free[-1] + np.einsum("kij,kj->i", reach, u)
    slope = causal(outputs.kernel.transpose(0, 2, 1), (y @ Q)[::-1])[::-1] + np.einsum("kij,i->kj", reach, last) / dt
    r = u @ R + slope
    gap = dt * float(np.sum(r * np.linalg.solve(R, r.T).T))
    to_come = float(last @ last)
    cost = dt * float(np.sum((y @ Q) * y) + np.sum((u @ R) * u)) + to_come
    return DualityGap(gap, cost, cost - gap, to_come, dt * steps)
