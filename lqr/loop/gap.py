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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.responses import Notify, Responses, causal, feedback_inputs, responses
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import descriptor_adjoint
from softgrasp.lqr.plant.problem import RiccatiProblem

ROUNDING = 1e-12  # of a cost: sums over the steps with the growing responses of the hand


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
