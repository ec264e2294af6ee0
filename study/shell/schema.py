"""The JSON schema of a scene with the names that belong to reduction: what ``softgrasp schema`` prints."""

from __future__ import annotations

from typing import Any

from softgrasp.fem.scene.control import BASES
from softgrasp.fem.scene.scene import scene_schema


def full_schema() -> dict[str, Any]:
    """JSON schema of a scene file, draft 2020-12."""
    schema = scene_schema()
    schema["$defs"]["Reduction"]["properties"]["methods"]["items"]["enum"] = list(BASES)
    return schema
