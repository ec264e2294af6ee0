"""Damping of the tissue, Kelvin-Voigt or Rayleigh: uniform it only scales S, layered it has a matrix."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.system import Damping, LayerBlocks, layered_viscosity


def operator(scene: Scene, layers: tuple[LayerBlocks, ...], materials: tuple[LayerMaterial, ...]) -> Damping:
    """D = alpha M + beta K, or with a matrix when the layers differ in beta. Collective."""
    law, matrix = scene.effects.damping, layered_viscosity(layers, materials)
    if law is None:
        return Damping(matrix=matrix)
    return Damping(law.alpha, 0.0 if matrix is not None else materials[0].beta, law.drag == "space", matrix)


def ratios(alpha: float, beta: float, omega: Array) -> Array:
    """Damping ratios zeta_k = (alpha / omega_k + beta omega_k) / 2 of uniform damping."""
    return (alpha / omega + beta * omega) / 2


def layered(scene: Scene) -> bool:
    """Whether a layer has a Kelvin-Voigt time of its own."""
    damping = scene.effects.damping
    return damping is not None and any(
        layer.beta is not None and layer.beta != damping.beta for layer in scene.tissue.layers.values()
    )


class DampingEffect(Effect):
    """D = alpha M + beta K on the motion against the hand, or with drag = "space" against space."""

    name = "damping"
    term = "D_ee z' with D_ee = alpha M_ee + beta K_ee; with drag = 'space' also alpha G q_s'"
    cost = (
        "Equal damping in all layers needs no matrix and a few vector operations a step; layers that differ need D_ee "
        "and two products."
    )

    def operators(self, scene: Scene) -> tuple[str, ...]:
        """D_ee when the layers differ in beta, else none."""
        return ("D_ee",) if layered(scene) else ()

    def gate(self, problem: Problem) -> Gate:
        """Damping ratio of the first mode against one that damps its amplitude by 5 % in the run.

        A mode decays as exp(-zeta omega t).
        """
        scene, symbol = problem.scene, "zeta_1 = (alpha/omega_1 + beta omega_1)/2"
        if layered(scene):
            symbol = "zeta_1 = phi_1' D phi_1 / (2 omega_1)"
        if not problem.omega:
            sentence = "The first frequencies were not computed, so the damping ratios are unknown."
            unknown = "counts as it is set"
            return Gate(float("nan"), symbol, float("nan"), self.active(scene), sentence, condition=unknown)
        end, omega = scene.time_end, problem.omega[0]
        threshold = 0.05 / (omega * end)
        if scene.effects.damping is None:
            sentence = f"Off: undamped ring-down, nothing decays in the {end * omega / (2 * np.pi):.3g} first periods"
            controlled = scene.control is not None
            sentence += "; feedback alone cannot stabilise the high modes." if controlled else " of the run."
            condition = "counts whatever the number: the control problem needs it" if controlled else ""
            return Gate(0.0, symbol, threshold, controlled, sentence, condition=condition)
        zeta = problem.zeta[0]
        left = float(np.exp(-zeta * omega * end))
        sentence = (
            f"zeta of the first {len(problem.zeta)} modes: {', '.join(f'{z:.2g}' for z in problem.zeta)}; "
            f"{left:.2g} of the first mode's amplitude is left at the end."
        )
        return Gate(zeta, symbol, threshold, zeta > threshold, sentence)
