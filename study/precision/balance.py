"""The error budget of a run: mesh, time step, reduction, solver and Riccati equation beside each other.

Each part is what it alone leaves of the outputs, relative to the largest deformation; of the Riccati equation it is the
relative error of the gain, by about which a closed loop moves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil, floor, isfinite, log10

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.fit import usable
from softgrasp.study.precision.points import ForwardPoint, ReducedPoint, RiccatiPoint, RunPoint, WorkPoint
from softgrasp.study.precision.predict import Predictor
from softgrasp.study.precision.result import ErrorBudget, Part
from softgrasp.study.precision.settings import Setting

ROUNDING = 1e-16  # digits end there


def balanced(label: str, parts: Sequence[Part], missing: Sequence[tuple[str, str]] = ()) -> ErrorBudget:
    """Shares and wasted digits of parts whose errors are known."""
    whole, largest = (max(f(p.error for p in parts), ROUNDING) for f in (sum, max))
    done = [
        replace(p, share=p.error / whole, wasted=max(floor(log10(largest / max(p.error, ROUNDING))) - 1, 0))
        for p in parts
    ]
    return ErrorBudget(label, tuple(sorted(done, key=lambda p: -p.error)), tuple(missing))


def error_budget(
    scene: Scene,
    predictor: Predictor,
    setting: Setting,
    forward: Sequence[ForwardPoint],
    model: ReducedPoint | None,
    reduced: Sequence[ReducedPoint],
    riccati: Sequence[RiccatiPoint],
    skipped: dict[str, str],
) -> ErrorBudget:
    """Parts of a setting of the full model, and of a reduced model and the feedback that go with it.

    Args:
        scene: the study's scene.
        predictor: of errors and times.
        setting: of the full model, run.
        forward: points of the diagram, for the solvers.
        model: reduced model that goes with it, or None.
        reduced: the models it is chosen from.
        riccati: points of the Riccati equation.
        skipped: questions without points, with the reason.
    """
    now, steps = predictor.predict(setting), ceil(setting.steps * 2**0.5)
    space, time = predictor.space_error(setting), predictor.time_error(setting.steps)
    other = [replace(p.setting, steps=setting.steps, solver="auto") for p in predictor.candidates()]
    finer = [p for p in map(predictor.predict, dict.fromkeys(other)) if p.error - time <= space / 2]
    mesh = min(finer, key=lambda p: p.seconds, default=None)
    parts = [
        Part("the mesh", space, halved_by=mesh.setting.mesh if mesh else "",
             cost=mesh.seconds / now.seconds if mesh else None),
        Part("the time step", time, halved_by=f"{steps} steps",
             cost=predictor.predict(replace(setting, steps=steps)).seconds / now.seconds),
        *_halved("the reduced model", model, reduced, lambda p: p.error_outputs_full),
        *_solver(scene, forward),
        *_halved("the Riccati equation", _tight(scene, riccati), riccati, lambda p: p.error),
    ]  # fmt: skip
    names = {"reduced": "the reduced model", "riccati": "the Riccati equation"}
    there = {p.name for p in parts}
    missing = [(name, skipped.get(key, "not asked for")) for key, name in names.items() if name not in there]
    return balanced(setting.label, parts, missing)


def _halved[P: WorkPoint](name: str, point: P | None, others: Sequence[P], error: Callable[[P], float]) -> list[Part]:
    """A part that a point of a question tells, with the fastest one of half its error."""
    if point is None or not isfinite(error(point)):
        return []
    better = min((p for p in usable(others) if error(p) <= error(point) / 2), key=lambda p: p.seconds, default=None)
    if better is None:
        return [Part(name, error(point))]
    by = better.label.removesuffix(f", {better.setting.label}") if isinstance(better, RunPoint) else better.label
    return [Part(name, error(point), halved_by=by, cost=better.seconds / point.seconds)]


def _solver(scene: Scene, forward: Sequence[ForwardPoint]) -> list[Part]:
    """How far the scene's solver is from another one on the same mesh and steps."""
    iterative, rtol = scene.time.solver == "cg", scene.time.rtol
    own = [p for p in forward if p.error_solver is not None and (p.solver == "cg") == iterative]
    if iterative:
        own = sorted(own, key=lambda p: abs(log10((p.rtol or rtol) / rtol)))[:1]
    by = "a smaller time.rtol" if iterative else ""
    return [Part("the linear solver", max(p.error_solver or 0.0 for p in own), halved_by=by)] if own else []


def _tight(scene: Scene, points: Sequence[RiccatiPoint]) -> RiccatiPoint | None:
    """The point nearest to how the scene solves its Riccati equation."""
    section = scene.control
    good = usable(points)
    if section is None or not good:
        return None
    same = (
        [p for p in good if p.method == section.method.replace("-", "_")]
        or [p for p in good if p.method == "newton_adi"]
        or good
    )
    return min(same, key=lambda p: abs(log10(p.tolerance / section.tolerance)))


def companion(space: float, reduced: Sequence[ReducedPoint]) -> ReducedPoint | None:
    """The fastest reduced model that adds less than a tenth of what mesh and steps leave, else the most accurate."""
    good = usable(reduced)
    fit = [p for p in good if p.error_outputs_full <= space / 10]
    if fit:
        return min(fit, key=lambda p: p.seconds)
    return min(good, key=lambda p: p.error_outputs_full, default=None)
