"""The forward question: mesh, order, time step and solver against the error of the outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.fit import Slope, interpolate, series_of, slope
from softgrasp.study.precision.full import FullRuns
from softgrasp.study.precision.meshes import halved_meshes, nested_meshes, smallest_mesh
from softgrasp.study.precision.points import ForwardPoint
from softgrasp.study.precision.result import Question, Truth
from softgrasp.study.precision.series import TimedRun, errors_of
from softgrasp.study.precision.settings import LEAST_STEPS, Group, Setting, least_steps, scene_setting

SHARES = (2.0, 1.0, 0.5, 0.25, 0.125)  # of the scene's steps
CG_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
POINT_WORK = {2: 8e6, 3: 6e5}  # unknowns times steps of a point of the diagram
LARGEST = {2: 300_000, 3: 60_000}  # unknowns of a setting that no run of the diagram tried
GROWTH = 8.0  # and its work over that of the largest point
MESHES = 5  # of each order, besides the scene's own
FINEST = 3  # numbers of steps behind a slope in time: coarser ones may not resolve the motion
CLEAR = 2.0  # times the error of the reference, from which on an error has an order
SAFETY = 0.9  # of the tolerance that a predicted error may use


@dataclass(frozen=True)
class Prediction:
    """What a setting is expected to give.

    Attributes:
        setting: which.
        error: relative error of the deformation.
        seconds: of a whole run.
        point: of the diagram, when the setting was run for it.
    """

    setting: Setting
    error: float
    seconds: float
    point: ForwardPoint | None


def step_counts(steps: int, least: int = LEAST_STEPS) -> list[int]:
    """Numbers of steps to try, most first."""
    return sorted({max(least, round(steps * share)) for share in SHARES}, reverse=True)


def forward_settings(scene: Scene, d: int) -> list[Setting]:
    """Settings of the diagram, the most steps of each mesh first; then solvers at the scene's own."""
    own = scene_setting(scene)
    groups: list[Group] = [(own.cells, own.order)]
    groups += [(cells, order) for order in (1, 2) for cells in (halved_meshes(scene, MESHES) or (None,))]
    settings = []
    for cells, order in dict.fromkeys(groups):
        for steps in step_counts(scene.time.steps, least_steps(scene)):
            setting = Setting(cells, order, steps)
            quick = setting.unknowns(d) * steps <= POINT_WORK[d] or steps <= scene.time.steps / 4
            if quick or (cells, order) == groups[0]:
                settings.append(setting)
    base = replace(own, solver="auto")
    solvers = [replace(base, solver=name) for name in ("cholesky", "mumps")]
    return settings + solvers + [replace(base, solver="cg", rtol=rtol) for rtol in CG_TOLERANCES]


def to_point(setting: Setting, run: TimedRun, truth: Truth, finest: TimedRun | None = None) -> ForwardPoint:
    """A run as a point of the diagram; its error may be anything in ``error_range``.

    Args:
        setting: of the run.
        run: measured.
        truth: what its outputs are compared with.
        finest: the run with the most steps on the same mesh, when this is not it.
    """
    error, displacement = errors_of(run.series, truth.series)
    names = ("n_e", "states", "steps", "dt", "mesh", "assembly", "factor", "per_step", "p50", "p99", "max")
    return ForwardPoint(
        setting.mesh if setting.solver == "auto" else "solver", setting.label, run.seconds, error, cells=setting.cells,
        order=setting.order, solver=setting.solver, rtol=setting.rtol if setting.solver == "cg" else None,
        error_deformation=error, error_displacement=displacement, error_range=truth.range_of(error),
        error_time=None if finest is None else errors_of(run.series, finest.series)[0],
        **{name: getattr(run, name) for name in names},
    )  # fmt: skip


def ask_forward(scene: Scene, runs: FullRuns, truth: Truth) -> Question:
    """Run all settings of the diagram. Collective."""
    points: list[ForwardPoint] = []
    finest: dict[Group, TimedRun] = {}
    for setting in forward_settings(scene, truth.series.dimension):
        run = runs.run(setting)
        best = run if setting.solver != "auto" else finest.setdefault(setting.group, run)
        points.append(to_point(setting, run, truth, None if best is run else best))
    return Question(tuple(points), tuple(forward_slopes(points, truth.error)), truth)


def on_meshes(points: Sequence[ForwardPoint], order: int) -> list[ForwardPoint]:
    """Points with the most steps on each structured mesh of an element order, coarse to fine."""
    fine = [p for p in points if p.series != "solver" and p.order == order and p.cells and p.error_time is None]
    return sorted(fine, key=lambda p: p.n_e)


def over_steps(points: Sequence[ForwardPoint]) -> dict[str, list[ForwardPoint]]:
    """Points with a change in time on each mesh, few steps to many."""
    timed = [p for p in points if p.series != "solver" and p.error_time]
    return {name: sorted(line, key=lambda p: p.steps) for name, line in series_of(timed).items()}


