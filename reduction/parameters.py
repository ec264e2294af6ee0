"""Parameters of a scene: the box of its Lamé constants, tests and training runs in it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from softgrasp.fem.material import LayerMaterial, scaled
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.shown import digits
from softgrasp.reduction.bases.states import States
from softgrasp.reduction.replay import FullRun, full_run

GRID = 3  # test values of each constant, from corner to corner of the box
LAMBDA_SHARES = (0.6, 10.0)  # of the scene's own constant: the paper's box around its 50, 50
MU_SHARES = (0.4, 10.0)
STRAIN_SHARES = (0.8, 2.4)  # of both at finite strain, where a softer body folds and its runs fail


def box_of(model: Model) -> tuple[list[float], list[float]]:
    """Ranges of lambda and mu of the first layer [Pa]: the scene's, or shares of its own constants."""
    ranges, first = model.scene.reduction, model.system.materials[0]
    linear = model.system.points is None
    lam, mu = (LAMBDA_SHARES, MU_SHARES) if linear else (STRAIN_SHARES, STRAIN_SHARES)
    return (
        ranges.lambda_range or [share * first.lam for share in lam],
        ranges.mu_range or [share * first.mu for share in mu],
    )


def outside(model: Model) -> str:
    """Why the scene's own constants lie outside the box, so that errors there are not its own; empty when inside."""
    first, box = model.system.materials[0], box_of(model)
    for key, _ in first.fixed:
        if key in ("lam", "mu"):
            return f"the tangent of the energy is not affine in {key}"
    for key, value, (low, high) in zip(("lambda", "mu"), (first.lam, first.mu), box, strict=True):
        if value <= 0:
            return f"{key} = {digits(value)} Pa of the scene is not positive, and the box is logarithmic"
        if not low <= value <= high:
            return (
                f"{key} = {digits(value)} Pa of the scene lies outside reduction.{key}_range = [{low:g}, {high:g}]; "
                "set that key to test other parameters"
            )
    return ""


def grid_of(model: Model) -> list[tuple[float, float]]:
    """Lamé constants on a grid of the scene's box, logarithmically."""
    lam, mu = (np.geomspace(low, high, GRID).tolist() for low, high in box_of(model))
    return [(a, b) for a in lam for b in mu]


def training_of(model: Model) -> list[tuple[float, float]]:
    """Lamé constants of the runs that train bases beside the scene's own."""
    train = model.scene.reduction.train
    if isinstance(train, str):
        lam, mu = box_of(model)
        return [(a, b) for a in lam for b in mu]
    return [(a, b) for a, b in train]


def mirrored(model: Model) -> list[list[float]]:
    """Targets of the runs that train models at finite strain beside the scene's own."""
    chosen, target = model.scene.reduction.motions, model.scene.motion.target or []
    if chosen == "own" or not isinstance(chosen, str):
        return [] if chosen == "own" else [list(each) for each in chosen]
    signs = product(*((1.0, -1.0) if x else (1.0,) for x in target))
    return [[s * x for s, x in zip(each, target, strict=True)] for each in signs][1:]


def moved_to(model: Model, target: list[float]) -> Model:
    """The scene with another target of its hand."""
    motion = model.scene.motion.model_copy(update={"target": target})
    return replace(model, scene=model.scene.model_copy(update={"motion": motion}))


def materials_at(model: Model, lam: float, mu: float) -> tuple[LayerMaterial, ...]:
    """Materials with these constants in the first layer; the others keep their ratios to it."""
    first = model.system.materials[0]
    return scaled(model.system.materials, lam / first.lam, mu / first.mu)


def run_at(model: Model, lam: float, mu: float) -> FullRun:
    """The full run at other constants. Collective."""
    return run_with(model, materials_at(model, lam, mu))


def run_with(model: Model, materials: tuple[LayerMaterial, ...]) -> FullRun:
    """The full run at other materials. Collective."""
    system = model.system.with_materials(materials)
    other = replace(model, system=system, watch=Stopwatch(system.layout.comm))
    return full_run(other, simulate(other))


def thinned(snapshots: Snapshots, count: int) -> Snapshots:
    """About ``count`` of the snapshots, evenly spread, first and last among them."""
    m = snapshots.Z.shape[1]
    return snapshots.columns(np.unique(np.linspace(0, m - 1, min(count, m)).round().astype(int)))


Each = Callable[[Sequence[Callable[[], Snapshots]]], list[Snapshots]]
"""Makes several calls."""


def in_order(calls: Sequence[Callable[[], Snapshots]]) -> list[Snapshots]:
    """Results of the calls, one after the other."""
    return [call() for call in calls]


def training_states(
    own: FullRun,
    parameters: Sequence[tuple[float, float]],
    each: Each = in_order,
) -> States:
    """Snapshots of the scene's own run and of runs at these, altogether as many as the own run has. Collective.

    ``each``: makes the runs; ranks with the whole model each may divide them.
    """
    system, count = own.model.system, -(-own.snapshots.Z.shape[1] // (1 + len(parameters)))

    def made(lam: float, mu: float) -> Snapshots:
        return thinned(run_at(own.model, lam, mu).snapshots, count)

    others = each([partial(made, *place) for place in parameters])
    systems = [system.with_materials(materials_at(own.model, *place)) for place in parameters]
    return States(system, ((system, thinned(own.snapshots, count)), *zip(systems, others, strict=True)))
