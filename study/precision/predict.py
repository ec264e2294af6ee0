"""Error and time of settings that were not run, from the points of the forward diagram."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil, floor, isfinite, log10

from softgrasp.fem import STEP_RTOL, Scene
from softgrasp.study.precision.fit import interpolate, usable
from softgrasp.study.precision.forward import over_steps, step_counts
from softgrasp.study.precision.points import ForwardPoint, ReducedPoint, RiccatiPoint, RunPoint, WorkPoint
from softgrasp.study.precision.result import ErrorBudget, Source
from softgrasp.study.precision.settings import GOALS, POINT_WORK, Group, Setting, least_steps

LARGEST = {2: 300_000, 3: 60_000}  # unknowns of a setting that no run of the diagram tried
GROWTH = 8.0  # and its work over that of the largest point
SAFETY = 0.9  # of the tolerance that a predicted error may use
SURE = 0.1  # of an error, at least, is the mesh's
BETWEEN = 4  # tolerances of graded meshes a decade
BEYOND = 100.0  # below the smallest one of the diagram


@dataclass(frozen=True)
class Prediction:
    """What a setting is expected to give."""

    setting: Setting  # which
    n_e: float  # unknowns
    error: float  # relative error of the deformation
    seconds: float  # of a whole run
    point: ForwardPoint | None = None  # of the diagram, when the setting was run for it


class Predictor:
    """Error and time of any setting: error <= space(mesh) + time(steps).

    The change between s and S steps of order 2 is (1 - (s / S)^2) of the error with s, and the error with S is a
    quarter of that with S / 2. Graded meshes between and beyond those run follow them in their tolerance.
    """

    def __init__(self, scene: Scene, points: Sequence[ForwardPoint], d: int) -> None:
        self.scene, self.dimension = scene, d
        runs = [p for p in points if p.series != "solver"]
        self.runs: dict[Setting, ForwardPoint] = {}
        self.space: dict[Group, ForwardPoint] = {}  # the most steps on every mesh
        for p in runs:
            self.learn(p)
        changing = over_steps(runs)
        # the mesh with the most steps tried gives the error in time, the most accurate of those
        best = {name: -self.space[line[0].setting.group].error for name, line in changing.items()}
        name = max(changing, key=lambda name: (len(changing[name]), best[name]), default="")
        most = max((p.steps for p in runs if p.series == name), default=1)
        self.time = {p.steps: (p.error_time or 0.0) / (1 - (p.steps / most) ** 2) for p in changing.get(name, ())}

    def learn(self, point: ForwardPoint) -> None:
        """Take in a measured point."""
        self.runs[point.setting], group = point, point.setting.group
        if group not in self.space or self.space[group].steps <= point.steps:
            self.space[group] = point

    def graded(self, order: int) -> dict[float, ForwardPoint]:
        """The graded meshes of an order that were run, by tolerance."""
        return {p.refine: p for p in self.space.values() if p.order == order and isinstance(p.refine, float)}

    def time_error(self, steps: int) -> float:
        """Error through the time step; order 2 beyond the steps tried."""
        return interpolate(steps, list(self.time), list(self.time.values()), -2.0) if self.time else 0.0

    def space_of(self, point: ForwardPoint) -> float:
        """What the mesh of a point leaves, less its steps; the two may cancel in what was measured."""
        return max(point.error - self.time_error(point.steps), SURE * point.error)

    def space_error(self, setting: Setting) -> float:
        """Error through the mesh."""
        return self.predict(setting).error - self.time_error(setting.steps)

    def predict(self, setting: Setting) -> Prediction:
        """Error, unknowns and seconds of a setting on a mesh that was run, or on a graded one."""
        known, line = self.space.get(setting.group), self.graded(setting.order)

        def at(value: Callable[[ForwardPoint], float]) -> float:
            if known is not None:
                return value(known)
            return interpolate(float(setting.refine), list(line), [value(p) for p in line.values()])

        def cost(value: Callable[[ForwardPoint], float]) -> float:
            """No less beyond the finest mesh that was run, whatever noise its times have."""
            finer = known is None and float(setting.refine) < min(line)
            return max(at(value), value(line[min(line)])) if finer else at(value)

        error = at(self.space_of) + self.time_error(setting.steps)
        seconds = cost(lambda p: p.mesh + p.assembly + p.factor) + setting.steps * cost(lambda p: p.per_step)
        return Prediction(setting, cost(lambda p: p.n_e), error, seconds, self.runs.get(setting))

    def candidates(self) -> list[Prediction]:
        """Settings of the diagram, other steps on their meshes, and graded meshes of other tolerances."""
        base, least = self.scene.time.steps, least_steps(self.scene)
        meshes = [replace(p.setting, solver="auto") for p in self.space.values()]
        for order in GOALS[self.dimension]:
            line = sorted(self.graded(order))
            if len(line) > 1:
                decades = [10 ** (-k / BETWEEN) for k in range(2, 40)]
                goals = [float(f"{g:.2g}") for g in decades if line[0] / BEYOND <= g <= line[-1]]
                meshes += [Setting(None, order, 1, refine=g) for g in goals if g not in line]
        counts = sorted({max(least, round(base * 2 ** (k / 2))) for k in range(-10, 7)} | set(step_counts(base, least)))
        return [self.predict(replace(mesh, steps=n)) for mesh in meshes for n in counts]

    def affordable(self, prediction: Prediction) -> bool:
        """Whether a setting may be run to measure it."""
        d, n = self.dimension, prediction.n_e
        quick = n <= LARGEST[d] and n * prediction.setting.steps <= GROWTH * POINT_WORK[d]
        return prediction.point is not None or quick


ROUNDING = 1e-16  # digits end there


def with_shares(label: str, parts: Sequence[Source], missing: Sequence[tuple[str, str]] = ()) -> ErrorBudget:
    """Shares and wasted digits of parts whose errors are known."""
    whole, largest = (max(f(p.error for p in parts), ROUNDING) for f in (sum, max))
    done = [
        replace(p, share=p.error / whole, wasted=max(floor(log10(largest / max(p.error, ROUNDING))) - 1, 0))
        for p in parts
    ]
    return ErrorBudget(label, tuple(sorted(done, key=lambda p: -p.error)), tuple(missing))


def error_budget(
    predictor: Predictor, setting: Setting, points: Sequence[WorkPoint], skipped: dict[str, str]
) -> ErrorBudget:
    """Parts of a setting of the full model that was run, and of the reduced model and the feedback that go with it.

    The points are those of all questions; skipped are questions without points, with the reason.
    """
    forward = [p for p in points if isinstance(p, ForwardPoint)]
    reduced = [p for p in points if isinstance(p, ReducedPoint)]
    riccati = [p for p in points if isinstance(p, RiccatiPoint)]
    scene, now, steps = predictor.scene, predictor.predict(setting), ceil(setting.steps * 2**0.5)
    space, time = predictor.space_error(setting), predictor.time_error(setting.steps)
    other = [replace(p.setting, steps=setting.steps, solver="auto") for p in predictor.candidates()]
    finer = [p for p in map(predictor.predict, dict.fromkeys(other)) if p.error - time <= space / 2]
    mesh = min(finer, key=lambda p: p.seconds, default=None)
    parts = [
        Source("the mesh", space, halved_by=mesh.setting.mesh if mesh else "",
             cost=mesh.seconds / now.seconds if mesh else None),
        Source("the time step", time, halved_by=f"{steps} steps",
             cost=predictor.predict(replace(setting, steps=steps)).seconds / now.seconds),
        *_halved("the reduced model", companion(now.error, reduced), reduced, lambda p: p.error_outputs_full),
        *_solver(scene, forward),
        *_halved("the Riccati equation", _tight(scene, riccati), riccati, lambda p: p.error),
    ]  # fmt: skip
    names = {"reduced": "the reduced model", "riccati": "the Riccati equation"}
    there = {p.name for p in parts}
    missing = [(name, skipped.get(key, "not asked for")) for key, name in names.items() if name not in there]
    return with_shares(setting.label, parts, missing)


def _halved[P: WorkPoint](name: str, point: P | None, others: Sequence[P], error: Callable[[P], float]) -> list[Source]:
    """A part that a point of a question gives, with the fastest one of half its error."""
    if point is None or not isfinite(error(point)):
        return []
    better = min((p for p in usable(others) if error(p) <= error(point) / 2), key=lambda p: p.seconds, default=None)
    if better is None:
        return [Source(name, error(point))]
    by = better.label.removesuffix(f", {better.setting.label}") if isinstance(better, RunPoint) else better.label
    return [Source(name, error(point), halved_by=by, cost=better.seconds / point.seconds)]


def _solver(scene: Scene, forward: Sequence[ForwardPoint]) -> list[Source]:
    """How far the scene's solver is from another one on the same mesh and steps."""
    iterative, rtol = scene.time.solver == "cg", scene.time.rtol or STEP_RTOL["cg"]
    own = [p for p in forward if p.error_solver is not None and (p.solver == "cg") == iterative]
    if iterative:
        own = sorted(own, key=lambda p: abs(log10((p.rtol or rtol) / rtol)))[:1]
    by = "a smaller time.rtol" if iterative else ""
    return [Source("the linear solver", max(p.error_solver or 0.0 for p in own), halved_by=by)] if own else []


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
