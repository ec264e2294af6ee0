"""Is the truth within twice the stated errors? Random noise on data of a finer model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.scene.file import load_scene
from softgrasp.reduction.identify.data import Measurements

pytestmark = [pytest.mark.serial, pytest.mark.slow]
SEEDS, WITHIN = 100, 95
KEEP = "output.snapshots='none'"
# scene, keys of the fit, those of the data's finer model, truth over the start, noise [m], steps between two data
SCENES: dict[str, tuple[str, list[str], list[str], dict[str, float], float, int]] = {
    "2D": (
        "paper_forward",
        ["effects.damping={kind='kelvin-voigt', beta=0.002}", "time.end=6.0", "time.steps=1200", "tissue.order=2",
         "tissue.refine.tolerance=1e-2"],
        ["tissue.refine.tolerance=1e-3", "time.steps=2400"],
        {"mu": 1.6, "lambda": 1.2, "beta": 1.5}, 1e-3, 4,
    ),
}  # fmt: skip


def truth(scene: str, keys: list[str], share: dict[str, float]) -> tuple[Any, dict[str, float]]:
    """The scene with the true values, and these."""
    values: dict[str, float] = {}

    def edit(table: dict[str, Any]) -> None:
        for name, factor in share.items():
            layer, _, kind = name.rpartition(".")
            part = table["tissue"]["layers"][layer] if layer else table["tissue"]
            if kind == "beta":
                part = part if layer else table["effects"]["damping"]
            else:
                part = part["material"]
                part.pop("name", None)
            part[kind] = values[name] = factor * part[kind]

    return load_scene(scene, [*keys, KEEP]).changed(edit), values


@pytest.mark.parametrize("name", SCENES)
def test_the_truth_is_within_twice_the_errors(name: str) -> None:
    scene, keys, finer, share, noise, every = SCENES[name]
    true, values = truth(scene, [*keys, *finer], share)
    run, model = sg.simulate(sg.build(true)), sg.build(scene, [*keys, KEEP])
    y, times = run.outputs[::every], run.times[::every]
    far, refused = [], 0
    for seed in range(SEEDS):
        data = Measurements("markers", times, y + np.random.default_rng(seed).normal(0, noise, y.shape))
        found = sg.identify(model, data, list(share), noise)
        refused += bool(found.reasons)
        error = found.values / [values[u.name] for u in found.unknowns] - 1
        far.append(np.abs(error) / found.total)
    within = int((np.array(far) < 2).all(axis=1).sum())
    assert within >= WITHIN, f"{within} of {SEEDS} within, refused {refused}, median {np.median(far, axis=0)}"
    assert refused <= SEEDS // 20  # by the misfit, which chance leaves
