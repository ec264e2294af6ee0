"""Tables of effects: each alone, all off, and such that change nothing."""

from __future__ import annotations

from typing import Any

GRAVITY = {"gravity": {"g": [1.0, -9.0]}}
WEIGHT = {"gravity": {"g": [1.0, -9.0], "hand_weight": True}}
VISCOUS = {"damping": {"kind": "kelvin-voigt", "beta": 0.01}}
RAYLEIGH = {"damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01}}
OFF: dict[str, Any] = {"gravity": False, "damping": False, "reaction": False, "rotation": False}
NEUTRAL: list[dict[str, Any]] = [
    OFF,
    {"gravity": {"g": [0.0, 0.0]}},
    {"damping": {"kind": "rayleigh", "alpha": 0.0, "beta": 0.0}},
    {"damping": {"kind": "rayleigh", "alpha": 0.0, "beta": 0.0, "drag": "space"}},
]
