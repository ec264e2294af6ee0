"""Gravity: a uniform acceleration, which enters through the coupling G that is there anyway."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.effects.gate import Gate, Problem
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.materials import young_poisson

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

EARTH = 9.81  # [m/s2], assumed when the scene leaves gravity off


def acceleration(scene: Scene, n_s: int) -> Array | None:
    """Free fall in the hand's degrees of freedom, g = [g_1 .. g_d, 0 ..] (n_s,) [m/s2]; None when off.

    Not collective.
    """
    gravity = scene.effects.gravity
    if gravity is None:
        return None
    return np.pad(np.asarray(gravity.g, dtype=float), (0, n_s - len(gravity.g)))


class Gravity:
    """Body force rho g: f_e = G g, for K_ee T + K_es = 0 makes falling the same as accelerating the hand."""

    name = "gravity"
    term = "f_e = G g, as the load -G (q_s'' - g)"
    cost = "No operator and no work in a step: n_s numbers shift the hand's acceleration in a product that is there."

    def active(self, scene: Scene) -> bool:
        """Whether the scene has it on. Not collective."""
        return scene.effects.gravity is not None

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """None: n_s numbers. Not collective."""
        return ()

    def gate(self, problem: Problem) -> Gate:
        """Strain scale rho g L / E of the softest layer for its weight. Not collective."""
        gravity = problem.scene.effects.gravity
        g = EARTH if gravity is None else float(np.linalg.norm(gravity.g))
        softness = max(m.rho / young_poisson(m.lam, m.mu)[0] for m in problem.materials)
        number = softness * g * problem.length
        threshold = 0.01
        matters = number > threshold
        if gravity is None:
            sentence = f"Off; in SI units and with g = {EARTH} it would strain the tissue by about {number:.2g}."
        else:
            sentence = f"The weight strains the tissue by about {number:.2g}."
        proviso = "if its numbers are in SI units" if gravity is None else ""
        return Gate(number, "rho g L / E", threshold, matters, sentence, proviso)
