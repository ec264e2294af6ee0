"""Rotation: the hand turns by small angles about its reference point."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.gate import Effect, Gate, Problem, force_drives
from softgrasp.fem.effects.reaction import ReactionEffect
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene


def hand_inertia(scene: Scene, d: int) -> Array | None:
    """Moments of inertia of the hand, one per rotation, (d (d - 1) / 2,) [kg m2]; None if not given."""
    if scene.hand.inertia is None:
        return None
    given = np.atleast_1d(np.asarray(scene.hand.inertia, dtype=float))
    return np.broadcast_to(given, (d * (d - 1) // 2,)).copy()


def hand_mass(scene: Scene, d: int) -> Array:
    """M_hand = blkdiag(m I, inertia), (n_s, n_s) [kg, kg m2]."""
    diagonal = np.full(d, scene.hand.mass)
    inertia = hand_inertia(scene, d)
    if scene.effects.rotation and inertia is not None:
        diagonal = np.append(diagonal, inertia)
    return np.diag(diagonal)


class RotationEffect(Effect):
    """d (d - 1) / 2 rotations in q_s, linearised unless ``effects.frame`` is given."""

    name = "rotation"
    term = "d (d-1)/2 small angles in q_s: as many columns more in R, T and G, the hand's inertia in M_ss"
    cost = "R, T and G have 1 column more in 2D and 3 more in 3D; a step multiplies with those columns of G too."
    threshold = 0.05  # the hand's angular acceleration under a given torque changes by about this much

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Columns in operators that are there anyway."""
        return tuple(f"rotation columns of {name}" for name in "RTG") if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Inertia of the rigid tissue about the reference over that of the hand, worst axis.

        A hand of unknown inertia is assumed to have the tissue's radius of gyration.
        """
        scene, d = problem.scene, problem.dimension
        hand = hand_inertia(scene, d)
        symbol = "tissue inertia / hand inertia"
        if hand is None:
            number = problem.tissue_mass / scene.hand.mass
            symbol += " (the hand as large as the tissue)"
        else:
            number = float(np.max(np.asarray(problem.tissue_inertia) / hand))
        if not self.active(scene):
            reaction = scene.effects.reaction
            pulled = reaction or problem.tissue_mass / scene.hand.mass > ReactionEffect.threshold
            matters = pulled and force_drives(scene) and number > self.threshold
            sentence = (
                "Off, though the tissue pulls on a hand that a force drives and would turn it."
                if matters and reaction
                else "Off; with the reaction, which this scene needs too, the tissue would turn the hand."
                if matters
                else "Off; nothing in this scene turns the hand."
                if not reaction
                else "Off; the tissue hardly turns the hand, or the motion is prescribed."
            )
            condition = ""
            if number > self.threshold and not matters:
                condition = "counts only where a force drives the hand and effects.reaction is on"
            proviso = "together with reaction" if matters and not reaction else ""
            return Gate(number, symbol, self.threshold, matters, sentence, proviso, condition)
        angles = (scene.motion.target or [])[d:]
        turned = scene.motion.profile == "csv" or any(angles)
        torque = force_drives(scene)
        if turned:
            sentence = f"The motion turns the hand{f', by up to {max(map(abs, angles)):.3g} rad' if angles else ''}."
        elif torque:
            sentence = f"A torque can turn the hand; tissue inertia is {number:.2g} of the hand's."
        else:
            sentence = "The prescribed motion does not turn the hand."
        condition = "counts only where the motion or a torque turns the hand"
        if turned or torque:
            condition = f"counts whatever the number: {'the motion turns' if turned else 'a torque can turn'} the hand"
        contrary = (number > self.threshold) != (turned or torque)
        return Gate(number, symbol, self.threshold, turned or torque, sentence, condition=condition if contrary else "")
