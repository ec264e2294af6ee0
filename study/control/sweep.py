"""The paper's reduced Riccati equations and the a-priori basis on one scene: errors, worth of the gains, re-tuning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import on_root
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.coordinates import factor_of
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import BASES, BasisFamily, make_family
from softgrasp.lqr.reduced.retune import BoxPoint, Materials, Retuner, over_box
from softgrasp.lqr.reduced.riccati import GainReport, ReducedRiccati, factor_error, gain_error, reduce_riccati
from softgrasp.lqr.riccati import solve
from softgrasp.lqr.spectrum.modal_loop import SOME_MODES, LoopQuality
from softgrasp.reduction.parameters import box_materials, outside
from softgrasp.study.control.solve import WHOLE_SPECTRUM, Design, worth

TITLES = {
    "pod": "POD of P",
    "weighted_pod": "weighted POD of P",
    "pod_fixed_solid": "POD, fixed solid modes",
    "componentwise_pod": "componentwise POD",
    "pod_decomposed": "POD of decomposed P",
    "structured": "modes by cost, a priori",
}
FAST_STATES = 8  # of the tissue, up to which a gain is offered for the control loop and re-tuned: N <= 12 in 2D
MANY_STATES = 200_000  # above, few orders are tried: every gain is certified by solves with the full plant
FEW_ORDERS = 3
REPEATS = 5  # of a re-tuning, the best counts
BOX_STATES = 30_000  # above, nine more full solutions would take minutes

Notify = Callable[[int, int], None]


@dataclass(frozen=True)
class SweptBasis:
    """One method over its orders.

    Attributes:
        name: key of :data:`lqr.reduced.bases.BASES`.
        family: its bases; None when the method is refused.
        reports: one an order.
        refused: why there are none.
    """

    name: str
    family: BasisFamily | None
    reports: tuple[GainReport, ...]
    refused: str = ""

    @property
    def title(self) -> str:
        """Name in tables."""
        return TITLES.get(self.name, self.name)

    def best(self, largest: int | None = None, least: int = 0) -> GainReport | None:
        """The stable gain of least cost, of any order or between two. Not collective."""
        fine = [r for r in self.reports if r.stable and least <= r.N and (largest is None or largest >= r.N)]
        return min(fine, key=lambda r: (r.cost_excess, r.N), default=None)

    def reduced(self, problem: RiccatiProblem, N: int) -> ReducedRiccati:
        """The reduced equation of one order again, with its gain. Collective."""
        if self.family is None:
            raise ControlError(f"basis {self.name} is refused: {self.refused}")
        return reduce_riccati(problem, self.family.at(N))


def fast_order(n_s: int) -> int:
    """Largest order of a gain for the control loop: the hand's states and a few of the tissue. Not collective."""
    return 2 * n_s + FAST_STATES


def orders(model: Model, found: Design) -> tuple[list[int], str]:
    """Orders to try and, where judging a gain takes long, why they are few. Not collective."""
    control = model.scene.control
    wanted = [4, 6, 8, 10, 12, 16, 20, 30, 40] if control is None else sorted(set(control.N))
    states = model.system.layout.states
    dense = found.judge.loop.complete and model.system.layout.n_e > WHOLE_SPECTRUM
    if (states <= MANY_STATES and not dense) or len(wanted) <= FEW_ORDERS:
        return wanted, ""
    small = [N for N in wanted if fast_order(model.system.layout.n_s) >= N]
    pick = np.linspace(0, len(wanted) - 1, FEW_ORDERS).round().astype(int)
    chosen = sorted({*small[-1:], *(wanted[i] for i in pick[1:])})
    why = "by all its eigenvalues" if dense else "by solves with the full plant"
    return chosen, f"{states} states: every gain is certified {why}, so only N = {chosen} are tried"


def sweep(found: Design, wanted: Sequence[int], notify: Notify | None = None) -> tuple[SweptBasis, ...]:
    """All bases over their orders. Collective.

    Args:
        found: the optimal feedback.
        wanted: orders.
        notify: called with the number of equations done and in all.
    """
    problem, Z = found.problem, factor_of(found.solution)
    families: dict[str, BasisFamily | str] = {}
    for name in BASES:
        try:
            families[name] = make_family(name, problem, Z)
        except ControlError as error:
            families[name] = str(error)
    total = sum(len(f.orders(wanted)) for f in families.values() if isinstance(f, BasisFamily))
    result, done = [], 0
    for name, family in families.items():
        if isinstance(family, str):
            result.append(SweptBasis(name, None, (), family))
            continue
        reports = []
        for N in family.orders(wanted):
            reports.append(judged(found, family, N))
            done += 1
            if notify is not None:
                notify(done, total)
        result.append(SweptBasis(name, family, tuple(reports)))
    return tuple(result)


