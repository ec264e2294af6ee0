"""Gravity: a uniform acceleration, which needs no operator but the coupling G."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.gate import SMALL_SHARE, Effect, Gate, Problem
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.shown import percent

EARTH = 9.81  # [m/s2], assumed when the scene has no gravity


def acceleration(scene: Scene, n_s: int) -> Array | None:
    """Free fall in the hand's degrees of freedom, g = [g_1 .. g_d, 0 ..] (n_s,) [m/s2]; None when off."""
    gravity = scene.effects.gravity
    if gravity is None:
        return None
    return np.pad(np.asarray(gravity.g, dtype=float), (0, n_s - len(gravity.g)))


class GravityEffect(Effect):
    """Body force rho g: f_e = G g, for K_ee T + K_es = 0 makes falling the same as accelerating the hand."""

    name = "gravity"
    term = "f_e = G g, as the load -G (q_s'' - g)"
    cost = "Gravity adds no work in a step: G multiplies q_s'' - g instead of q_s''."
    threshold = 0.01

    def gate(self, problem: Problem) -> Gate:
        """Gradient of the static displacement under the weight, bending included; `fem.model.scales` solves for it."""
        off, sag, length = problem.scene.effects.gravity is None, problem.sag, problem.length
        number = sag.gradient.typical
        bends = f"sag by {sag.largest:.2g} m, {sag.largest / length:.2g} of its length {length:.3g} m"
        steep = f"|grad z| is at most {number:.2g} in {percent(1 - SMALL_SHARE)} of the body"
        begin = (
            f"Off; in SI units and with g = {EARTH} the tissue would" if off else "Under its weight the tissue would"
        )
        holds = (
            "holds" if sag.gradient.linear else f"does not hold, {percent(sag.gradient.share)} of the body is above 0.1"
        )
        sentence = f"{begin} {bends}, by linear elasticity; {steep}: the theory {holds}."
        scene, proviso = problem.scene, "if its numbers are in SI units" if off else ""
        gravity, feels = scene.effects.gravity, scene.effects.reaction
        falls = gravity is not None and scene.motion.drive == "force" and (gravity.hand_weight or feels)
        if falls:
            sentence += " It also pulls on the hand, which a force drives: without it the motion is another one."
        return Gate(number, "|grad z| of its sag", self.threshold, falls or number > self.threshold, sentence, proviso)
