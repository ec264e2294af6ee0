"""What a scene in the frame of a turning hand may have."""

from __future__ import annotations

from typing import Any

from softgrasp.fem.scene.tissue import Tissue


def check_frame(effects: Any, tissue: Tissue) -> None:
    """Raises ValueError: effects or tissue have what ``effects.frame = "hand"`` cannot be combined with.

    Args:
        effects: the section :class:`softgrasp.fem.scene.scene.Effects` of the scene.
        tissue: its section of the tissue.
    """
    if not effects.rotation:
        raise ValueError("effects.frame is 'hand' but effects.rotation is off; set effects.rotation to true")
    if effects.obstacles:
        raise ValueError("effects.frame cannot go with effects.obstacles yet; set one of them to false")
    if effects.damping is not None and effects.damping.drag == "space" and effects.damping.alpha:
        raise ValueError("effects.damping.drag = 'space' cannot go with effects.frame yet; use drag = 'hand'")
    if tissue.refine is not None and tissue.refine.tolerance is not None:
        raise ValueError(
            "tissue.refine.tolerance cannot go with effects.frame, as its estimate leaves out large rotations; drop it"
        )
