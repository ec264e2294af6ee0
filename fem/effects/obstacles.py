"""Obstacles: the boundary of the tissue meets rigid bodies, with friction where they have any."""

from __future__ import annotations

from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.scene.scene import Scene


class ObstaclesEffect(Effect):
    """Forces 0 <= x that keep the gap g >= 0 of all boundary nodes, x'g = 0, and an inelastic impulse at touch."""

    name = "obstacles"
    threshold = 0.0
    term = "N'x with 0 <= x, g >= 0, x'g = 0 on the boundary, and an inelastic impulse at touch"
    cost = "A look at the gaps in every step, up to a solve for a node that touches, a small problem in a contact step."

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """Responses to boundary forces, made as nodes touch."""
        return ("columns of S^-1 N', or of their first sweep",) if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Number of obstacles, and whether the path of the hand leads near them; only a run determines a touch."""
        from softgrasp.fem.obstacles.spacing import MOST, base_parts  # few scenes need it

        scene, entries = problem.scene, problem.scene.obstacle or []
        number = len(entries)
        parts = max((base_parts(entry, scene.tissue.order, problem.dimension) for entry in entries), default=1)
        between = f"Nodes touch, and points that divide boundary edges in {parts}" if parts > 1 else "Nodes touch"
        if any(entry.friction for entry in entries):
            between = "Nodes touch"
        elif any(entry.parts is None and entry.kind != "halfspace" for entry in entries):
            between += f"; points are half an obstacle apart that is smaller than an edge, {MOST} to an edge at most"
        sentence = (
            "Off; the scene has no [[obstacle]]."
            if number == 0
            else f"{between}. A run without touch is that without the effect, bit for bit; it reports the least gap."
            if self.active(scene)
            else "Off; the tissue goes through the obstacles that control plans around."
        )
        clear = self.active(scene) and problem.clear
        beside = "the path of the hand stays clear of them" if clear else ""
        return Gate(number, "number of obstacles", self.threshold, number > 0 and not clear, sentence, condition=beside)
