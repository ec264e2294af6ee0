"""The scene with one effect switched the other way, everything else as it is.

An effect that is on is taken out; one that is off is put in with a trial value that is stated beside every result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from softgrasp.fem import EARTH, EFFECTS, Scene

TRIAL_ZETA = 0.01  # ratio of the first mode; silicone and passive tissue lie above, so it is a careful guess
TRIAL_LAW = "neo-hooke"
Table = dict[str, Any]
Value = tuple[str, float | None, str]  # in words; size where the change grows with it, and unit of the size


@dataclass(frozen=True)
class Scales:
    """What the trial values rest on."""

    dimension: int  # 2 or 3
    mass: float  # of the whole tissue [kg]
    inertia: tuple[float, ...]  # moments of the rigid tissue about the reference, one per rotation [kg m2]
    omega: float | None  # lowest angular frequency of the clamped tissue [1/s], or None when it was not computed


@dataclass(frozen=True)
class Switch:
    """One effect and the scene with it switched the other way."""

    name: str  # the effect
    on: bool  # the scene has it on
    value: str  # its value in the scene, or the trial value
    other: Scene | None  # the scene with the effect switched; None when there is no such scene
    reason: str = ""  # why there is none; empty otherwise
    strength: float | None = None  # size of the value, for effects whose change grows with it
    unit: str = ""  # of the strength


def switches(scene: Scene, scales: Scales) -> tuple[Switch, ...]:
    """Every effect with the scene in which it is switched the other way."""
    return tuple(switch(scene, name, scales) for name in EFFECTS)


def switch(scene: Scene, name: str, scales: Scales) -> Switch:
    """One effect with the scene in which it is switched the other way."""
    on, d = EFFECTS[name].active(scene), scales.dimension
    if reason := _obstacle(scene, name, scales):
        return Switch(name, on, "on" if on else "", None, reason)
    entry, (value, strength, unit) = (False, _stated(scene, name)) if on else _trial(scene, name, scales)

    def edit(table: Table) -> None:
        if name == "layers":
            table["tissue"]["layers"] = {}
            return
        table["effects"][name] = entry
        if name == "gravity":
            table["time"]["start"] = "rest" if on else "equilibrium"
        elif name == "obstacles" and not table.get("control", {}).get("constraints"):
            table.pop("obstacle")
        elif name == "damping" and on:
            for layer in table["tissue"]["layers"].values():
                layer.pop("beta", None)
        elif name == "rotation":
            table["hand"] |= {} if on else {"inertia": _hand_inertia(scene, scales)}
            _resize(table, d, d if on else d + len(scales.inertia))

    try:
        return Switch(name, on, value, scene.changed(edit), "", strength, unit)
    except ValidationError as error:
        return Switch(name, on, value, None, error.errors()[0]["msg"].removeprefix("Value error, "))


def neutral(scene: Scene, name: str, d: int) -> Scene | None:
    """The scene with the effect named but of strength zero; None for effects that know no strength."""
    zero = {"gravity": {"g": [0.0] * d}, "damping": {"kind": "kelvin-voigt", "beta": 0.0}}
    return scene.changed(lambda table: table["effects"].update({name: zero[name]})) if name in zero else None


def _obstacle(scene: Scene, name: str, scales: Scales) -> str:
    """Why the effect cannot be switched; empty where it can."""
    on = EFFECTS[name].active(scene)
    if name == "layers" and not on:
        return "there is no second material to try: layers cannot be invented"
    if name == "damping" and not on and scales.omega is None:
        return "the first frequency, which scales the trial value, is not computed"
    if name == "obstacles" and not on:
        return "there is no [[obstacle]] to try"
    if name == "frame" and not on and not scene.effects.rotation:
        return "the hand does not turn"
    if name == "rotation" and on and scene.effects.frame is not None:
        return "effects.frame needs it"
    if name == "rotation" and scene.motion.profile == "csv":
        return "the columns of motion.csv are the angles" if on else "motion.csv has no columns for angles"
    return ""


def _stated(scene: Scene, name: str) -> Value:
    """What the scene says of an effect that is on; the change is proportional to beta while it is small."""
    gravity, damping, strain = scene.effects.gravity, scene.effects.damping, scene.effects.finite_strain
    if name == "gravity" and gravity is not None:
        return f"g = {_vector(gravity.g)} m/s2", math.hypot(*gravity.g), "m/s2"
    if name == "damping" and damping is not None:
        text = f"beta = {damping.beta:g} s"
        return (f"{text}, alpha = {damping.alpha:g} 1/s", None, "") if damping.alpha else (text, damping.beta, "s")
    texts = {
        "finite_strain": strain.law if strain is not None else "",
        "layers": f"{', '.join(scene.tissue.layers)} instead of tissue.material everywhere",
        "rotation": f"hand.inertia = {_inertia(scene.hand.inertia)} kg m2",
    }
    return texts.get(name, "on"), None, ""


def _trial(scene: Scene, name: str, scales: Scales) -> tuple[Any, Value]:
    """Entry of the scene that puts an effect in, and its value."""
    if name == "gravity":
        g = [0.0] * (scales.dimension - 1) + [-EARTH]
        return {"g": g}, (f"g = {_vector(g)} m/s2, from equilibrium", EARTH, "m/s2")
    if name == "damping" and scales.omega is not None:
        beta = 2 * TRIAL_ZETA / scales.omega
        value = f"beta = {beta:.3g} s: zeta_1 = {TRIAL_ZETA:g}"
        return {"kind": "kelvin-voigt", "beta": beta}, (value, beta, "s")
    if name == "frame":
        return "hand", ("hand", None, "")
    if name == "finite_strain":
        return {"law": TRIAL_LAW}, (TRIAL_LAW, None, "")
    if name == "rotation":
        source = "" if scene.hand.inertia is not None else ", the tissue's radius of gyration"
        return True, (f"hand.inertia = {_inertia(_hand_inertia(scene, scales))} kg m2{source}", None, "")
    return True, ("on", None, "")


def _hand_inertia(scene: Scene, scales: Scales) -> float | list[float]:
    """Moments of the hand, given or with the tissue's radius of gyration [kg m2]."""
    estimate = [scene.hand.mass / scales.mass * moment for moment in scales.inertia]
    return scene.hand.inertia or (estimate if scales.dimension == 3 else estimate[0])


def _resize(table: Table, d: int, n_s: int) -> None:
    """Cut or pad with zeros what has an entry per freedom of the hand; new weights of angles are that of x."""
    target = table["motion"].get("target")
    if target is not None:
        table["motion"]["target"] = (target[:d] + [0.0] * n_s)[:n_s]
    R = table.get("control", {}).get("R")
    if isinstance(R, list):
        first = R[0][0]
        table["control"]["R"] = [
            [R[i][j] if max(i, j) < min(len(R), n_s) else first * (i == j) for j in range(n_s)] for i in range(n_s)
        ]


def _vector(values: Sequence[float], form: str = "g") -> str:
    return "(" + ", ".join(f"{v:{form}}" for v in values) + ")"


def _inertia(value: float | list[float] | None) -> str:
    return "none" if value is None else _vector(value, ".3g") if isinstance(value, list) else f"{value:.3g}"
