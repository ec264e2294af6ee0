"""What the names of outputs say: which components are displacements of one point, which are rotations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from softgrasp.fem.model.outputs import hand_axes

Array = npt.NDArray[np.float64]

AXES, TURNS = hand_axes(3, 3), hand_axes(6, 3)[3:]


def turns(names: Sequence[str]) -> list[int]:
    """Numbers of the outputs that are rotations [rad]."""
    return [i for i, name in enumerate(names) if _split(name)[1] in TURNS]


def farthest(outputs: Array, target: Array, names: Sequence[str]) -> Array:
    """Distance of the farthest output from its target [m], (m,); rotations count only where there is nothing else.

    Args:
        outputs: (m, p).
        target: (p,).
        names: one per column, stem and axis joined by an underscore; others are taken as one vector.
    """
    angles = set(turns(names))
    groups: dict[str, list[int]] = {}
    for i in range(outputs.shape[1]):
        if i in angles and len(angles) < outputs.shape[1]:
            continue
        stem, axis = _split(names[i]) if i < len(names) else ("", "")
        groups.setdefault(stem if axis in AXES else "", []).append(i)
    error = outputs - target
    return np.asarray(np.max([np.linalg.norm(error[:, group], axis=1) for group in groups.values()], axis=0))


def _split(name: str) -> tuple[str, str]:
    stem, _, axis = name.rpartition("_")
    return stem, axis
