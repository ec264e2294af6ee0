"""Meshes with fewer unknowns than a small model has columns: its basis is their whole space, its run the full one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.accuracy.adapt import estimated
from softgrasp.fem.accuracy.krylov import krylov_model
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from tests.helpers.models import CUBE, make_scene

WHOLE: dict[str, Any] = {"box": [[0.0, 0.0], [1.0, 2.0]]}
LEFT, BOTH, TOP = ({"contact": {**WHOLE, "sides": sides}} for sides in (["left"], ["left", "right"], ["top"]))


def tip(x: float, y: float, *more: float) -> dict[str, Any]:
    return {"control": {"outputs": [{"kind": "node", "point": [x, y, *more], "name": "tip"}]}}


TINY = {
    "1x1": [{"tissue": {"cells": [1, 1]}}, LEFT, tip(1.0, 0.0)],
    "1x1 held on top": [{"tissue": {"cells": [1, 1]}}, TOP, tip(1.0, 0.0)],
    "1x1 of order 2": [{"tissue": {"cells": [1, 1], "order": 2}}, BOTH, tip(0.5, 0.0)],
    "1x2": [{"tissue": {"cells": [1, 2]}}, LEFT, tip(1.0, 0.0)],
    "2x2 held on both sides": [{"tissue": {"cells": [2, 2]}}, BOTH, tip(0.5, 0.0)],
    "2x1 of one free node": [{"tissue": {"cells": [2, 1]}}, BOTH, tip(0.5, 0.0)],
    "1x1x1": [CUBE, {"tissue": {"cells": [1, 1, 1]}}, tip(1.0, 0.0, 0.0)],
}
EFFECTS: dict[str, Any] = {
    "undamped": {},
    "damped, pushed": {
        "effects": {"damping": {"kind": "rayleigh", "alpha": 0.2, "beta": 0.01}, "reaction": True},
        "motion": {"drive": "force"},
    },
}


@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
@pytest.mark.parametrize("changes", TINY.values(), ids=TINY)
def test_small_model_of_a_tiny_mesh_is_the_full_one(comm: MPI.Intracomm, changes: Any, effects: Any) -> None:
    model = build(make_scene(*changes, effects), comm=comm)
    small, run = krylov_model(model), simulate(model)
    assert small.V.shape[1] <= model.system.layout.n_e
    deformation = run.outputs - run.outputs_rigid
    scale = np.abs(deformation).max()
    assert scale > 0
    assert np.abs(small.run.deformation - deformation).max() <= 1e-10 * scale  # rounding of 60 steps, seen: 2e-13
    result = estimated(model)
    assert 0 < result.estimate <= result.bound
    assert np.isfinite([*result.omega, result.time_error]).all()
