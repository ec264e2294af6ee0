"""One parameter trains, others test: errors of reduced models over the box of lambda and mu."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fem.build import Model, Stopwatch
from fem.run import simulate
from fem.system import LayerMaterial
from reduction.errors import Comparison
from reduction.online import run
from study.reduce_reference import Reference, prepare, reference
from study.reduce_sweep import Point, Swept, nearest

GRID = 3  # test values of each constant, from corner to corner of the box


@dataclass(frozen=True)
class BoxPoint:
    """One test parameter: lambda, mu [Pa] and the deformation error of every method there."""

    lam: float
    mu: float
    errors: dict[str, float]


def best_models(swept: Sequence[Swept], count: int = 4) -> list[tuple[Swept, int]]:
    """The ``count`` methods with the least deformation error of a stable model at the N that is compared."""
    found = [(s, i) for s in swept if (i := nearest(s.points)) is not None]
    return sorted(found, key=lambda f: _deformation(f[0].points[f[1]]))[:count]


def _deformation(point: Point) -> float:
    return point.error_deformation if np.isfinite(point.error_deformation) else np.inf


def outside(model: Model) -> str:
    """Why the scene's own constants lie outside the box, so that errors there say nothing; empty when inside."""
    ranges, first = model.scene.reduction, model.system.materials[0]
    for key, value, (low, high) in (
        ("lambda", first.lam, ranges.lambda_range),
        ("mu", first.mu, ranges.mu_range),
    ):
        if not low <= value <= high:
            return (
                f"{key} = {value:.4g} Pa of the scene lies outside reduction.{key}_range = [{low:g}, {high:g}]; "
                "set that key to test other parameters"
            )
    return ""


def box_materials(model: Model) -> list[tuple[LayerMaterial, ...]]:
    """Lame constants on a grid of the scene's box, logarithmically; layers keep their ratios to the first."""
    ranges = model.scene.reduction
    lam, mu = (np.geomspace(r[0], r[1], GRID) for r in (ranges.lambda_range, ranges.mu_range))
    first = model.system.materials[0]
    return [
        tuple(replace(m, lam=m.lam * a / first.lam, mu=m.mu * b / first.mu) for m in model.system.materials)
        for a in lam
        for b in mu
    ]


def box_errors(
    against: Reference, chosen: Sequence[tuple[Swept, int]], progress: Callable[[int, int], None] | None = None
) -> list[BoxPoint]:
    """Full runs on the grid, and the chosen reduced models there without any new projection. Collective."""
    cases = box_materials(against.model)
    result = []
    for k, materials in enumerate(cases):
        if progress is not None:
            progress(k, len(cases))
        system = against.model.system.with_materials(materials)
        there = replace(against.model, system=system, watch=Stopwatch(system.layout.comm))
        here = reference(there, simulate(there))
        errors = {}
        for swept, i in chosen:
            model = swept.models[i]
            with np.errstate(all="ignore"):  # may be unstable away from the training parameter
                small = model.at(materials)
                step, drive = prepare(model, small, here, system)
                found = run(step, allow_unstable=True, **drive)
                comparison = Comparison(model, small, system, here.snapshots, here.energy)
                errors[swept.method.key] = comparison.state_error("deformation", model, small, found)
        result.append(BoxPoint(materials[0].lam, materials[0].mu, errors))
    return result


def summary(points: Sequence[BoxPoint], chosen: Sequence[tuple[Swept, int]]) -> list[dict[str, Any]]:
    """Median and largest error of every method over the box."""
    rows = []
    for swept, i in chosen:
        errors = [p.errors[swept.method.key] for p in points]
        rows.append(
            {
                "method": swept.method.key,
                "N": swept.points[i].N,
                "trained": swept.points[i].error_deformation,
                "median": statistics.median(errors),
                "largest": max(errors, key=lambda e: (not np.isfinite(e), e)),
            }
        )
    return rows
