"""The equations of a control problem as text: the plant that a force moves, its cost, and what the gain solves."""

from __future__ import annotations

from dataclasses import replace

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.report.equation import equation
from softgrasp.study.report.page import equation_text

FEEDBACK = (
    ("state", ("E x'",), ("A x", "B u, x = [q_s, q_s', z, z']")),
    ("output", ("y",), ("C x",)),
    ("cost", ("J",), ("int <y - y_target, Q (y - y_target)>", "<u, R u> dt")),
    ("Riccati", ("A^T P E", "E^T P A", "- E^T P B R^-1 B^T P E", "C^T Q C"), ("0",)),
    ("gain", ("u",), ("u_target", "K (x - x_target), K = -R^-1 B^T P E")),
)


def control_text(scene: Scene) -> str:
    """The scene's equation with a force on the hand, then cost, Riccati equation and gain.

    u_target holds the body at rest at the target: the hand's weight, else nothing.
    """
    free = scene.model_copy(update={"motion": scene.motion.model_copy(update={"drive": "force", "profile": "hold"})})
    plant = equation(free)
    stepped = tuple(
        (name, left, tuple(term.replace("u(t)", "u") for term in right)) for name, left, right in plant.stepped
    )
    where = tuple(text for text in plant.where if not text.startswith("u(t):"))
    return equation_text(replace(plant, stepped=stepped, where=where, feedback=FEEDBACK))