def judged(found: Design, family: BasisFamily, N: int) -> GainReport:
    """Errors, cost and abscissa of one gain; without a certificate from all modes of a small scene. Collective."""
    try:
        report = found.judge.report(family.at(N))
        if report.certified or report.reason:
            return report
        quality = worth(found.judge, reduce_riccati(found.problem, family.at(N)).gain)
    except SolverError:  # the spectrum did not converge
        return _without_spectrum(found, family, N)
    return replace(
        report,
        abscissa_full=quality.abscissa,
        cost_excess=quality.cost_excess,
        certified=quality.certified,
        sampled=quality.sampled,
    )


def _without_spectrum(found: Design, family: BasisFamily, N: int) -> GainReport:
    """Errors alone, and all modes of a small scene; else a gain nobody can vouch for."""
    problem, judge, nothing = found.problem, found.judge, float("nan")
    reduced = reduce_riccati(problem, family.at(N))
    quality = LoopQuality(nothing, nothing, False)
    if problem.layout.n_e <= WHOLE_SPECTRUM:
        quality = judge.by_all_modes(reduced.gain)
    return GainReport(
        family.name,
        N,
        factor_error(problem, judge.Z_absolute, reduced.basis, reduced.P_N),
        gain_error(problem, judge.K, reduced.gain),
        quality.cost_excess,
        quality.abscissa,
        reduced.seconds,
        certified=quality.certified,
        sampled=quality.sampled,
    )


def report_dict(report: GainReport) -> dict[str, Any]:
    """One point of result.json. Not collective."""
    keys = ("N", "error_P", "error_K", "cost_excess", "abscissa_full", "time_are", "stable", "certified", "reason")
    return {**{key: getattr(report, key) for key in keys}, "sampled_radius": radius_of(report)}


def radius_of(report: GainReport | BoxPoint) -> float:
    """Spectral radius from tick to tick; nan where there is no gain. Not collective."""
    return float("nan") if report.sampled is None else report.sampled.value


@dataclass(frozen=True)
class Retuned:
    """One basis of one parameter over the box of lambda and mu.

    Attributes:
        name: basis.
        N: order.
        points: gains at the settings.
    """

    name: str
    N: int
    points: tuple[BoxPoint, ...]

    @property
    def slowest(self) -> float:
        """Seconds of the slowest re-tuning; nan when none was possible."""
        return max((p.seconds for p in self.points if not p.reason), default=float("nan"))


def retune(
    model: Model, found: Design, swept: Sequence[SweptBasis], notify: Notify | None = None
) -> tuple[tuple[Retuned, ...], str]:
    """The a-priori basis and the paper's best at a small order, re-tuned over the box; or why not. Collective."""
    states = model.system.layout.states
    reason = outside(model)
    if not reason and states > BOX_STATES:
        reason = f"{states} states are more than {BOX_STATES}: the full solutions to compare with would take long"
    chosen = re_tunable(swept, model.system.layout.n_s)
    if not reason and not chosen:
        reason = f"no basis has a stable gain of order N <= {fast_order(model.system.layout.n_s)}"
    if reason:
        return (), reason
    settings = box_materials(model)
    known: dict[Materials, RiccatiSolution] = {}

    def full(problem: RiccatiProblem) -> RiccatiSolution:
        key = problem.system.materials
        if key not in known:
            known[key] = solve(problem)
        return known[key]

    modes = min(SOME_MODES, model.system.layout.n_e)
    result, done = [], 0
    for basis, N in chosen:
        if basis.family is None:
            continue
        tuner = Retuner(found.problem, basis.family.at(N))
        points: list[BoxPoint] = []
        for materials in settings:
            points += _at(tuner, materials, full, found, modes)
            done += 1
            if notify is not None:
                notify(done, len(settings) * len(chosen))
        result.append(Retuned(basis.name, N, tuple(points)))
    return tuple(result), ""


def _at(
    tuner: Retuner,
    materials: Materials,
    full: Callable[[RiccatiProblem], RiccatiSolution],
    found: Design,
    modes: int,
) -> Sequence[BoxPoint]:
    try:
        points = over_box(tuner, [materials], full, found.error, modes, found.judge.law)
    except (ControlError, SolverError) as failed:  # the full solution, not the re-tuned one
        nothing = float("nan")
        return [BoxPoint(materials, nothing, nothing, nothing, nothing, f"no reference: {failed}")]
    if points[0].reason:
        return points
    # the first solution of a size pays for memory and caches, which a running controller does not
    seconds = on_root(tuner.problem.layout.comm, lambda: min(tuner.solve(materials).seconds for _ in range(REPEATS)))
    return [replace(point, seconds=seconds) for point in points]


def re_tunable(swept: Sequence[SweptBasis], n_s: int) -> list[tuple[SweptBasis, int]]:
    """The a-priori basis and the best of the others, each at its best small order. Not collective."""
    fine = [(s, best) for s in swept if (best := s.best(fast_order(n_s))) is not None]
    own = [(s, r.N) for s, r in fine if s.name == "structured"]
    others = sorted(((r.cost_excess, s.name, s, r.N) for s, r in fine if s.name != "structured"), key=lambda o: o[:2])
    return [*own, *((s, N) for _, _, s, N in others[:1])]
