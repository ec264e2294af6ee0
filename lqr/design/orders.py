"""Reduced gains of a scene: every basis at several orders, the best of them, and proved bounds on their excess cost."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.lqr.design.duration import LoopPlan
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.scene import control_of
from softgrasp.lqr.loop.full import ClosedLoop
from softgrasp.lqr.loop.gap import Course, duality_gaps
from softgrasp.lqr.loop.responses import Notify as Notify
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import A_PRIORI, BASES, BasisFamily, make_family
from softgrasp.lqr.reduced.riccati import GainQuality, GainReport

FAST_STATES = 8  # of the tissue, up to which a gain is offered for the control loop and re-tuned: N <= 12 in 2D
MANY_STATES = 200_000  # above, few orders are tried: every one needs products with the full plant
WHOLE_SPECTRUM = 500  # n_e from which all eigenvalues for every gain need seconds, so few orders are tried
FEW_ORDERS = 3
LONGER = 3  # doublings of a run that has not settled


@dataclass(frozen=True)
class BasisGains:
    """One basis over its orders."""

    name: str  # key of softgrasp.lqr.reduced.bases.BASES
    family: BasisFamily | None  # its bases; None when the basis is refused
    reports: tuple[GainReport, ...]  # quality of the gain at each order, ascending
    refused: str = ""  # why the basis is refused; empty when it is not

    def best(self, largest: int | None = None, least: int = 0) -> GainReport | None:
        """The stable gain of least cost, of any order or between two."""
        stable = [r for r in self.reports if r.stable and least <= r.N and (largest is None or largest >= r.N)]
        return min(stable, key=lambda r: (r.cost_excess, r.N), default=None)


def fast_order(n_s: int) -> int:
    """Largest order of a gain for the control loop: the hand's states and a few of the tissue."""
    return 2 * n_s + FAST_STATES


def orders(design: Design) -> tuple[list[int], str]:
    """Orders to try and, where a gain needs long, why they are few."""
    layout, every = design.problem.layout, sorted(set(control_of(design.model).N))
    dense = design.gain_check.loop.complete and layout.n_e > WHOLE_SPECTRUM
    if (layout.states <= MANY_STATES and not dense) or len(every) <= FEW_ORDERS:
        return every, ""
    fast = [N for N in every if fast_order(layout.n_s) >= N]
    pick = np.linspace(0, len(every) - 1, FEW_ORDERS).round().astype(int)
    few = sorted({*fast[-1:], *(every[i] for i in pick[1:])})
    why = "all eigenvalues" if dense else "products with the full plant"
    return few, f"{layout.states} states: every gain needs {why}, so only N = {few} are tried"


def reduce_gains(
    design: Design,
    orders: Sequence[int],
    notify: Notify | None = None,
    names: Sequence[str] = tuple(BASES),
    *,
    offered_only: bool = False,
) -> tuple[BasisGains, ...]:
    """Gains of the reduced Riccati equations over their orders, the best of each basis checked on the full plant.

    Collective. The others have their errors, and poles and cost on the modes kept. The a-priori basis has the best of
    small order checked too: that of the controller.

    Args:
        orders: of the reduced equations; those that a basis has not are left out.
        notify: called with the number of equations done and at most.
        names: keys of :data:`softgrasp.lqr.reduced.bases.BASES`.
        offered_only: leave out what a controller does not need: errors of P, and checks of gains of large order.
    """
    bases = []
    for i, name in enumerate(names):
        try:
            family = make_family(name, design.problem, design.solution.factor)
        except ControlError as error:
            bases.append(BasisGains(name, None, (), str(error)))
            continue
        reports = []
        for j, N in enumerate(family.orders(orders), 1):
            reports.append(design.gain_check.first_look(family.at(N), error_P=not offered_only))
            if notify is not None:
                notify(i * len(orders) + j, len(names) * len(orders))
        bases.append(BasisGains(name, family, tuple(reports)))
    best = _ranked(design, bases)
    n_s = design.problem.layout.n_s
    offered = range(2 * n_s + 2, fast_order(n_s) + 1)  # to the controller
    wanted: list[tuple[int, range | None]] = [] if offered_only else [(k, None) for k in range(len(best))]
    return tuple(certified(design, best, wanted + [(k, offered) for k, b in enumerate(best) if b.name == A_PRIORI]))


