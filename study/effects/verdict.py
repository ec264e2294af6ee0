"""What an effect changes, alone and beside other effects; verdict and advice; whether linear elements are enough."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import Force, motion_table
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.materials import young_poisson
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.measure import AGAIN, SCENE, MeasuredScene, cost_of, prove_off
from softgrasp.study.effects.result import Change, Company, Cost, EffectResult, Elements
from softgrasp.study.effects.switch import Scales, Switch, switch
from softgrasp.study.forward.cautions import LOCKING
from softgrasp.study.forward.explain import EffectReport, Explanation
from softgrasp.study.report.tables import listed, percent

Names = frozenset[str]
Changes = dict[str, tuple[Change, float | None]]  # of the outputs, and under a force


@dataclass(frozen=True)
class Displacements:
    """Where a run takes its outputs, angles of the hand left out."""

    places: Array  # displacements, (steps + 1, outputs, d) [m]
    rigid: Array  # their share of the hand's rigid motion [m]


def displacements(model: Model, run: Trajectory) -> Displacements:
    """Displacements of the outputs of a run."""
    moves = [not column.rotation for column in run.columns]
    shape = len(run.times), -1, model.system.layout.dimension
    return Displacements(run.outputs[:, moves].reshape(shape), run.outputs_rigid[:, moves].reshape(shape))


def compare(a: Displacements, b: Displacements) -> Change:
    """Change between two runs of the same outputs."""

    def gap(x: Array, y: Array) -> tuple[float, float]:
        scale = max(float(np.linalg.norm(v, axis=2).max()) for v in (x, y))
        largest = float(np.linalg.norm(x - y, axis=2).max())
        return largest, (largest / scale if scale > 0 else 0.0)

    absolute, outputs = gap(a.places, b.places)
    return Change(outputs, gap(a.places - a.rigid, b.places - b.rigid)[1], absolute)


def force_of_motion(scene: Scene, model: Model) -> Force:
    """The force that would carry the bare hand along the prescribed motion, u_n = M_hand a_n.

    A hand with more freedoms than the scene's gets no load on them, one with fewer none of those it lacks.
    """
    u = motion_table(scene, model.system.layout.n_s).a @ model.system.M_hand.T

    def force(n: int, t: float, q: Array, v: Array) -> Array:
        result, shared = np.zeros(len(q)), min(len(q), u.shape[1])
        result[:shared] = u[n, :shared]
        return result

    return force


class Experiments:
    """Runs of one scene with any set of its effects on, each made once. Collective.

    Where a control problem lets a force move the hand that the run moves by itself, every run has a second one under
    the force that would make that motion. ``models`` are built already, the scene's own among them.
    """

    def __init__(self, scene: Scene, scales: Scales, models: dict[Names, Model]) -> None:
        self.scene, self.scales, self.models = scene, scales, models
        self.on: Names = frozenset(name for name, effect in EFFECTS.items() if effect.active(scene))
        own = models[self.on]
        self.comm = own.system.layout.comm
        later = scene.control is not None and scene.motion.drive == "motion"
        self.force = force_of_motion(scene, own) if later else None
        self.runs: dict[tuple[Names, bool], Displacements] = {}
        self.first: Trajectory = simulate(own, RunOptions())
        self.runs[self.on, False] = displacements(own, self.first)

    def model(self, on: Names) -> Model:
        """The model with exactly these effects on; one that is new is not kept. Collective."""
        if on in self.models:
            return self.models[on]
        scene = self.scene
        for name in EFFECTS:
            if (name in on) != (name in self.on):
                other = switch(scene, name, self.scales).other
                scene = scene if other is None else other
        gc.collect()
        return build(scene, comm=self.comm)

    def of(self, on: Names, forced: bool = False) -> Displacements:
        """Outputs with exactly these effects on. Collective. Raises SolverError: a solve failed."""
        if (on, forced) not in self.runs:
            model = self.model(on)
            self.runs[on, forced] = displacements(model, simulate(model, RunOptions(), self.force if forced else None))
        return self.runs[on, forced]

    def change(self, a: Names, b: Names) -> Change:
        """Change between two sets of effects. Collective."""
        return compare(self.of(a), self.of(b))

    def control(self, a: Names, b: Names) -> float | None:
        """Change of the outputs when a force moves the hand; None where that is no question. Collective."""
        return None if self.force is None else compare(self.of(a, True), self.of(b, True)).outputs

    def alone(self, name: str) -> tuple[Change, float | None]:
        """Change by one effect switched in the scene; under a force too where the run does not show it. Collective."""
        other = self.on ^ {name}
        change = self.change(self.on, other)
        hidden = change.outputs <= self.scene.study.tolerance
        return change, self.control(self.on, other) if hidden else None

    def shows(self, a: Names, b: Names, tolerance: float) -> tuple[float, bool] | None:
        """A change of the outputs above the tolerance, and whether only a force brings it out. Collective."""
        if (change := self.change(a, b).outputs) > tolerance:
            return change, False
        control = self.control(a, b)
        return None if control is None or control <= tolerance else (control, True)


@dataclass(frozen=True)
class Together:
    """All effects tried again."""

    on: tuple[str, ...]  # effects that are advised, those that cannot be tried as they are
    company: dict[str, Company]  # of each effect that was tried


class Shown(NamedTuple):
    """What brings an effect out that does not show in the scene as it is; attributes as of :class:`Company`."""

    partners: tuple[str, ...] = ()
    either: bool = False
    together: float = 0.0
    forced: bool = False


Joined = dict[str, Shown]


def advised_together(runs: Experiments, tried: tuple[str, ...], needed: Names, tolerance: float) -> Together:
    """Judge every effect again with all advised effects on, until no further one shows. Collective.

    An effect that does not show in the scene as it is joins when it shows beside those advised so far; then two that
    show only as a pair do. ``tried`` can be switched; ``needed`` of them show in the scene as it is.
    """
    on = needed | (runs.on - frozenset(tried))
    joined: Joined = {}
    while new := _singles(runs, tried, on, tolerance) or _pair(runs, tried, on, tolerance):
        on |= frozenset(new)
        joined |= new
    company = {
        name: Company(runs.change(on, on ^ {name}), runs.control(on, on ^ {name}), *joined.get(name, Shown()))
        for name in tried
    }
    return Together(tuple(name for name in EFFECTS if name in on), company)


def _singles(runs: Experiments, tried: tuple[str, ...], on: Names, tolerance: float) -> Joined:
    """Effects that show beside those that are on, with the partners that bring them out. Collective."""
    joined: Joined = {}
    for name in tried:
        change = None if name in on else runs.shows(on, on | {name}, tolerance)
        if change is None:
            continue
        others = [p for p in tried if p != name and (p in on) != (p in runs.on)]
        near = [p for p in others if runs.shows(runs.on ^ {p}, runs.on ^ {p, name}, tolerance)]
        joined[name] = Shown(tuple(near or others), False, *change)
    return joined


def _pair(runs: Experiments, tried: tuple[str, ...], on: Names, tolerance: float) -> Joined:
    """The first two effects that show together and not one by one. Collective."""
    for a, b in combinations([name for name in tried if name not in on], 2):
        change = runs.shows(on, on | {a, b}, tolerance)
        if change is not None and {a, b} <= runs.on:
            return {a: Shown((b,), True, *change)}
        if change is not None:
            return {a: Shown((b,), False, *change), b: Shown((a,), False, *change)}
    return {}


def finite_strain_beside(
    runs: Experiments, name: str, alone: tuple[Change, float | None], on: frozenset[str]
) -> Company:
    """Finite strain on trial beside all advised effects, one run more; alone where it fails there. Collective."""
    if on == runs.on or "rotation" in on:
        return Company(*alone)
    try:
        change = runs.change(on, on | {name})
    except SolverError:
        return Company(*alone)
    if alone[0].outputs <= runs.scene.study.tolerance < change.outputs:
        return Company(change, alone[1], tuple(sorted(on ^ runs.on)), False, change.outputs)
    return Company(change, alone[1])


# --- verdict and advice


def verdict_of(change: float, controls: bool, costs: bool, tolerance: float) -> str:
    """needed, optional or wasted.

    Needed: it changes the outputs by more than the tolerance. Optional: it does not, but it is free, or the control
    problem needs it. Wasted: it costs something and nothing shows it.
    """
    if change > tolerance:
        return "needed"
    return "wasted" if costs and not controls else "optional"


def find(
    s: Switch,
    explanation: Explanation,
    cases: dict[str, MeasuredScene],
    changes: Changes,
    together: Together,
    noise: float,
) -> EffectResult:
    """Judge one effect and say what to do about it. Collective."""
    scene = cases[SCENE].model.scene
    gate, tolerance = explanation.effects[s.name], scene.study.tolerance
    proof = None if s.on else prove_off(s.name, cases[SCENE], cases[AGAIN])
    if s.other is None:
        return EffectResult(s.name, s.on, s.value, gate, "not tried", f"Not tried: {s.reason}.", proof=proof)
    (change, control), company = changes[s.name], together.company[s.name]
    pair = (cases[SCENE], cases[s.name]) if s.on else (cases[s.name], cases[SCENE])
    cost = cost_of(*pair, noise)
    why = needed_for_control(s, control, gate, scene)
    largest = max(change.outputs, 0.0 if company.forced else company.together)
    verdict = verdict_of(largest, bool(why) or company.forced, cost.any, tolerance)
    if company.partners:
        advice = _advice_together(s, change.outputs, company, scene)
    else:
        advice = _advice(s, verdict, change.outputs, why, cost, tolerance)
        if verdict == "needed" and company.change.outputs <= tolerance:
            advice += f" Beside the other advised effects it changes them by {company.change.outputs:.1e} only."
    return EffectResult(s.name, s.on, s.value, gate, verdict, advice, change, control, company, cost, proof)


def shows(s: Switch, changes: tuple[Change, float | None], gate: EffectReport, scene: Scene) -> bool:
    """Whether the effect shows in the scene as it is, or its control problem needs it."""
    change, control = changes
    return change.outputs > scene.study.tolerance or bool(needed_for_control(s, control, gate, scene))


def needed_for_control(s: Switch, control: float | None, gate: EffectReport, scene: Scene) -> str:
    """Why the control problem needs an effect that does not show in the run; empty if it does not."""
    if control is not None and control > scene.study.tolerance:
        return f"when a force moves the hand, as in the control problem, it changes them by {percent(control)}"
    if s.name == "damping" and scene.control is not None and gate.gate.matters:
        return "without damping no feedback stabilises the high modes in the control problem"
    return ""


def _advice(s: Switch, verdict: str, change: float, why: str, cost: Cost, tolerance: float) -> str:
    if verdict == "needed":
        text = "Keep it: it changes" if s.on else "Switch it on if it acts on your robot: it would change"
        text += f" the outputs by {change:.2g}, tolerance {tolerance:g}"
        if s.strength is not None and change < 0.1:  # where the change still grows with the strength
            text += f"; below about {s.strength * tolerance / change:.2g} {s.unit} it would not show"
        return text + "."
    little = _change_in_words(change)
    if why:
        return f"{'Keep' if s.on else 'Switch'} it{'' if s.on else ' on'} for control alone: it {little}, but {why}."
    if verdict == "wasted":
        text = "Switch it off" if s.on else "It is right to leave it off"
        return f"{text}: it {little} and adds {_cost_in_words(cost)}."
    return f"{'Keep or drop it' if s.on else 'It is right to leave it off'}: it {little} and costs nothing in this run."


def _advice_together(s: Switch, change: float, company: Company, scene: Scene) -> str:
    """For an effect that shows only when others are switched too."""
    partners = listed(company.partners)
    force = " when a force moves the hand, as in the control problem" if company.forced else ""
    number = f"the outputs by {company.together:.2g}{force}, tolerance {scene.study.tolerance:g}"
    if company.either:
        return f"Keep it, or {partners}: each can go alone, but leaving out both changes {number}."
    begin = f"{'Keep it' if s.on else 'Switch it on'}{' for control' if force else ''}"
    switched = [name for name in company.partners if EFFECTS[name].active(scene)]
    state = f"without {partners}" if switched else f"with {partners} on"
    return f"{begin}, {state}: alone it {_change_in_words(change)}, but {state} it changes {number}."


def _change_in_words(change: float) -> str:
    return "changes nothing" if change == 0 else f"changes the outputs by {change:.1e} only"


def _cost_in_words(cost: Cost) -> str:
    shares = (cost.flops_relative, "operations of a step"), (cost.memory_relative, "memory")
    return " and ".join(f"{percent(share)} to the {what}" for share, what in shares if share > 0)


# --- whether linear elements are enough


def check_elements(model: Model, trajectory: Trajectory, tolerance: float) -> Elements | None:
    """Run the scene with P2 when it has P1 and a ratio of Poisson at which P1 locks, else None. Collective."""
    nu = max(young_poisson(m.lam, m.mu)[1] for m in model.system.materials)
    if model.scene.tissue.order != 1 or nu <= LOCKING + 1e-9:
        return None
    other = build(quadratic(model), comm=model.system.layout.comm)
    change = compare(displacements(model, trajectory), displacements(other, simulate(other, RunOptions())))
    needed = change.outputs > tolerance
    text = (
        f"Measured at nu = {nu:.4g}: on the same mesh tissue.order = 2 changes the outputs by {change.outputs:.2g} and "
        f"their deformation by {change.deformation:.2g}, tolerance {tolerance:g}: "
    )
    text += "P2 is needed." if needed else "this run does not show the locking."
    ratio = other.system.layout.n_e / model.system.layout.n_e
    return Elements(nu, change, ratio, needed, text)


def quadratic(model: Model) -> Scene:
    """The scene with P2 and its outputs at the very nodes that they have with P1. Collective."""
    outputs = make_outputs(model.scene, model.system)

    def edit(table: dict[str, Any]) -> None:
        table["tissue"]["order"] = 2
        control = table.setdefault("control", {})
        if not control.get("outputs"):
            control["outputs"] = [{"kind": "node", "name": o.name, "point": list(o.point)} for o in outputs]
        for entry, output in zip(control["outputs"], outputs, strict=True):
            if entry["kind"] == "node":
                entry["point"] = list(output.point)

    return model.scene.changed(edit)
