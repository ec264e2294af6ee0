"""What ``softgrasp control`` finds, and result.json made from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem import Array, farthest
from softgrasp.lqr import BasisGains, CertifiedController, GainQuality, LoopPlan, LoopTrajectory, RetunedGain, Target
from softgrasp.lqr.design.feedback import Design, running_words
from softgrasp.lqr.loop.margins import LoopMargins, loop_margins
from softgrasp.lqr.plant.problem import RiccatiSolution, rigid_gains, translation_defect, velocity_defect
from softgrasp.study.forward.result import contact_keys, newton_keys
from softgrasp.study.report.origin import origin, peak_memory_mb

if TYPE_CHECKING:  # plans and observers are not imported where a scene has none
    from softgrasp.study.control.observer.result import ObservedStudy
    from softgrasp.study.control.obstacle.result import PlannedStudy

TITLES = {
    "pod": "POD of P",
    "weighted_pod": "weighted POD of P",
    "pod_fixed_solid": "POD, fixed solid modes",
    "componentwise_pod": "componentwise POD",
    "pod_decomposed": "POD of decomposed P",
    "structured": "modes by cost, a priori",
}

REPORT = ("N", "error_P", "error_K", "cost_excess", "abscissa_full", "time_are", "certified", "examined", "reason")
BOUNDS = ("cost_excess_proved", "cost_excess_at_most", "bounded_to", "unbounded")


@dataclass(frozen=True)
class Retuned:
    """One basis of one parameter over the box of lambda and mu."""

    name: str  # basis
    N: int  # order
    points: tuple[RetunedGain, ...]  # gains at the settings

    @property
    def slowest(self) -> float:
        """Seconds of the slowest re-tuning; nan when none was possible."""
        return max((p.seconds for p in self.points if not p.reason), default=float("nan"))


@dataclass(frozen=True)
class ReducedLoopRun:
    """The full plant under the best stable gain of one basis."""

    method: str  # key of the basis
    N: int  # order
    run: LoopTrajectory | None  # None when it failed
    reason: str = ""  # why it failed; else empty


@dataclass(frozen=True)
class LoopRuns:
    """All closed-loop runs."""

    plan: LoopPlan  # times
    full: LoopTrajectory  # under the optimal gain
    to_come: float  # cost still to come at the end, from the Riccati solution
    reduced: tuple[ReducedLoopRun, ...]  # under the best stable gain of each basis
    limits: Array | None = None  # of the inputs [N, N m], inf for none; None without any
    touching: TouchingLoop | None = None  # the loop that meets the obstacles; None where the effect is off


@dataclass(frozen=True)
class FiniteLoop:
    """The linear gain on the plant of finite strain."""

    law: str  # of the material
    run: LoopTrajectory | None  # None when it failed
    target: Target  # where the loop goes; its shape is the equilibrium of finite strain
    reason: str = ""  # why the gain does not stabilise this plant; else empty
    cost_excess: float = float("nan")  # cost over that of the linear plant, less one [1]
    overshoot: float = float("nan")  # farthest past the target over the way [1]
    overshoot_linear: float = float("nan")  # farthest past the target over the way on the linear plant [1]

    @property
    def text(self) -> str:
        """The finding in words."""
        if self.reason:
            return f"the linear gain does not stabilise it: {self.reason}"
        past = f"overshoot {self.overshoot:.3g} instead of {self.overshoot_linear:.3g}"
        return f"the cost changes by {self.cost_excess:+.2g} of the linear prediction, {past}"


@dataclass(frozen=True)
class TouchingLoop:
    """The gain on the plant that meets the obstacles."""

    run: LoopTrajectory | None  # None when it failed
    distance: float = float("nan")  # distance of the farthest output to its target at the end [m]
    cost_excess: float = float("nan")  # cost over that of the run without obstacles, less one [1]
    reason: str = ""  # why the run failed; else empty

    def result(self) -> dict[str, Any]:
        """The key "contact" of ``result.json``."""
        run = self.run
        if run is None or run.contact is None:
            return {"reason": self.reason}
        return {
            **contact_keys(run.contact),
            "hand_final": run.q_s[-1].tolist(),
            "input_final": run.inputs[-1].tolist(),
            "input_largest": np.abs(run.inputs).max(axis=0).tolist(),
            "output_final": run.outputs[-1].tolist(),
            "distance_final": self.distance,
            "cost": float(run.cost[-1]),
            "cost_excess": self.cost_excess,
            "energy_drift": run.energy_drift,
            "saturated": run.saturated,
            "time": dict(run.seconds),
            "reason": "",
        }


@dataclass(frozen=True)
class GainStudy:
    """The optimal feedback and the small controller."""

    design: Design  # the optimal feedback
    bases: tuple[BasisGains, ...]  # gains of the reduced equations
    controller: CertifiedController | None  # the small controller; None when no small gain is certified
    tick: float  # seconds of one tick of it, median
    notes: tuple[str, ...]  # what was chosen for the user, and why parts are missing
    observed: ObservedStudy | None = field(default=None, kw_only=True)  # the observer; None where the scene has none

    @cached_property
    def margins(self) -> LoopMargins | None:
        """Of the loop under the small controller, on the plant that it was made for."""
        return loop_margins(self.controller.controller, self.design.actuation.delay) if self.controller else None

    @property
    def findings(self) -> list[str]:
        """Sentences of the diagnosis."""
        return [finding.sentence for finding in self.design.diagnosis.findings]

    def result(self, seconds: dict[str, float]) -> dict[str, Any]:
        """The keys of ``result.json``. Collective."""
        d, layout = self.design, self.design.problem.layout
        problem, solution, quality, sampled = d.problem, d.solution, d.quality, d.quality.sampled
        displaced, moving = rigid_gains(problem, solution)
        controller: dict[str, Any] | None = None
        if self.controller is not None and self.margins is not None:
            small, margins = self.controller.controller, self.margins
            controller = {
                "method": self.controller.method,
                "N": small.plant.N,
                "period": small.period,
                "time_tick": self.tick,
                "sampled_radius": self.controller.radius.value,
                "margins": {"axes": [asdict(axis) for axis in margins.axes], "distance": margins.distance},
            }
        return {
            "command": "control",
            **origin(d.model.scene, layout.comm.size),
            **{key: getattr(layout, key) for key in ("n_s", "n_e", "states")},
            "method": solution.summary,
            "rank": solution.rank,
            **{key: solution.counts.get(key, 0) for key in ("newton_steps", "adi_steps", "solves")},
            "residual": solution.residual,
            "gain_change": gain_change(solution),
            "optimal_cost": d.gain_check.optimal,
            "gain_translation": displaced.tolist(),
            "gain_rigid_velocity": moving.tolist(),
            "identity_translation": translation_defect(problem, solution),
            "identity_velocity": velocity_defect(problem, solution),
            **{f"closed_loop_{key}": getattr(quality, key) for key in ("abscissa", "certified", "exact")},
            "sampled_radius": None if sampled is None else sampled.value,
            "sampled_certified": sampled is not None and sampled.certified,
            "sampled_exact": sampled is not None and sampled.exact,
            "stable": quality.stable,
            "findings": self.findings,
            "damping_enough": d.diagnosis.damping_enough,
            "controller": controller,
            **({} if self.observed is None else {"observer": self.observed.result()}),
            "notes": self.notes,
            "time": {**seconds, "solver": dict(solution.seconds)},
            "memory_peak_mb": peak_memory_mb(layout.comm),
        }


@dataclass(frozen=True)
class ControlStudy(GainStudy):
    """All that ``softgrasp control`` finds."""

    loops: LoopRuns  # closed loops
    finite: FiniteLoop | None  # the loop on the plant of finite strain; None where the effect is off
    retuned: tuple[Retuned, ...] = ()  # gains over the box
    planned: PlannedStudy | None = None  # the plan past obstacles; None where the scene asks for none

    def distance(self, run: LoopTrajectory) -> Array:
        """Distance of the farthest output to its target at every instant [m], (steps + 1,)."""
        return farthest(run.outputs, self.design.target.y, self.design.problem.columns)

    def result(self, seconds: dict[str, float]) -> dict[str, Any]:
        """The keys of ``result.json``. Collective."""
        return super().result(seconds) | {
            "bounded_loop": running_words(self.design),
            "reduced": {b.name: [report_dict(r, REPORT + BOUNDS) for r in b.reports] for b in self.bases},
            "refused": {b.name: b.refused for b in self.bases if b.refused},
            "retune": [_retuned(r) for r in self.retuned],
            "loop": _loop(self),
            **({} if self.finite is None else {"finite_strain": _finite(self.finite)}),
            **({} if self.planned is None else {"obstacle": self.planned.result()}),
            **({} if self.loops.touching is None else {"contact": self.loops.touching.result()}),
        }


def gain_change(solution: RiccatiSolution) -> dict[str, float] | None:
    """How much hand's and tissue's rows of a Galerkin gain changed between its last two spaces; else None."""
    last = solution.history[-1] if solution.method == "galerkin" else None
    return last and {key: last[f"change_{key}"] for key in ("hand", "tissue")}


def report_dict(gain: GainQuality, keys: Sequence[str] = REPORT) -> dict[str, Any]:
    """One gain in result.json."""
    known = {"stable": gain.stable if gain.examined or gain.ruled_out else None}  # None: not examined
    return {key: getattr(gain, key) for key in keys} | known | {"sampled_radius": radius_of(gain)}


def radius_of(report: GainQuality) -> float:
    """Spectral radius from tick to tick; nan where there is no gain."""
    return float("nan") if report.sampled is None else report.sampled.value


def _retuned(r: Retuned) -> dict[str, Any]:
    keys = ("error_K", "cost_excess", "abscissa_full", "reason", *BOUNDS)
    points = [
        {"lambda": p.materials[0].lam, "mu": p.materials[0].mu, "time": p.seconds} | report_dict(p, keys)
        for p in r.points
    ]
    return {"method": r.name, "N": r.N, "slowest": r.slowest, "points": points}


def _loop(study: ControlStudy) -> dict[str, Any]:
    loops, full = study.loops, study.loops.full
    away, reduced = study.distance(full), []
    for r in loops.reduced:
        ran = {} if r.run is None else {"distance_final": study.distance(r.run)[-1], "cost": r.run.cost[-1]}
        reduced.append({"method": r.method, "N": r.N, **ran, "reason": r.reason})
    return {
        "steps": loops.plan.steps,
        "dt": loops.plan.dt,
        "hand_final": full.q_s[-1].tolist(),
        "output_names": list(full.output_names),
        "output_target": study.design.target.y.tolist(),
        "output_final": full.outputs[-1].tolist(),
        "distance_first": float(away[0]),
        "distance_final": float(away[-1]),
        "settled": settled(full.times, away),
        "cost": float(full.cost[-1]),
        "cost_to_come": loops.to_come,
        "input_largest": np.abs(full.inputs).max(axis=0).tolist(),
        "saturated": full.saturated,
        "solver": full.solver._asdict(),
        "time": dict(full.seconds),
        "reduced": reduced,
    }


def _finite(finite: FiniteLoop) -> dict[str, Any]:
    keys = ("law", "cost_excess", "overshoot", "overshoot_linear", "reason")
    result = {key: getattr(finite, key) for key in keys} | {"stable": not finite.reason}
    if finite.run is not None and finite.run.newton is not None:
        result |= {"cost": float(finite.run.cost[-1]), "newton": newton_keys(finite.run.newton)}
    return result


def settled(times: Array, distance: Array, share: float = 0.01) -> float | None:
    """First time after which the distance stays below a share of the first; None when it never does."""
    outside = np.flatnonzero(distance > share * distance[0])
    if len(outside) == 0:
        return float(times[0])
    return None if outside[-1] + 1 >= len(times) else float(times[outside[-1] + 1])
