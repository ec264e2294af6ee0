"""How much more than the least cost a feedback can cost, proved by the duality gap of its own run.

A run of N steps of the midpoint rule has, whatever its inputs u_n, the cost

    J(u) = sum_n dt (y_n'Q y_n + u_n'R u_n) + |Z'E x_N|^2,    y_n = C x_mid,

the last term being the optimal cost after t = N dt by the Riccati solution X = ZZ'. J is a convex quadratic function
of all inputs, J(u + d) >= J(u) + 2 dt sum_n d_n'r_n + dt sum_n d_n'R d_n, so that for the input u* of least cost

    J(u) - J(u*) <= dt sum_n r_n'R^{-1} r_n,    r_n = R u_n + B'p_n,

with the adjoint state p of the midpoint rule, (E - dt/2 A)'p_{n-1} = (E + dt/2 A)'p_n + dt/2 C'Q (y_{n-1} + y_n), which
begins at the end with 2 (E - dt/2 A)'p_{N-1} = dt C'Q y_{N-1} + 2 E'Z Z'E x_N: weak duality of the linear-quadratic
problem. Nothing is assumed of Z or of the inputs, and no constant of stability enters: the loop is bounded as it runs,
sampled, held, late and limited, against the least cost of all inputs, which need not wait, be held or keep a limit.
Every run gives such a lower bound of min J, and the best of them serves all: beside the run of the optimal law at the
midpoints, whose gap is rounding, J(u) - max (J - gap) is the excess of any other.

The midpoint rule keeps quadratic balances, so with X exact J(u*) is the optimal cost of the continuous problem without
end, for every dt, and J(u) - J(u*) = dt sum_n |u_n - K x_mid|_R^2 with the optimal K, which loses no digits.

The proof covers the run to t = N dt and the optimal feedback after it. For a loop that goes on with its own law there
is an allowance, no proof: five times what is to come and as many times as J(u) is min J, or as often as twice what the
last half or quarter of the run lost for each unit by which what is to come fell; the larger one.

B'p needs no run of the adjoint: by reciprocity it is the correlation of y with the responses of y to the inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.full import ClosedLoop
from softgrasp.lqr.loop.responses import Notify, Responses, causal, loop_inputs, responses
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import descriptor_adjoint
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution

ROUNDING = 1e-12  # of a cost: sums over the steps with the growing responses of the hand
TIMES = 5  # what is to come under the optimal law, that of the loop's own way may be more; 2.3 seen in random loops
SHARE, LITTLE = 0.1, 1e-6  # of the excess and of the least cost, an allowance that no run is made longer for


@dataclass(frozen=True)
class Course:
    """Start, duration and actuation that all loops of a comparison share."""

    start: Block  # x(0) minus target, hand (2 n_s, 1), local rows (2 n_local, 1)
    dt: float  # step of the midpoint rule [s]
    steps: int  # number of time steps
    actuation: Actuation = field(default_factory=Actuation)  # sampling, delay and limits
    u_bar: Array | None = None  # steady input at the target, (n_s,) [N, N m]; None for none


@dataclass(frozen=True)
class DualityGap:
    """Proved bound on the excess cost of one run."""

    gap: float  # proved upper bound of J(u) - min J; infinite when the run diverges
    cost: float  # cost J(u), the optimal cost after the end included
    least: float  # proved lower bound of min J: J - gap of this run or of a better one from the same start
    to_come: float  # optimal cost |Z'E x_N|^2 after the end
    end: float  # length N dt of the run [s]
    after: float = 0.0  # allowance for the excess cost after the end; infinite where ``to_come`` does not fall
    excess: float = float("nan")  # relative excess dt sum |u - K x_mid|_R^2 / |Z'E x_0|^2; nan without an optimal law

    @property
    def cost_excess_proved(self) -> float:
        """Bound on J(u) / min J - 1 of the run and the optimal feedback after it; infinite without a lower bound."""
        return self._excess(0.0)

    @property
    def cost_excess_at_most(self) -> float:
        """The same for a loop that goes on with its own law: with an allowance for its cost after the end."""
        return self._excess(self.after)

    @property
    def settled(self) -> bool:
        """Whether the allowance is no larger than :data:`SHARE` of the excess, or :data:`LITTLE` of the least cost."""
        return self.after <= max(SHARE * (self.cost - self.least), LITTLE * self.least)

    def _excess(self, after: float) -> float:
        if not (self.least > 0 and np.isfinite(self.gap)):
            return float("inf")
        return (min(self.gap, self.cost - self.least + ROUNDING * self.cost) + after) / self.least


def duality_gaps(
    problem: RiccatiProblem,
    gains: Sequence[Gain],
    course: Course,
    solution: RiccatiSolution | None = None,
    notify: Notify | None = None,
    loop: ClosedLoop | None = None,
) -> tuple[DualityGap, ...]:
    """Duality gaps of the loops under some gains, as they run from one start. Collective.

    One factor and n_s runs of the full plant serve all gains; each gain then needs O(steps^2) operations with what the
    plant answers to an input of one step.

    Args:
        problem: plant, outputs and weights; it has a hand.
        gains: u = u_bar + K_hat (x - x_bar) as the course samples, holds, delays and limits it.
        solution: Z, and the optimal law, whose own run gives the best lower bound of the least cost; None: with the
            cost up to the end alone.
        notify: called with the number of steps done and in all.
        loop: see :func:`softgrasp.lqr.loop.responses.responses`.

    Raises SolverError: a solve failed.
    """
    p, n_s, n = len(problem.Q), problem.layout.n_s, problem.layout.n_local
    hand, tall = np.zeros((2 * n_s, p)), np.zeros((2 * n, p))
    hand[:n_s], tall[:n] = problem.C_s.T, problem.C_z
    every = [*gains] if solution is None else [*gains, solution.gain]
    parts = [Block(hand, tall), *(gain.block for gain in every)]
    if solution is not None:
        parts.append(descriptor_adjoint(problem, solution.factor))
    seen = responses(problem, Block.join(parts), course.start, course.dt, course.steps, notify, loop)
    first = p + len(every) * n_s
    outputs, end = seen.part(slice(p)).at_midpoints(), seen.part(slice(first, None))
    laws = [seen.part(slice(p + i * n_s, p + (i + 1) * n_s)) for i in range(len(every))]
    best = None if solution is None else laws[-1].at_midpoints()
    runs = [run_gap(outputs, end, inputs_of(law, course), problem.Q, problem.R, best) for law in laws[: len(gains)]]
    bounds = [run.least for run in runs if np.isfinite(run.gap)]
    if best is not None:
        optimal = loop_inputs(laws[-1], Actuation(), np.zeros(n_s))
        bounds.append(run_gap(outputs, end, optimal, problem.Q, problem.R).least)
    least = max(bounds, default=-np.inf)
    return tuple(replace(run, least=least) for run in runs)


def inputs_of(law: Responses, course: Course) -> Array:
    """Inputs u - u_bar of every step, (steps, n_s); infinite where the loop has no input of a step."""
    shape = law.steps, law.free.shape[1]
    try:
        return loop_inputs(law, course.actuation, np.zeros(shape[1]) if course.u_bar is None else course.u_bar)
    except (ControlError, SolverError):
        return np.full(shape, np.inf)


def run_gap(
    outputs: Responses, end: Responses, u: Array, Q: Array, R: Array, best: Responses | None = None
) -> DualityGap:
    """The duality gap of any inputs.

    Args:
        outputs: responses of y at the midpoints.
        end: responses of Z'E x at the grid points; without columns there is nothing to come.
        u: inputs minus the steady one, (steps, n_s).
        best: responses of the optimal law at the midpoints, for the excess.
    """
    dt, steps = outputs.dt, len(u)
    if not np.isfinite(u).all():
        return DualityGap(np.inf, np.inf, -np.inf, np.inf, dt * steps, np.inf, np.inf)
    y = outputs.free + causal(outputs.kernel, u)
    reach = end.kernel[:0:-1]  # of Z'E x_N to the input of every step
    last = end.free[-1] + np.einsum("kij,kj->i", reach, u)
    slope = causal(outputs.kernel.transpose(0, 2, 1), (y @ Q)[::-1])[::-1] + np.einsum("kij,i->kj", reach, last) / dt
    r = u @ R + slope
    gap = dt * float(np.sum(r * np.linalg.solve(R, r.T).T))
    to_come = float(last @ last)
    paid = dt * float(np.sum((y @ Q) * y) + np.sum((u @ R) * u))
    cost = paid + to_come
    run = DualityGap(gap, cost, cost - gap, to_come, dt * steps)
    if best is None:
        return run
    off = u - best.free - causal(best.kernel, u)
    lost = dt * np.sum((off @ R) * off, axis=1)
    excess = float(np.sum(lost)) / float(end.free[0] @ end.free[0] or 1.0)
    if not to_come > ROUNDING * cost:
        return replace(run, excess=excess)
    pace = TIMES * (1 + excess)
    for n in (steps // 2, 3 * steps // 4):
        before = end.free[n] + np.einsum("kij,kj->i", end.kernel[n:0:-1], u[:n])
        fell = float(before @ before) - to_come
        pace = max(pace, 2 * float(np.sum(lost[n:])) / fell if fell > 0 else np.inf)
    return replace(run, after=to_come * pace, excess=excess)
