"""What ``result.json`` of any reduction holds."""

from __future__ import annotations

from typing import Any

from softgrasp.reduction import FullRun
from softgrasp.study.forward.result import simulate_result
from softgrasp.study.report import to_json
from softgrasp.study.report.origin import peak_memory_mb

KEPT = ("scene", "scene_hash", "version", "ranks", "machine", "n_s", "n_e", "states", "cells", "steps", "dt", "solver")


def reduce_result(full: FullRun, own: dict[str, Any], seconds: dict[str, float]) -> dict[str, Any]:
    """``result.json`` of any reduction: scene and sizes of the full run, what is its own, times, memory. Collective."""
    model = full.model
    whole = simulate_result(model, full.trajectory).to_json()
    return dict(
        to_json(
            {"command": "reduce"}
            | {key: whole[key] for key in KEPT}
            | {"reduction": model.scene.reduction.model_dump(mode="json")}
            | own
            | {"time": seconds, "memory_peak_mb": peak_memory_mb(model.system.layout.comm)}
        )
    )
