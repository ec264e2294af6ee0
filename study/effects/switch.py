"""The scene with one effect switched the other way, everything else as it is.

An effect that is on is taken out; one that is off is put in with a trial value that is stated beside every result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.effects.gravity import EARTH
from softgrasp.fem.scene.scene import Scene

TRIAL_ZETA = 0.01  # ratio of the first mode; silicone and passive tissue lie above, so it is a careful guess
TRIAL_LAW = "neo-hooke"
Table = dict[str, Any]


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
    # size of the value in its own unit, for effects whose change grows with it; None for the others
    strength: float | None = None
    unit: str = ""  # of the strength


def changed(scene: Scene, edit: Callable[[Table], None]) -> Scene:
    """A copy of the scene after ``edit`` changed its table in place."""
    data = scene.model_dump(mode="json", by_alias=True, exclude_none=True)
    edit(data)
    result = Scene.model_validate(data)
    result._directory = scene.directory
    return result


def switches(scene: Scene, scales: Scales) -> tuple[Switch, ...]:
    """Every effect with the scene in which it is switched the other way."""
    return tuple(switch(scene, name, scales) for name in EFFECTS)


def switch(scene: Scene, name: str, scales: Scales) -> Switch:
    """One effect with the scene in which it is switched the other way."""
    return (_without if EFFECTS[name].active(scene) else _with)(scene, name, scales)


def neutral(scene: Scene, name: str, d: int) -> Scene | None:
    """The scene with the effect named but of strength zero; None for effects that know no strength."""
    if name == "gravity":
        return changed(scene, lambda t: t["effects"].update(gravity={"g": [0.0] * d}))
    if name == "damping":
        return changed(scene, lambda t: t["effects"].update(damping={"kind": "kelvin-voigt", "beta": 0.0}))
    return None


# --- an effect that is on, taken out


def _without(scene: Scene, name: str, scales: Scales) -> Switch:
    if name == "rotation" and scene.motion.profile == "csv":
        return Switch(name, True, "on", None, "the columns of motion.csv hold the angles")
    d, (value, strength, unit) = scales.dimension, _value(scene, name)

    def edit(table: Table) -> None:
        if name == "layers":
            table["tissue"]["layers"] = {}
            return
        table["effects"][name] = False
        if name == "gravity":
            table["time"]["start"] = "rest"
        elif name == "damping":
            for layer in table["tissue"]["layers"].values():
                layer.pop("beta", None)
        elif name == "rotation":
            _resize(table, d, d)

    return Switch(name, True, value, changed(scene, edit), "", strength, unit)


def _value(scene: Scene, name: str) -> tuple[str, float | None, str]:
    """What the scene states; size and unit where the change is proportional to it, for beta while it is small."""
    gravity, damping = scene.effects.gravity, scene.effects.damping
    if name == "gravity" and gravity is not None:
        return f"g = {_vector(gravity.g)} m/s2", math.hypot(*gravity.g), "m/s2"
    if name == "damping" and damping is not None:
        text = f"beta = {damping.beta:g} s"
        return (f"{text}, alpha = {damping.alpha:g} 1/s", None, "") if damping.alpha else (text, damping.beta, "s")
    if name == "finite_strain" and scene.effects.finite_strain is not None:
        return scene.effects.finite_strain.law, None, ""
    if name == "layers":
        return f"{', '.join(scene.tissue.layers)} instead of tissue.material everywhere", None, ""
    return f"hand.inertia = {_inertia(scene.hand.inertia)} kg m2" if name == "rotation" else "on", None, ""


# --- an effect that is off, put in with a trial value


def _with(scene: Scene, name: str, scales: Scales) -> Switch:
    d = scales.dimension
    if name == "layers":
        return Switch(name, False, "", None, "there is no second material to try: layers cannot be invented")
    if name == "gravity":
        g = [0.0] * (d - 1) + [-EARTH]

        def edit(table: Table) -> None:
            table["effects"]["gravity"] = {"g": g}
            table["time"]["start"] = "equilibrium"

        return Switch(name, False, f"g = {_vector(g)} m/s2, from equilibrium", changed(scene, edit), "", EARTH, "m/s2")
    if name == "damping":
        if scales.omega is None:
            return Switch(name, False, "", None, "the first frequency, which scales the trial value, is not computed")
        beta = 2 * TRIAL_ZETA / scales.omega
        law = {"kind": "kelvin-voigt", "beta": beta}
        other = changed(scene, lambda table: table["effects"].update(damping=law))
        return Switch(name, False, f"beta = {beta:.3g} s: zeta_1 = {TRIAL_ZETA:g}", other, "", beta, "s")
    if {name, *(other for other, effect in EFFECTS.items() if effect.active(scene))} >= {"rotation", "finite_strain"}:
        return Switch(name, False, "", None, "effects.rotation and effects.finite_strain exclude each other")
    if name == "rotation":
        return _turning(scene, scales)
    if name == "finite_strain":
        other = changed(scene, lambda table: table["effects"].update(finite_strain={"law": TRIAL_LAW}))
        return Switch(name, False, TRIAL_LAW, other)
    return Switch(name, False, "on", changed(scene, lambda table: table["effects"].update({name: True})))


def _turning(scene: Scene, scales: Scales) -> Switch:
    if scene.motion.profile == "csv":
        return Switch("rotation", False, "", None, "motion.csv has no columns for angles")
    d, given = scales.dimension, scene.hand.inertia
    estimate = [scene.hand.mass / scales.mass * moment for moment in scales.inertia]
    inertia = given if given is not None else estimate if d == 3 else estimate[0]

    def edit(table: Table) -> None:
        table["effects"]["rotation"] = True
        table["hand"]["inertia"] = inertia
        _resize(table, d, d + len(scales.inertia))

    source = "" if given is not None else ", the tissue's radius of gyration"
    return Switch("rotation", False, f"hand.inertia = {_inertia(inertia)} kg m2{source}", changed(scene, edit))


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
