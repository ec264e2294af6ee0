"""Finite strain: a hyperelastic law instead of linear elasticity."""

from __future__ import annotations

from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.scene.scene import Scene

# Error of linear elasticity over rms|grad z|, measured: on the paper's scene 0.29 to 0.37 over seven materials and six
# amplitudes; on blocks, plates and strips of tetrahedra 0.46 to 1.7 for moves in all directions, 0.28 to 0.31 across. A
# block in plane strain has 2/3 of what it has in 3D under the same move, so the dimension counts; the direction counts
# as well, and the factor is the geometric mean of what was seen.
SLOPE = {2: 0.35, 3: 0.7}


def linear_error(rms: float, dimension: int) -> float:
    """Estimated error that linear elasticity makes in the deformation [1], from rms|grad z| of its answer."""
    return SLOPE[dimension] * rms


class FiniteStrainEffect(Effect):
    """f(z) = dW/dz of a law W(F), F = I + grad z, instead of K_ee z."""

    name = "finite_strain"
    term = "f(z) = dW/dz instead of K_ee z, with W(F) of effects.finite_strain.law and F = I + grad z"
    cost = "The gradient B and the law in every point: two to five iterations a step and now and then a new factor."
    threshold = 0.01  # error of the deformation

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """The gradient in the quadrature points."""
        return ("B",) if self.active(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Estimated error of linear elasticity, from its static response to the hand's largest acceleration."""
        scene, number = problem.scene, linear_error(problem.response.rms, problem.dimension)
        symbol = f"{SLOPE[problem.dimension]:g} rms|grad z| of the static response"
        condition = ""
        if scene.effects.rotation and scene.effects.frame is None and not self.active(scene):
            condition = "cannot be tried beside effects.rotation"
            sentence = f"Off; linear elasticity would have an error of about {number:.2g} of the deformation; "
            sentence += "the linearised rotation does not go with finite strain."
            return Gate(number, symbol, self.threshold, False, sentence, condition=condition)
        if self.active(scene):
            sentence = f"Linear elasticity would have an error of about {number:.2g} of the deformation."
        else:
            sentence = f"Off; linear elasticity has an error of about {number:.2g} of the deformation"
            sentence += ": set effects.finite_strain.law = 'neo-hooke'." if number > self.threshold else "."
        return Gate(number, symbol, self.threshold, number > self.threshold, sentence)
