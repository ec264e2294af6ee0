"""Proved bounds on the excess cost of reduced gains, from the duality gaps of their runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from softgrasp.lqr.design.duration import LoopPlan
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.orders import BasisGains
from softgrasp.lqr.loop.gap import duality_gaps
from softgrasp.lqr.loop.responses import Notify
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.riccati import GainQuality


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
