"""Obstacles: the boundary of the tissue meets rigid bodies, without friction."""

from __future__ import annotations

import math

from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.scene.scene import Scene


class ObstaclesEffect(Effect):
    """Forces 0 <= x that keep the gap g >= 0 of all boundary nodes, x'g = 0, and an inelastic impulse at touch."""

    name = "obstacles"
    term = "N'x with 0 <= x, g >= 0, x'g = 0 on the boundary, and an inelastic impulse at touch"
    cost = "A look at the gaps in every step, one solve for a node that touches, a small problem in a step of contact."

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Responses to boundary forces, made as nodes touch."""
        return ("columns of S^-1 N'",) if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Whether there is an obstacle to touch; only a run tells whether the tissue gets there."""
        on = self.active(problem.scene)
        sentence = (
            f"{len(problem.scene.obstacle or [])} obstacles; a run that never touches one repeats that without the "
            "effect bit for bit: drop it then."
            if on
            else "Off; the scene has no [[obstacle]]."
        )
        condition = "counts where an [[obstacle]] is given; the run tells the least gap"
        return Gate(math.nan, "least gap", math.nan, on, sentence, condition=condition)
