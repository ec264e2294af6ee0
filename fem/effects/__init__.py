"""Effects a scene can switch on; each states its term, operators, cost and when it matters."""

from __future__ import annotations

from softgrasp.fem.effects import catalog
from softgrasp.fem.effects.gate import Effect, Gate, Problem

__all__ = ["EFFECTS", "Effect", "Gate", "Problem"]

EFFECTS: dict[str, Effect] = {effect.name: effect for effect in catalog.ALL}
"""All effects by name, in the order in which they are reported."""
