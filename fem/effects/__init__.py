"""Effects a scene can switch on; each states its term, operators, cost and when it matters."""

from __future__ import annotations

from softgrasp.fem.effects.damping import Damping
from softgrasp.fem.effects.finite_strain import FiniteStrain
from softgrasp.fem.effects.gate import Effect, Gate, Problem
from softgrasp.fem.effects.gravity import Gravity
from softgrasp.fem.effects.layers import Layers
from softgrasp.fem.effects.reaction import Reaction
from softgrasp.fem.effects.rotation import Rotation

__all__ = ["EFFECTS", "Effect", "Gate", "Problem"]

EFFECTS: dict[str, Effect] = {
    effect.name: effect for effect in (Gravity(), Damping(), Reaction(), Rotation(), Layers(), FiniteStrain())
}
"""All effects by name, in the order in which they are reported."""
