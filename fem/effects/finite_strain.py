"""Finite strain: a hyperelastic law instead of linear elasticity."""

from __future__ import annotations

from softgrasp.fem.effects.gate import Gate, Problem
from softgrasp.fem.scene.scene import Scene

SLOPE = 0.35  # error of linear elasticity over rms|grad z|: 0.29 to 0.37 over seven materials and six amplitudes in 2D
THRESHOLD = 0.01  # error of the deformation


def linear_error(rms: float) -> float:
    """Estimated error that linear elasticity makes in the deformation [1], from rms|grad z| of its answer."""
    return SLOPE * rms


class FiniteStrain:
    """f(z) = dW/dz of a law W(F), F = I + grad z, instead of K_ee z."""

    name = "finite_strain"
    term = "f(z) = dW/dz instead of K_ee z, with W(F) of effects.finite_strain.law and F = I + grad z"
    cost = "The gradient B and the law in every point: two to five iterations a step and now and then a new factor."

    def active(self, scene: Scene) -> bool:
        """Whether the scene has it on."""
        return scene.effects.finite_strain is not None

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """The gradient in the quadrature points."""
        return ("B",) if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Estimated error of linear elasticity, from its static response to the hand's largest acceleration."""
        scene, number = problem.scene, linear_error(problem.response.rms)
        symbol = "0.35 rms|grad z| of the static response"
        condition = ""
        if scene.effects.rotation and not self.active(scene):
            condition = "cannot be tried beside effects.rotation"
            sentence = f"Off; linear elasticity would be off by about {number:.2g} of the deformation; "
            sentence += "the linearised rotation does not go with finite strain."
            return Gate(number, symbol, THRESHOLD, False, sentence, condition=condition)
        if self.active(scene):
            sentence = f"Linear elasticity would be off by about {number:.2g} of the deformation."
        else:
            sentence = f"Off; linear elasticity is off by about {number:.2g} of the deformation"
            sentence += ": set effects.finite_strain.law = 'neo-hooke'." if number > THRESHOLD else "."
        return Gate(number, symbol, THRESHOLD, number > THRESHOLD, sentence)