def forward_slopes(points: Sequence[ForwardPoint], truth_error: float) -> list[Slope]:
    """Orders: of the error in the cells (most steps), of the change in the steps, of time in the unknowns.

    Errors nearer than :data:`CLEAR` times that of the reference tell no order.
    """
    slopes: list[Slope] = []
    for order in (1, 2):
        line = [p for p in on_meshes(points, order) if p.error > CLEAR * truth_error]
        name, errors = f"P{order}", [p.error for p in line]
        slopes += slope(
            "forward", name, "error against cells along an edge", [(p.cells or (0,))[0] for p in line], errors
        )
        slopes += slope("forward", name, "error against seconds", [p.seconds for p in line], errors)
    for name, line in over_steps(points).items():
        last = line[-FINEST:]
        changes = [p.error_time or 0.0 for p in last]
        slopes += slope("forward", name, "change in time against steps", [p.steps for p in last], changes)
    runs = [p for p in points if p.series != "solver"]
    sizes, per_step = [p.n_e for p in runs], [p.per_step for p in runs]
    return slopes + slope("forward", "all", "seconds of a step against unknowns", sizes, per_step)


class Predictor:
    """Error and time of any setting from the points of the diagram: error <= space(mesh) + time(steps).

    The change between s and S steps of order 2 is (1 - (s / S)^2) of the error with s, and the error with S is a
    quarter of that with S / 2.

    Args:
        scene: the study's scene.
        points: of the forward diagram.
    """

    def __init__(self, scene: Scene, points: Sequence[ForwardPoint]) -> None:
        self.scene = scene
        runs = [p for p in points if p.series != "solver"]
        self.runs: dict[Setting, ForwardPoint] = {}
        self.space: dict[Group, ForwardPoint] = {}  # the most steps on every mesh
        for p in runs:
            self.learn(p)
        changing = over_steps(runs)
        # the mesh with the most steps tried tells about time, the finest of those
        name = max(changing, key=lambda n: (len(changing[n]), n), default="")
        most = max((p.steps for p in runs if p.series == name), default=1)
        self.time = {p.steps: (p.error_time or 0.0) / (1 - (p.steps / most) ** 2) for p in changing.get(name, ())}

    def learn(self, point: ForwardPoint) -> None:
        """Take in a measured point."""
        self.runs[point.setting] = point
        group = point.setting.group
        if group not in self.space or self.space[group].steps <= point.steps:
            self.space[group] = point

    def space_error(self, group: Group) -> float:
        """Error of a mesh at its most steps; of others by the slope of their element order.

        Where a mesh ran with few steps only, which is an error of time too, the lower of the two.
        """
        point = self.space.get(group)
        if point is not None and point.steps >= self.scene.time.steps:
            return point.error
        cells, order = group
        known = [(c, p) for (c, o), p in self.space.items() if o == order and c is not None and cells is not None]
        nested = set(nested_meshes(self.scene))
        known = [(c, p) for c, p in known if c in nested] or known
        fine = [(c, p) for c, p in known if p.steps >= self.scene.time.steps]
        known = fine if len(fine) > 1 else known
        if not known or cells is None:
            return float("inf") if point is None else point.error
        error = interpolate(cells[0], [c[0] for c, _ in known], [p.error for _, p in known])
        return error if point is None else min(error, point.error)

    def time_error(self, steps: int) -> float:
        """Error through the time step; order 2 beyond the steps tried."""
        return interpolate(steps, list(self.time), list(self.time.values()), -2.0) if self.time else 0.0

    def predict(self, setting: Setting) -> Prediction:
        """Error and times of a setting."""
        cells, order = setting.cells, setting.order
        error = self.space_error((cells, order)) + self.time_error(setting.steps)
        known = self.space.get((cells, order))
        others = [p for (c, o), p in self.space.items() if o == order]

        def seconds(stage: str) -> float:
            if known is not None:
                return float(getattr(known, stage))
            n = float(setting.unknowns(len(cells or ())))
            return interpolate(n, [p.n_e for p in others], [getattr(p, stage) for p in others])

        stages = sum(seconds(stage) for stage in ("mesh", "assembly", "factor"))
        return Prediction(setting, error, stages + setting.steps * seconds("per_step"), self.runs.get(setting))

    def candidates(self) -> list[Prediction]:
        """Settings of the diagram, other steps on their meshes, and finer meshes."""
        groups = list(self.space)
        if self.scene.tissue.cells is not None:
            coarse = smallest_mesh(self.scene)
            widest = max((c[0] for c, _ in groups if c is not None), default=coarse[0])
            for k in (*range(1, 17), *range(18, 32, 2), *range(32, 64, 4), *range(64, 257, 16), 384, 512, 768, 1024):
                cells = tuple(n * k for n in coarse)
                groups += [(cells, order) for order in (1, 2) if (cells, order) not in self.space]
                if cells[0] > 16 * widest:
                    break
        base = self.scene.time.steps
        least = least_steps(self.scene)
        counts = sorted({max(least, round(base * 2 ** (k / 2))) for k in range(-10, 5)} | set(step_counts(base, least)))
        settings = [Setting(cells, order, steps) for cells, order in groups for steps in counts]
        return [self.predict(s) for s in settings]

    def affordable(self, prediction: Prediction) -> bool:
        """Whether a setting may be run to measure it."""
        s, d = prediction.setting, len(prediction.setting.cells or ()) or self.scene.dimension or 3
        quick = s.unknowns(d) <= LARGEST[d] and s.unknowns(d) * s.steps <= GROWTH * POINT_WORK[d]
        return prediction.point is not None or quick
