"""Parameters to test and to train at: a box of lambda and mu around the constants of a scene, and its grid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.system import LayerMaterial

GRID = 3  # test values of each constant, from corner to corner of the box


LAMBDA_SHARES = (0.6, 10.0)  # of the scene's own constants: the paper's box around its 50, 50


MU_SHARES = (0.4, 10.0)


def box_of(model: Model) -> tuple[list[float], list[float]]:
    """Ranges of lambda and mu of the first layer [Pa]: the scene's, or shares of its own constants. Not collective."""
    ranges, first = model.scene.reduction, model.system.materials[0]
    lam, mu = ranges.lambda_range, ranges.mu_range
    return lam or [share * first.lam for share in LAMBDA_SHARES], mu or [share * first.mu for share in MU_SHARES]


def outside(model: Model) -> str:
    """Why the scene's own constants lie outside the box, so that errors there say nothing; empty when inside."""
    first, box = model.system.materials[0], box_of(model)
    for key, value, (low, high) in zip(("lambda", "mu"), (first.lam, first.mu), box, strict=True):
        if value <= 0:
            return f"{key} = {value:.4g} Pa of the scene is not positive, and the box is logarithmic"
        if not low <= value <= high:
            return (
                f"{key} = {value:.4g} Pa of the scene lies outside reduction.{key}_range = [{low:g}, {high:g}]; "
                "set that key to test other parameters"
            )
    return ""


def grid_of(model: Model) -> list[tuple[float, float]]:
    """Lame constants on a grid of the scene's box, logarithmically."""
    lam, mu = (np.geomspace(low, high, GRID).tolist() for low, high in box_of(model))
    return [(a, b) for a in lam for b in mu]


def training_of(model: Model) -> list[tuple[float, float]]:
    """Lame constants of the runs that train bases beside the scene's own."""
    train = model.scene.reduction.train
    if train == "corners":
        lam, mu = box_of(model)
        return [(a, b) for a in lam for b in mu]
    return [(a, b) for a, b in train]


def materials_at(model: Model, lam: float, mu: float) -> tuple[LayerMaterial, ...]:
    """Materials with these constants in the first layer; the others keep their ratios to it."""
    first = model.system.materials[0]
    return tuple(replace(m, lam=m.lam * lam / first.lam, mu=m.mu * mu / first.mu) for m in model.system.materials)


def box_materials(model: Model) -> list[tuple[LayerMaterial, ...]]:
    """Materials at every parameter of the grid."""
    return [materials_at(model, lam, mu) for lam, mu in grid_of(model)]
