"""Verdict on each effect, and one sentence of advice."""

from __future__ import annotations

from softgrasp.fem import EFFECTS, Scene
from softgrasp.study.effects.measure import AGAIN, SCENE, MeasuredScene, check_zero_cost, cost_of
from softgrasp.study.effects.result import Change, Cost, EffectResult, JointChange
from softgrasp.study.effects.switch import Switch
from softgrasp.study.effects.together import Changes, JointAdvice, Rival
from softgrasp.study.forward.explain import EffectReport, Explanation
from softgrasp.study.report import in_words, percent


def verdict_of(change: float, controls: bool, costs: bool, tolerance: float) -> str:
    """needed, optional or wasted.

    Needed: it changes the outputs by more than the tolerance. Optional: it does not, but it is free, or the control
    problem needs it. Wasted: it has a cost and changes no output.
    """
    if change > tolerance:
        return "needed"
    return "wasted" if costs and not controls else "optional"


def assess(
    s: Switch,
    explanation: Explanation,
    cases: dict[str, MeasuredScene],
    changes: Changes,
    together: JointAdvice,
    noise: dict[str, float],
) -> EffectResult:
    """Judge one effect and say what to do about it. Collective."""
    scene = cases[SCENE].model.scene
    gate, tolerance = explanation.effects[s.name], scene.study.tolerance
    proof = None if s.on else check_zero_cost(s.name, cases[SCENE], cases[AGAIN])
    if s.other is None:
        return EffectResult(s.name, s.on, s.value, gate, "not tried", f"Not tried: {s.reason}.", proof=proof)
    (change, control), company = changes[s.name], together.company.get(s.name)
    pair = (cases[SCENE], cases[s.name]) if s.on else (cases[s.name], cases[SCENE])
    cost = cost_of(*pair, noise)
    why = needed_for_control(s, control, gate, scene)
    joined = company is not None and bool(company.partners)
    hidden = company.together if company is not None and not company.forced else 0.0
    forced = company is not None and company.forced
    verdict = verdict_of(max(change.outputs, hidden), bool(why) or forced, cost.any, tolerance)
    if s.name in together.rivals:
        advice = _advice_apart(together.rivals[s.name], change.outputs, company, changes, scene)
    elif company is not None and joined:
        advice = _advice_together(s, change.outputs, company, scene)
    else:
        advice = _advice(s, verdict, change.outputs, why, cost, tolerance)
        if verdict == "needed" and company is not None and company.change.outputs <= tolerance:
            others = in_words([name for name in together.beside if name != s.name])
            advice += f" Beside {others} it changes them by {percent(company.change.outputs)} only."
    return EffectResult(s.name, s.on, s.value, gate, verdict, advice, change, control, company, cost, proof)


def shows(s: Switch, changes: tuple[Change, float | None], gate: EffectReport, scene: Scene) -> bool:
    """Whether the effect shows in the scene as it is, or its control problem needs it."""
    change, control = changes
    return change.outputs > scene.study.tolerance or bool(needed_for_control(s, control, gate, scene))


def needed_for_control(s: Switch, control: float | None, gate: EffectReport, scene: Scene) -> str:
    """Why the control problem needs an effect that changes no output of the run; empty if it does not."""
    if control is not None and control > scene.study.tolerance:
        return f"when a force moves the hand, as in the control problem, it changes them by {percent(control)}"
    if s.name == "damping" and scene.control is not None and gate.gate.matters:
        return "without damping no feedback stabilises the high modes in the control problem"
    return ""


def _advice(s: Switch, verdict: str, change: float, why: str, cost: Cost, tolerance: float) -> str:
    if verdict == "needed":
        text = "Keep it: it changes" if s.on else "Switch it on if it acts on your robot: it would change"
        text += f" the outputs by {percent(change)}, tolerance {percent(tolerance)}"
        if s.strength is not None and change < 0.1:  # where the change still grows with the strength
            text += (
                f"; below about {s.strength * tolerance / change:.2g} {s.unit} its change would be below the tolerance"
            )
        return text + "."
    little = _change_in_words(change)
    if why:
        return f"{'Keep' if s.on else 'Switch'} it{'' if s.on else ' on'} for control alone: it {little}, but {why}."
    if verdict == "wasted":
        text = "Switch it off" if s.on else "It is right to leave it off"
        return f"{text}: it {little} and adds {_cost_in_words(cost)}."
    return f"{'Keep or drop it' if s.on else 'It is right to leave it off'}: it {little} and costs nothing in this run."


def _advice_apart(rival: Rival, change: float, company: JointChange | None, changes: Changes, scene: Scene) -> str:
    """For an effect that shows, but cannot go with one that is advised."""
    change_rival, tolerance = percent(changes[rival.name][0].outputs), percent(scene.study.tolerance)
    more = f"{rival.name} by {change_rival}, tolerance {tolerance}; {rival.why}."
    begin = f"Switch it on only in place of {rival.name}, which is advised:"
    if company is None or not company.partners:
        return f"{begin} it would change the outputs by {percent(change)}, {more}"
    force = " when a force moves the hand, as in the control problem" if company.forced else ""
    state = _switching(company.partners, scene)
    return f"{begin} {state} it would change the outputs by {percent(company.together)}{force}, {more}"


def _advice_together(s: Switch, change: float, company: JointChange, scene: Scene) -> str:
    """For an effect that shows only when others are switched too."""
    partners, on = in_words(company.partners), [EFFECTS[name].active(scene) for name in company.partners]
    force = " when a force moves the hand, as in the control problem" if company.forced else ""
    number = f"the outputs by {percent(company.together)}{force}, tolerance {percent(scene.study.tolerance)}"
    among = f", {_switching(company.among, scene)}," if company.among else ""
    if company.pair and s.on and all(on):
        return f"Keep it, or {partners}: each can go alone, but leaving out both{among} changes {number}."
    begin = f"{'Keep it' if s.on else 'Switch it on'}{' for control' if force else ''}"
    little = f"alone it {_change_in_words(change)}"
    if company.pair:
        return (
            f"{begin}, {'keep' if all(on) else 'switch on'} {partners} too: {little}, but both{among} change {number}."
        )
    state = _switching(company.partners, scene)
    return f"{begin}, {state}: {little}, but {state} it changes {number}."


def _switching(names: tuple[str, ...], scene: Scene) -> str:
    """What is switched in the scene, in words."""
    off = [name for name in names if EFFECTS[name].active(scene)]
    on = [name for name in names if name not in off]
    return " and ".join([*([f"with {in_words(on)} on"] if on else []), *([f"without {in_words(off)}"] if off else [])])


def _change_in_words(change: float) -> str:
    return "changes nothing" if change == 0 else f"changes the outputs by {percent(change)} only"


def _cost_in_words(cost: Cost) -> str:
    shares = (cost.flops_relative, "operations of a step"), (cost.memory_relative, "memory")
    return " and ".join(f"{percent(share)} to the {what}" for share, what in shares if share > 0)
