"""Files that every result has: result.json and the resolved scene."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem import Scene, note, resolved_toml


def to_json(value: Any) -> Any:
    """A value that JSON can hold: what is not finite becomes None, a dataclass the table of its fields."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {str(k): to_json(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [to_json(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def write_scene(out: Path, scene: Scene) -> Path:
    """Write the resolved scene beside a result. Not collective: call on one rank."""
    path = out / "scene.toml"
    note(path)
    path.write_text(resolved_toml(scene))
    return path


def write_json(path: Path, result: dict[str, Any]) -> Path:
    """Write a result; what is not finite becomes null. Not collective: call on one rank."""
    note(path)
    path.write_text(json.dumps(to_json(result), indent=2, allow_nan=False) + "\n")
    return path
