"""How long a closed loop runs, what it may cost, and proved bounds on the excess cost of reduced gains."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.orders import BasisGains
from softgrasp.lqr.loop.gap import Notify, duality_gaps
from softgrasp.lqr.plant.gain import Block, Gain
from softgrasp.lqr.plant.operators import outputs
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.riccati import GainQuality

SETTLED = 6.0  # time constants of the slower hand pole after which 0.3 % of the way are left
LONGEST = 20  # times the steps of the scene that a run without [control] may take to settle


@dataclass(frozen=True)
class LoopPlan:
    """How long the loop runs."""

    dt: float  # time step [s]
    steps: int  # number
    settle: float  # time after which a rigid body under this gain is at the target [s]
    note: str = ""  # why the scene's own end is not taken, or that it is too early; else empty


def plan(design: Design, own_end: bool) -> LoopPlan:
    """Steps of the closed loop, from the poles of the hand alone: M_s q'' = K_s [q; q'].

    ``own_end``: keep the end of the scene; else take as many steps as the move needs.
    """
    scene, n_s = design.model.scene, design.problem.layout.n_s
    dt, steps = scene.time_end / scene.time.steps, scene.time.steps
    A = np.zeros((2 * n_s, 2 * n_s))
    A[:n_s, n_s:] = np.eye(n_s)
    A[n_s:] = np.linalg.solve(design.problem.M_s, design.gain.K_s)
    slowest = -float(np.linalg.eigvals(A).real.max())
    settle = SETTLED / slowest if slowest > 0 else scene.time_end
    needed = int(np.ceil(settle / dt))
    if needed <= steps:
        return LoopPlan(dt, steps, settle)
    if own_end:
        note = f"the loop ends at t = {scene.time_end:g} s, but this gain needs about {settle:.2g} s; raise "
        return LoopPlan(dt, steps, settle, note + "time.end, or control.Q for a faster move")
    longer = min(needed, LONGEST * steps)
    note = f"the loop runs {longer} steps to t = {longer * dt:.3g} s; at t = {scene.time_end:g} s it would still move"
    return LoopPlan(dt, longer, settle, note)


def largest_cost(design: Design, plan: LoopPlan) -> float:
    """A thousand times what the optimal loop and one that does nothing would pay. Collective."""
    y = outputs(design.problem, design.error)[:, 0]
    return 1e3 * (design.judge.optimal + plan.dt * plan.steps * float(y @ design.problem.Q @ y))


def with_bounds[Figures: GainQuality](
    problem: RiccatiProblem,
    solution: RiccatiSolution,
    gains: Iterable[Figures],
    start: Block,
    plan: LoopPlan,
    notify: Notify | None = None,
) -> list[Figures]:
    """The same with bounds of the cost where the gain is stable, see :mod:`softgrasp.lqr.loop.gap`. Collective.

    ``cost_excess_proved`` holds for the run to the end of the plan and the optimal feedback after it. What the loop's
    own way costs after that is an allowance in ``cost_excess_at_most``, at least what the modes kept say of it.

    Args:
        solution: says what is to come after the end of the plan; its error does not matter to the bound.
        start: start minus target, one column.
    """
    gains = list(gains)
    laws: dict[int, Gain] = {i: g.gain for i, g in enumerate(gains) if g.stable and g.gain is not None}
    if laws:
        every = [*laws.values(), solution.gain]  # the last has the best lower bound of the least cost
        gaps = duality_gaps(problem, every, start, plan.dt, plan.steps, solution.factor, notify)
        for i, gap in zip(laws, gaps[:-1], strict=True):
            forever = (1 + gains[i].cost_excess) * gaps[-1].cost / gap.least - 1 if gap.least > 0 else float("inf")
            most = max(gap.cost_excess_at_most, forever)
            gains[i] = replace(gains[i], cost_excess_at_most=most, cost_excess_proved=gap.cost_excess_proved)
    return gains


def bases_with_bounds(
    design: Design, bases: Sequence[BasisGains], plan: LoopPlan, notify: Notify | None = None
) -> tuple[BasisGains, ...]:
    """All gains of all bases from the same few runs. Collective."""
    every = with_bounds(
        design.problem, design.solution, (r for b in bases for r in b.reports), design.error, plan, notify
    )
    rest = iter(every)
    return tuple(replace(b, reports=tuple(next(rest) for _ in b.reports)) for b in bases)
