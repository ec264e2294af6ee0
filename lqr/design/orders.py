"""Reduced gains of a scene: every basis at several orders, and which of them are good."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.loop.gap import Notify as Notify
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.reduced.bases import A_PRIORI, BASES, BasisFamily, make_family
from softgrasp.lqr.reduced.riccati import GainReport

FAST_STATES = 8  # of the tissue, up to which a gain is offered for the control loop and re-tuned: N <= 12 in 2D
MANY_STATES = 200_000  # above, few orders are tried: every gain is certified by solves with the full plant
WHOLE_SPECTRUM = 500  # n_e from which the Schur form of all modes for every gain takes seconds, so few orders are tried
FEW_ORDERS = 3
ORDERS = (4, 6, 8, 10, 12, 16, 20, 30, 40)  # of a scene without a [control] table


@dataclass(frozen=True)
class BasisGains:
    """One basis over its orders."""

    name: str  # key of softgrasp.lqr.reduced.bases.BASES
    family: BasisFamily | None  # its bases; None when the basis is refused
    reports: tuple[GainReport, ...]  # one an order
    refused: str = ""  # why there are none

    def best(self, largest: int | None = None, least: int = 0) -> GainReport | None:
        """The stable gain of least cost, of any order or between two."""
        stable = [r for r in self.reports if r.stable and least <= r.N and (largest is None or largest >= r.N)]
        return min(stable, key=lambda r: (r.cost_excess, r.N), default=None)


def fast_order(n_s: int) -> int:
    """Largest order of a gain for the control loop: the hand's states and a few of the tissue."""
    return 2 * n_s + FAST_STATES


def orders(design: Design) -> tuple[list[int], str]:
    """Orders to try and, where judging a gain takes long, why they are few."""
    control, layout = design.model.scene.control, design.problem.layout
    every = list(ORDERS) if control is None else sorted(set(control.N))
    dense = design.judge.loop.complete and layout.n_e > WHOLE_SPECTRUM
    if (layout.states <= MANY_STATES and not dense) or len(every) <= FEW_ORDERS:
        return every, ""
    fast = [N for N in every if fast_order(layout.n_s) >= N]
    pick = np.linspace(0, len(every) - 1, FEW_ORDERS).round().astype(int)
    few = sorted({*fast[-1:], *(every[i] for i in pick[1:])})
    why = "by all its eigenvalues" if dense else "by solves with the full plant"
    return few, f"{layout.states} states: every gain is certified {why}, so only N = {few} are tried"


def reduce_gains(
    design: Design, orders: Sequence[int], notify: Notify | None = None, names: Sequence[str] = tuple(BASES)
) -> tuple[BasisGains, ...]:
    """Gains of the reduced Riccati equations over their orders, judged on the full plant. Collective.

    Args:
        orders: of the reduced equations; those that a basis has not are left out.
        notify: called with the number of equations done and at most.
        names: keys of :data:`softgrasp.lqr.reduced.bases.BASES`.
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
            reports.append(design.judge.report(family.at(N)))
            if notify is not None:
                notify(i * len(orders) + j, len(names) * len(orders))
        bases.append(BasisGains(name, family, tuple(reports)))
    return tuple(bases)


def best_gains(bases: Sequence[BasisGains], layout: BlockLayout) -> list[GainReport]:
    """The best stable gain of every basis, a priori that of the controller; of a large plant that one only."""
    limits = {A_PRIORI: fast_order(layout.n_s)}
    best = [report for b in bases if (report := b.best(limits.get(b.name))) is not None]
    return best if layout.states <= MANY_STATES else [r for r in best if r.method == A_PRIORI]
