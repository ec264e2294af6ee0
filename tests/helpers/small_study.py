"""The scene of which tests study accuracy against time."""

from __future__ import annotations

from typing import Any

SMALL: dict[str, Any] = {
    "name": "small",
    "tissue": {"cells": [4, 8]},
    "time": {"steps": 64},
    "motion": {"target": [1.0, 0.5], "duration": 3.0},
    "control": {"outputs": [{"kind": "node", "point": [0.5, 0.0], "name": "tip"}]},
    "reduction": {"methods": ["psd_svd_like_fixed", "craig_bampton"], "N": [8, 12]},
    "study": {"repeats": 1},
}
