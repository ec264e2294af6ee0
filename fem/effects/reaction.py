"""Reaction: the hand feels the tissue (two-way coupling)."""

from __future__ import annotations

from softgrasp.fem.effects.gate import Effect, Gate, Problem, force_drives
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.shown import percent


class ReactionEffect(Effect):
    """The inertia of the tissue in the hand's equation; makes M and K symmetric."""

    name = "reaction"
    term = "M_r (q_s'' - g) + G' z'' in the hand's equation"
    cost = (
        "n_s extra solves before the run when a force drives the hand; n_s columns Y and two small reductions a step."
    )
    threshold = 0.05  # the hand's acceleration under a given force changes by about this much

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Y = S^-1 G, n_s columns, and its small product with G, when a force moves the hand."""
        return ("Y", "G'Y") if self.active(scene) and scene.motion.drive == "force" else ()

    def gate(self, problem: Problem) -> Gate:
        """Tissue mass over hand mass; matters only if a force moves the hand."""
        scene = problem.scene
        number = problem.tissue_mass / scene.hand.mass
        change = number / (1 + number)
        on, driven = self.active(scene), force_drives(scene)
        where = "" if scene.motion.drive == "force" else " in the control problem"
        if driven and on:
            sentence = (
                f"The tissue reduces the acceleration of the hand under a force by about {percent(change)}{where}."
            )
        elif driven:
            sentence = (
                f"Off; it would reduce the acceleration of the hand under a force by about {percent(change)}{where}."
            )
        else:
            sentence = "The motion of the hand is prescribed, so the reaction moves nothing."
        proviso = where.removeprefix(" ") if driven else ""
        large = number > self.threshold
        condition = "counts only where a force drives the hand" if large and not driven else ""
        return Gate(number, "tissue mass / hand mass", self.threshold, driven and large, sentence, proviso, condition)
