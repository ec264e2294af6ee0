"""Cost, verdict, proof and advice for one effect from the measured cases; whether linear elements are enough."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.materials import young_poisson
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.change import Changes, Together, compare, shown
from softgrasp.study.effects.measure import AGAIN, SCENE, Case, fingerprint, objects_of
from softgrasp.study.effects.result import Change, Company, Cost, Elements, Finding, OffProof
from softgrasp.study.effects.switch import Switch, changed, neutral
from softgrasp.study.forward.accuracy import percent
from softgrasp.study.forward.cautions import LOCKING
from softgrasp.study.forward.explain import EffectReport, Explanation
from softgrasp.study.report.tables import listed


def judge(change: float, controls: bool, costs: bool, tolerance: float) -> str:
    """needed, optional or wasted.

    Needed: it changes the outputs by more than the tolerance. Optional: it does not, but it is free, or the control
    problem needs it. Wasted: it costs something and nothing shows it.
    """
    if change > tolerance:
        return "needed"
    return "wasted" if costs and not controls else "optional"


def ends(samples: Array, share: float = 0.0) -> tuple[float, float]:
    """Smallest and largest sample, or the two with a share of the samples beyond."""
    low, high = np.quantile(samples, [share, 1 - share])
    return float(low), float(high)


def cost_of(with_: Case, without: Case, noise: float) -> Cost:
    """The differences of two cases; ``noise`` is what a step of one scene differs from itself by."""

    def added(stage: str) -> Array:
        return np.asarray(np.array(with_.seconds[stage]) - np.array(without.seconds[stage]))

    assembly, setup, step = added("assembly"), added("setup"), added("step")
    shares = step / np.array(without.seconds["step"])
    more, less = sum(with_.bytes.values()), sum(without.bytes.values())
    low, high = ends(shares)
    return Cost(
        assembly=float(np.median(assembly)),
        setup=float(np.median(setup)),
        assembly_range=ends(assembly),
        setup_range=ends(setup),
        step=float(np.median(step)),
        step_relative=float(np.median(shares)),
        step_low=low,
        step_high=high,
        step_noise=noise,
        step_quartiles=ends(shares, 0.25),
        flops=with_.flops - without.flops,
        flops_relative=with_.flops / without.flops - 1 if without.flops else 0.0,
        memory=more - less,
        memory_relative=more / less - 1,
        holds=tuple(sorted(set(with_.bytes) - set(without.bytes))),
        objects=difference(with_.objects, without.objects),
    )


def difference(more: dict[str, int], less: dict[str, int]) -> dict[str, int]:
    """What the one has more, or less, of each class than the other."""
    return {name: d for name in sorted({*more, *less}) if (d := more.get(name, 0) - less.get(name, 0))}


def prove_off(name: str, before: Case, again: Case) -> OffProof:
    """Compare the scene before and after the effect was on in this process. Collective."""
    layout = before.model.system.layout
    prints, counts = [again.prints], [(again.objects, again.objects_in_steps)]
    with_zero = neutral(before.model.scene, name, layout.dimension)
    if with_zero is not None:
        model = build(with_zero, comm=layout.comm)
        run = Run(model, RunOptions())
        prints.append(fingerprint(model, run))
        run.midpoint.destroy()
        if before.objects:
            counts.append(objects_of(layout.comm, with_zero))
    return OffProof(
        same_operators=all(p == before.prints for p in prints),
        same_objects=not before.objects_in_steps and all(c == (before.objects, {}) for c in counts),
        same_work=again.flops == before.flops,
    )


def find(
    s: Switch, explanation: Explanation, cases: dict[str, Case], changes: Changes, together: Together, noise: float
) -> Finding:
    """Judge one effect and say what to do about it. Collective."""
    scene = cases[SCENE].model.scene
    gate, tolerance = explanation.effects[s.name], scene.study.tolerance
    proof = None if s.on else prove_off(s.name, cases[SCENE], cases[AGAIN])
    if s.other is None:
        advice = f"Not tried: {s.reason}."
        return Finding(s.name, s.on, s.value, gate, "not tried", advice, None, None, None, None, proof)
    (change, control), company = changes[s.name], together.company[s.name]
    pair = (cases[SCENE], cases[s.name]) if s.on else (cases[s.name], cases[SCENE])
    cost = cost_of(*pair, noise)
    why = needed_for_control(s, control, gate, scene)
    largest = max(change.outputs, 0.0 if company.forced else company.together)
    verdict = judge(largest, bool(why) or company.forced, cost.any, tolerance)
    if company.partners:
        advice = _advice_together(s, change.outputs, company, scene)
    else:
        advice = _advice(s, verdict, change.outputs, why, cost, tolerance)
        if verdict == "needed" and company.change.outputs <= tolerance:
            advice += f" Beside the other advised effects it changes them by {company.change.outputs:.1e} only."
    return Finding(s.name, s.on, s.value, gate, verdict, advice, change, control, company, cost, proof)


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
    parts = []
    if cost.flops_relative > 0:
        parts.append(f"{percent(cost.flops_relative)} to the operations of a step")
    if cost.memory_relative > 0:
        parts.append(f"{percent(cost.memory_relative)} to the memory")
    return " and ".join(parts)


# --- whether linear elements are enough


def judge_elements(model: Model, trajectory: Trajectory, tolerance: float) -> Elements | None:
    """Run the scene with P2 when it has P1 and a ratio of Poisson at which P1 locks, else None. Collective."""
    nu = max(young_poisson(m.lam, m.mu)[1] for m in model.system.materials)
    if model.scene.tissue.order != 1 or nu <= LOCKING + 1e-9:
        return None
    other = build(quadratic(model), comm=model.system.layout.comm)
    change = compare(shown(model, trajectory), shown(other, simulate(other, RunOptions())))
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

    return changed(model.scene, edit)
