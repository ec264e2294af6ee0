"""Errors of reduced models over the box of lambda and mu, trained at the scene's own parameter or at several."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.snapshots import Snapshots
from softgrasp.reduction.errors import Comparison
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import run
from softgrasp.reduction.parameters import grid_of, materials_at, outside, training_of
from softgrasp.reduction.projection import project
from softgrasp.reduction.registry import Method
from softgrasp.reduction.replay import Reference, prepare, reference
from softgrasp.reduction.states import States
from softgrasp.study.reduce.sweep import COMPARED, LARGER, Point, Swept, bases_of, nearest
from softgrasp.study.report.files import plain

METHODS_TESTED = 4


@dataclass(frozen=True)
class Case:
    """One reduced model that is tested.

    Attributes:
        method: of its basis.
        N: its dimension.
        several: whether runs at several parameters trained it.
        model: itself.
    """

    method: Method
    N: int
    several: bool
    model: ReducedModel

    @property
    def family(self) -> tuple[str, bool]:
        """Cases of one family have nested bases."""
        return self.method.key, self.several


@dataclass(frozen=True)
class BoxPoint:
    """One parameter with the deformation error of every case there.

    Attributes:
        lam, mu: of the first layer [Pa].
        trained: a run at this parameter trained some of the bases, so that it is no test.
        errors: one for each case.
    """

    lam: float
    mu: float
    trained: bool
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Box:
    """All tests at other parameters.

    Attributes:
        cases: models.
        own: errors at the scene's own parameter.
        points: errors over the box.
        trained_at: [lambda, mu] of the runs that trained the cases with ``several``, the scene's own first [Pa].
        none: why there are no tests; empty when there are.
    """

    cases: tuple[Case, ...] = ()
    own: tuple[float, ...] = ()
    points: tuple[BoxPoint, ...] = ()
    trained_at: tuple[tuple[float, float], ...] = ()
    none: str = ""


def best_methods(swept: Sequence[Swept]) -> list[Swept]:
    """The methods with the least deformation error of a stable model at the N that is compared."""
    found = [(_deformation(s.points[i]), k, s) for k, s in enumerate(swept) if (i := nearest(s.points)) is not None]
    return [s for _, _, s in sorted(found)[:METHODS_TESTED]]


def _deformation(point: Point) -> float:
    return point.error_deformation if np.isfinite(point.error_deformation) else np.inf


def full_run(model: Model, lam: float, mu: float) -> Reference:
    """The full run at other constants. Collective."""
    system = model.system.with_materials(materials_at(model, lam, mu))
    there = replace(model, system=system, watch=Stopwatch(system.layout.comm))
    return reference(there, simulate(there))


def thinned(snapshots: Snapshots, count: int) -> Snapshots:
    """About ``count`` of the snapshots, evenly spread, first and last among them. Not collective."""
    m = snapshots.Z.shape[1]
    pick = np.unique(np.linspace(0, m - 1, min(count, m)).round().astype(int))
    return replace(
        snapshots,
        steps=snapshots.steps[pick],
        times=snapshots.times[pick],
        q_s=snapshots.q_s[:, pick],
        v_s=snapshots.v_s[:, pick],
        Z=np.asfortranarray(snapshots.Z[:, pick]),
    )


def training_states(against: Reference, parameters: Sequence[tuple[float, float]]) -> States:
    """Snapshots of the scene's own run and of runs at these, altogether as many as the own run has. Collective."""
    system, count = against.model.system, -(-against.snapshots.Z.shape[1] // (1 + len(parameters)))
    runs = [(system, thinned(against.snapshots, count))]
    for lam, mu in parameters:
        there = full_run(against.model, lam, mu)
        runs.append((there.model.system, thinned(there.snapshots, count)))
    return States(system, tuple(runs))


def cases_of(against: Reference, swept: Sequence[Swept], states: States | None) -> list[Case]:
    """Models of the best methods at two N: those of the sweep, and from ``states`` with the same N. Collective."""
    full, cases = against.model, []
    outputs = make_outputs(full.scene, full.system)
    for s in best_methods(swept):
        found = {nearest(s.points, N) for N in (COMPARED, LARGER)}
        points = [(s.points[i], s.models[i]) for i in sorted(i for i in found if i is not None)]
        cases += [Case(s.method, point.N, False, model) for point, model in points]
        if states is None or not s.method.snapshots:
            continue
        sizes = [point.N for point, _ in points]
        bases, _ = bases_of(s.method.key, states, sizes, full.scene.reduction, {})
        for basis, (point, _) in zip(bases, points, strict=False):
            cases.append(Case(s.method, point.N, True, project(basis, full.system, outputs)))
    return cases


def errors_at(here: Reference, cases: Sequence[Case]) -> tuple[float, ...]:
    """Deformation errors of all cases at the parameter of one full run, without any new projection. Collective."""
    system, errors = here.model.system, []
    largest: dict[tuple[str, bool], Case] = {}
    for case in sorted(cases, key=lambda c: c.model.N):
        largest[case.family] = case
    found = {
        family: Comparison(case.model, case.model.at(system.materials), system, here.snapshots, here.energy)
        for family, case in largest.items()
    }
    for case in cases:
        with np.errstate(all="ignore"):  # may be unstable away from the training parameter
            small = case.model.at(system.materials)
            step, drive = prepare(case.model, small, here, system)
            trajectory = run(step, allow_unstable=True, **drive)
            errors.append(found[case.family].state_error("deformation", case.model, small, trajectory))
    return tuple(errors)


def measure_box(against: Reference, swept: Sequence[Swept], progress: Callable[[int, int], None] | None = None) -> Box:
    """Train, and test over the box. Collective.

    Raises:
        SolverError: a full run failed, or a factorisation did.
        ResourceError: the snapshots do not fit.
    """
    model = against.model
    reason = outside(model) or ("" if best_methods(swept) else "no method has a stable model")
    if reason:
        return Box(none=reason)
    first, training, grid = model.system.materials[0], training_of(model), grid_of(model)
    states = training_states(against, training) if training else None
    cases = cases_of(against, swept, states)
    trained_at = ((first.lam, first.mu), *training)
    points = []
    for k, (lam, mu) in enumerate(grid):
        if progress is not None:
            progress(k, len(grid))
        trained = any(np.allclose((lam, mu), place) for place in trained_at)
        points.append(BoxPoint(lam, mu, trained, errors_at(full_run(model, lam, mu), cases)))
    return Box(tuple(cases), errors_at(against, cases), tuple(points), trained_at if training else ())


def summary(box: Box) -> list[dict[str, Any]]:
    """Error at the scene's own parameter, and median and largest over the parameters that trained no basis."""
    tests = [p for p in box.points if not p.trained] or box.points
    rows = []
    for i, case in enumerate(box.cases if tests else ()):
        errors = [p.errors[i] for p in tests]
        rows.append(
            {
                "method": case.method.key,
                "N": case.N,
                "runs": len(box.trained_at) if case.several else int(case.method.snapshots),
                "own": box.own[i],
                "median": statistics.median(errors),
                "largest": max(errors, key=lambda e: (not np.isfinite(e), e)),
            }
        )
    return rows


def box_result(box: Box) -> dict[str, Any]:
    """For result.json."""
    keys = [{"method": c.method.key, "N": c.N, "several": c.several} for c in box.cases]
    return {
        "reason_for_none": box.none,
        "trained_at": [list(place) for place in box.trained_at],
        "summary": plain(summary(box)),
        "points": [
            {
                "lambda": p.lam,
                "mu": p.mu,
                "trained": p.trained,
                "errors": [key | {"error_deformation": plain(e)} for key, e in zip(keys, p.errors, strict=True)],
            }
            for p in box.points
        ],
    }
