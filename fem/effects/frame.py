"""The frame of the hand: equations in its own axes, for turns by any angle."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.gate import Effect, Gate, Problem, force_drives
from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.table import read_motion
from softgrasp.fem.shown import percent


def largest_angle(scene: Scene, d: int) -> float:
    """Largest angle of a prescribed motion of the hand [rad], 0 where it does not turn or a force drives it."""
    motion = scene.motion
    if not scene.effects.rotation or motion.drive == "force":
        return 0.0
    if motion.profile == "csv":
        try:
            angles = read_motion(scene, d + d * (d - 1) // 2)[1][:, d:]
        except SceneError:  # is said where the motion is used
            return 0.0
        return float(np.linalg.norm(angles, axis=1).max())
    return float(np.linalg.norm((motion.target or [])[d:]))


class FrameEffect(Effect):
    """Inertia loads and turned gravity of a hand that turns by any angle."""

    name = "frame"
    term = "centrifugal, Coriolis and Euler loads and gravity in the axes of the hand"
    cost = (
        "d^2 more columns beside G and one more form; a step iterates on the turn with the same factor, about 4 solves."
    )
    threshold = 0.1  # angle [rad]: a linearised rotation stretches by angle^2 / 2, here 0.5 %

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Integrals int rho phi_k r_l."""
        return ("S",) if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Largest angle of the motion; a force may turn the hand by any."""
        scene = problem.scene
        angle, forced = largest_angle(scene, problem.dimension), scene.effects.rotation and force_drives(scene)
        on = self.active(scene)
        if not scene.effects.rotation:
            sentence = "Off; the hand does not turn."
        elif angle > self.threshold:
            sentence = f"The motion turns the hand by up to {angle:.3g} rad" + (
                "." if on else f", and small angles stretch the tissue by {percent(angle**2 / 2)} there."
            )
        elif forced:
            sentence = "A torque can turn the hand, by how much only a run determines."
        else:
            sentence = f"The motion turns the hand by {angle:.3g} rad at most: small angles serve."
        matters = angle > self.threshold or (on and forced)
        condition = "counts where a torque can turn the hand" if matters and not angle > self.threshold else ""
        return Gate(angle, "angle of the hand [rad]", self.threshold, matters, sentence, condition=condition)