def _ranked(design: Design, bases: Sequence[BasisGains]) -> list[BasisGains]:
    """With the excess cost of every gain on the modes kept. Collective."""
    gains = [r.gain for b in bases for r in b.reports if r.gain is not None]
    if not gains:
        return list(bases)
    excess = iter(design.gain_check.excesses(gains).tolist())

    def costs(r: GainReport) -> GainReport:
        own = next(excess) if r.gain is not None else r.cost_excess
        return replace(r, cost_excess=own if r.promising or r.gain is None else float("inf"))

    return [replace(b, reports=tuple(map(costs, b.reports))) for b in bases]


def certified(
    design: Design, bases: Sequence[BasisGains], wanted: Sequence[tuple[int, range | None]]
) -> list[BasisGains]:
    """The reduced gains, the cheapest of each pair checked by the full plant's spectrum, or the next. Collective.

    Args:
        wanted: pairs of the place of a basis and the orders that are offered, None for any; those checked first of all
            pairs are checked together.
    """
    reports = [list(b.reports) for b in bases]
    queues = []
    for k, sizes in wanted:
        places = [i for i, r in enumerate(reports[k]) if r.promising and (sizes is None or r.N in sizes)]
        cheapest = sorted(places, key=lambda i: (reports[k][i].cost_excess, reports[k][i].N))
        queues.append([(k, i) for i in cheapest])
    while queues := [queue for queue in queues if queue]:
        heads = list(dict.fromkeys(queue[0] for queue in queues))
        known = design.gain_check.examined([reports[k][i] for k, i in heads])
        for (k, i), report in zip(heads, known, strict=True):
            reports[k][i] = report
        queues = [[] if reports[k][i].stable else rest for (k, i), *rest in queues]
    return [replace(b, reports=tuple(r)) for b, r in zip(bases, reports, strict=True)]


def best_gains(bases: Sequence[BasisGains], layout: BlockLayout) -> list[GainReport]:
    """The best stable gain of every basis, a priori that of the controller; of a large plant that one only."""
    limits = {A_PRIORI: fast_order(layout.n_s)}
    best = [report for b in bases if (report := b.best(limits.get(b.name))) is not None]
    return best if layout.states <= MANY_STATES else [r for r in best if r.method == A_PRIORI]


def with_bounds[Figures: GainQuality](
    problem: RiccatiProblem,
    solution: RiccatiSolution,
    gains: Iterable[Figures],
    course: Course,
    notify: Notify | None = None,
    loop: ClosedLoop | None = None,
) -> list[Figures]:
    """The same with cost and bounds of the loop as it runs, where nothing rules the gain out. Collective.

    See :mod:`softgrasp.lqr.loop.gap`. ``cost_excess_proved`` is that of the run and the optimal feedback after it. What
    the loop's own way adds after that is an allowance in ``cost_excess_at_most``; while it is more than a tenth of the
    excess of a gain that is offered, the run is made twice as long, :data:`LONGER` times at most.

    Args:
        solution: gives the cost after the end of the run; its error does not matter to the bound.
        loop: see :func:`softgrasp.lqr.loop.responses.responses`.
    """
    gains = list(gains)
    laws: dict[int, Gain] = {i: g.gain for i, g in enumerate(gains) if g.promising and g.gain is not None}
    if not laws:
        return gains
    for more in range(LONGER + 1):
        longer = replace(course, steps=course.steps << more)
        gaps = duality_gaps(problem, list(laws.values()), longer, solution, notify, loop)
        offered = [gap for i, gap in zip(laws, gaps, strict=True) if gains[i].stable and np.isfinite(gap.gap)]
        if all(gap.settled for gap in offered):
            break
    for i, gap in zip(laws, gaps, strict=True):
        gains[i] = replace(
            gains[i], cost_excess=gap.excess, cost_excess_at_most=gap.cost_excess_at_most,
            cost_excess_proved=gap.cost_excess_proved, bounded_to=gap.end,
        )  # fmt: skip
    return gains


def course_of(design: Design, plan: LoopPlan) -> Course:
    """The run of a plan from the scene's start, as its loop is sampled, held, late and limited."""
    return Course(design.error, plan.dt, plan.steps, design.actuation, design.target.u)


def bases_with_bounds(
    design: Design,
    bases: Sequence[BasisGains],
    plan: LoopPlan,
    notify: Notify | None = None,
    loop: ClosedLoop | None = None,
) -> tuple[BasisGains, ...]:
    """All gains of all bases from the same few runs, see :func:`with_bounds`. Collective."""
    reports = (r for b in bases for r in b.reports)
    every = with_bounds(design.problem, design.solution, reports, course_of(design, plan), notify, loop)
    rest = iter(every)
    return tuple(replace(b, reports=tuple(next(rest) for _ in b.reports)) for b in bases)
