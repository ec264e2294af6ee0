"""Layers: parts of the tissue with a material of their own."""

from __future__ import annotations

from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.scene.materials import young_poisson
from softgrasp.fem.scene.scene import Scene


class LayersEffect(Effect):
    """K = sum_k mu_k K_mu,k + lambda_k K_lambda,k and M = sum_k rho_k M_1,k over the layers k."""

    name = "layers"
    term = "sums over the layers in M and K"
    cost = "Each layer needs 3 tissue matrices, which serve new materials without assembly; a step does no more work."
    threshold = 1.05  # stiffness within 5 % is one material for any purpose here

    def active(self, scene: Scene) -> bool:
        """Whether the scene has layers."""
        return bool(scene.tissue.layers)

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """The three components of each layer."""
        return tuple(f"{key}[{name}]" for name in scene.tissue.layers for key in ("K_mu", "K_lambda", "M_1"))

    def gate(self, problem: Problem) -> Gate:
        """Contrast max E / min E; layers of one stiffness still matter if another property differs."""
        materials = problem.materials
        young, nu = zip(*(young_poisson(m.lam, m.mu) for m in materials), strict=True)
        rho = [m.rho for m in materials]
        number, symbol = max(young) / min(young), "max E / min E"
        if not self.active(problem.scene):
            return Gate(1.0, symbol, self.threshold, False, "One material.")
        density = max(rho) / min(rho)
        others = [
            word
            for word, differs in (
                ("density", density > self.threshold),
                ("Poisson's ratio", max(nu) - min(nu) > 0.01),
                ("viscosity", len({m.beta for m in materials}) > 1),
            )
            if differs
        ]
        matters = number > self.threshold or bool(others)
        condition = f"counts by its {' and '.join(others)} too" if others and number <= self.threshold else ""
        sentence = f"The stiffest layer is {number:.3g} times as stiff as the softest"
        sentence += f"; they also differ in {' and '.join(others)}." if others else "."
        return Gate(number, symbol, self.threshold, matters, sentence, condition=condition)
