"""Effects a scene can switch on; each states its term, operators, cost and when it matters."""

from __future__ import annotations

from softgrasp.fem.effects.damping import DampingEffect
from softgrasp.fem.effects.finite_strain import FiniteStrainEffect
from softgrasp.fem.effects.frame import FrameEffect
from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.effects.gravity import GravityEffect
from softgrasp.fem.effects.layers import LayersEffect
from softgrasp.fem.effects.obstacles import ObstaclesEffect
from softgrasp.fem.effects.reaction import ReactionEffect
from softgrasp.fem.effects.rotation import RotationEffect

__all__ = ["EFFECTS", "Effect", "Gate", "Problem"]

_ALL = (
    GravityEffect(),
    DampingEffect(),
    ReactionEffect(),
    RotationEffect(),
    FrameEffect(),
    LayersEffect(),
    FiniteStrainEffect(),
    ObstaclesEffect(),
)
EFFECTS: dict[str, Effect] = {effect.name: effect for effect in _ALL}
"""All effects by name, in the order in which they are reported."""
