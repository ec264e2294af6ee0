"""What a reduced model was built from, key by key of its scene, and which key of another scene is not so.

A reduced model is affine in the materials of its scene, and any motion and time may drive it; all else is in its
matrices: gravity, drag, contact, mesh, order, law, outputs, hand.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Mapping
from typing import Any

from softgrasp.fem.errors import SoftgraspWarning, shortened
from softgrasp.reduction.system import ModelError

Origin = Mapping[str, Any]
"""Value of every key that decides on a run, a file by its hash; nothing that is switched off or at rest."""

# of no effect on a run beyond the tolerance of its solver
FREE = re.compile(
    r"(name|description|reduction|study|output)\b|control\.(?!outputs)|time\.(solver|rtol|reproducible)"
    r"|effects\.finite_strain\.tol|tissue\.read_limit"
)
MATERIAL = re.compile(r"tissue\.(layers\.[^.]+\.)?material\b|tissue\.layers\.[^.]+\.beta|effects\.damping\.(kind|beta)")
MOTION = re.compile(r"(motion|time)\b")
BEFORE, AFTER = 20, 30  # letters before and after the first that differs between two long values
UNKNOWN = (
    "does not name its scene (it is of an earlier version), so its gravity, contact, mesh and outputs are "
    "not compared with those of the scene; reduce the scene again"
)
"""Warning about a model without origin."""


def origin_of(keys: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the keys of a scene (:attr:`softgrasp.fem.model.build.Model.scene_keys`) that decide on a run."""
    keys = {key: value for key, value in keys.items() if not FREE.match(key)}
    if not any(keys.get("effects.gravity.g", ())):
        keys = {key: value for key, value in keys.items() if not key.startswith("effects.gravity.")}
    if not keys.get("effects.damping.alpha"):
        keys.pop("effects.damping.drag", None)
    keys.setdefault("time.end", keys["motion.duration"])
    # false, 0 and [] mean that an effect is switched off, or that there is none
    return {key: value for key, value in keys.items() if value not in (False, 0, [])}


def differing(own: Origin, other: Origin, free: tuple[re.Pattern[str], ...]) -> str:
    """The first key, but for ``free`` ones, that differs between two origins, with both values; empty if none does."""
    for key in [*own, *(key for key in other if key not in own)]:
        if own.get(key) != other.get(key) and not any(pattern.match(key) for pattern in free):
            texts = [_text(key, where[key]) if key in where else "" for where in (own, other)]
            same = next((i for i, (a, b) in enumerate(zip(*texts, strict=False)) if a != b), 0)
            if same > BEFORE and max(map(len, texts)) > BEFORE + AFTER:  # what differs must be within the quoted part
                texts = [f"...{text[same - BEFORE :]}" for text in texts]
            mine, its = map(shortened, texts)
            return f"{f'with {key} = {mine}' if mine else f'without {key}'}, and the scene has {its or 'none'}"
    return ""


def _text(key: str, value: Any) -> str:
    if key in ("tissue.mesh", "motion.csv"):
        return f"the file of hash {value[:12]}"
    return json.dumps(value)


def check_origin(
    origin: Origin, keys: Mapping[str, Any], name: str, free: tuple[re.Pattern[str], ...] = (MATERIAL, MOTION)
) -> None:
    """Refuse a scene, by its keys, that differs from that of a model in more than what is ``free``.

    Raises ModelError: with the first key that differs.
    """
    if not origin:
        warnings.warn(f"{name}: the model {UNKNOWN}", SoftgraspWarning, stacklevel=3)
    elif difference := differing(origin, origin_of(keys), free):
        accepted = ("materials, " if MATERIAL in free else "") + "motions and times"
        raise ModelError(
            f"the model was built {difference}; it accepts other {accepted} only, so reduce that scene itself", name,
        )  # fmt: skip
