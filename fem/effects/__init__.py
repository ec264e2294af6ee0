"""Effects a scene can switch on; each states its term, operators, cost and when it matters."""

from __future__ import annotations

from fem.effects.damping import Damping
from fem.effects.gate import Effect, Gate, Problem
from fem.effects.gravity import Gravity
from fem.effects.layers import Layers
from fem.effects.reaction import Reaction
from fem.effects.rotation import Rotation

__all__ = ["EFFECTS", "Effect", "Gate", "Problem"]

EFFECTS: dict[str, Effect] = {
    effect.name: effect for effect in (Gravity(), Damping(), Reaction(), Rotation(), Layers())
}
"""All effects by name, in the order in which they are reported."""
