"""Errors of reduced models over the box of lambda and mu, trained at the scene's own parameter or at several."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence

import numpy as np

from softgrasp.fem.model.outputs import make_outputs
from softgrasp.reduction.bases.states import States
from softgrasp.reduction.parameters import box_of, grid_of, outside, run_at, training_of, training_states
from softgrasp.reduction.projection import project
from softgrasp.reduction.replay import FullRun, comparison_of, replay_linear
from softgrasp.study.reduce.result import (
    COMPARED,
    LARGER,
    BoxErrors,
    BoxPoint,
    BoxTests,
    MethodSweep,
    TestedModel,
    nearest,
)
from softgrasp.study.reduce.sweep import bases_of

METHODS_TESTED = 4


def best_methods(sweeps: Sequence[MethodSweep]) -> list[MethodSweep]:
    """The methods with the least deformation error of a stable model at the N that is compared."""

    def error(s: MethodSweep, i: int) -> float:
        value = s.points[i].error_deformation
        return value if np.isfinite(value) else np.inf

    order = [(error(s, i), k, s) for k, s in enumerate(sweeps) if (i := nearest(s.points)) is not None]
    return [s for _, _, s in sorted(order)[:METHODS_TESTED]]


def box_models(full: FullRun, sweeps: Sequence[MethodSweep], states: States | None) -> list[TestedModel]:
    """Models of the best methods at two N: those of the sweep, and from ``states`` with the same N. Collective."""
    scene, system, models = full.model.scene, full.model.system, []
    outputs = make_outputs(scene, system)
    for s in best_methods(sweeps):
        numbers = {nearest(s.points, N) for N in (COMPARED, LARGER)}
        own = [s.models[i] for i in sorted(i for i in numbers if i is not None)]
        models += [TestedModel(s.method, False, model) for model in own]
        if states is None or not s.method.snapshots:
            continue
        bases, _ = bases_of(s.method.key, states, [model.N for model in own], scene.reduction, {})
        models += [TestedModel(s.method, True, project(b, system, outputs)) for b, _ in zip(bases, own, strict=False)]
    return models


def errors_at(full: FullRun, models: Sequence[TestedModel]) -> tuple[float, ...]:
    """Deformation errors of all models at the parameter of one full run, without any new projection. Collective."""
    largest = {m.family: m.model for m in sorted(models, key=lambda m: m.model.N)}
    comparisons = {family: comparison_of(model, full) for family, model in largest.items()}
    errors = []
    for m in models:
        with np.errstate(all="ignore"):  # may be unstable away from the training parameter
            reduced = replay_linear(m.model, full.model, full, allow_unstable=True)
            small = m.model.at(full.model.system.materials)
            errors.append(comparisons[m.family].state_error("deformation", m.model, small, reduced))
    return tuple(errors)


def measure_box(
    full: FullRun, sweeps: Sequence[MethodSweep], progress: Callable[[int, int], None] | None = None
) -> BoxTests:
    """Train, and test over the box. Collective.

    Raises:
        SolverError: a full run failed, or a factorisation did.
        ResourceError: the snapshots do not fit.
    """
    scene = full.model
    reason = outside(scene) or ("" if best_methods(sweeps) else "no method has a stable model")
    if reason:
        return BoxTests(none=reason)
    first, training, grid = scene.system.materials[0], training_of(scene), grid_of(scene)
    models = box_models(full, sweeps, training_states(full, training) if training else None)
    trained_at = ((first.lam, first.mu), *training)
    points = []
    for k, (lam, mu) in enumerate(grid):
        if progress is not None:
            progress(k, len(grid))
        trained = any(np.allclose((lam, mu), place) for place in trained_at)
        points.append(BoxPoint(lam, mu, trained, errors_at(run_at(scene, lam, mu), models)))
    return BoxTests(
        models=tuple(models),
        points=tuple(points),
        summary=summary(models, errors_at(full, models), points, len(trained_at)),
        trained_at=trained_at if training else (),
        ranges=box_of(scene),
    )


def summary(
    models: Sequence[TestedModel], own: Sequence[float], points: Sequence[BoxPoint], runs: int
) -> tuple[BoxErrors, ...]:
    """Error at the scene's own parameter, and median and largest over the parameters that trained no basis."""
    tests = [p for p in points if not p.trained] or points
    rows = []
    for i, m in enumerate(models if tests else ()):
        errors = [p.errors[i] for p in tests]
        rows.append(
            BoxErrors(
                method=m.method.key,
                N=m.model.N,
                runs=runs if m.several else int(m.method.snapshots),
                own=own[i],
                median=statistics.median(errors),
                largest=max(errors, key=lambda e: (not np.isfinite(e), e)),
            )
        )
    return tuple(rows)
