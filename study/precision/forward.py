"""The forward question: mesh, order, time step and solver against the error of the outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.fit import Slope, interpolate, power_law
from softgrasp.study.precision.full import FullRuns, errors_of, largest
from softgrasp.study.precision.meshes import halved_meshes, nested_meshes, smallest_mesh
from softgrasp.study.precision.points import LEAST_STEPS, Row, Setting, WorkPoint, least_steps, scene_setting
from softgrasp.study.precision.reference import Reference

SHARES = (2.0, 1.0, 0.5, 0.25, 0.125)  # of the scene's steps
CG_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
POINT_WORK = {2: 8e6, 3: 6e5}  # unknowns times steps of a point of the diagram
LARGEST = {2: 300_000, 3: 60_000}  # unknowns of a setting that no run of the diagram tried
GROWTH = 8.0  # and its work over that of the largest point
MESHES = 5  # of each order, besides the scene's own
FINEST = 3  # numbers of steps behind a slope in time: coarser ones may not resolve the motion
CLEAR = 2.0  # times the error of the reference, from which on an error has an order
SAFETY = 0.9  # of the tolerance that a predicted error may use
Group = tuple[tuple[int, ...] | None, int]


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
    point: WorkPoint | None


def step_counts(steps: int, least: int = LEAST_STEPS) -> list[int]:
    """Numbers of steps to try, most first. Not collective."""
    return sorted({max(least, round(steps * share)) for share in SHARES}, reverse=True)


def forward_settings(scene: Scene, d: int) -> list[Setting]:
    """Settings of the diagram, the most steps of each mesh first; then solvers at the scene's own. Not collective."""
    own = scene_setting(scene)
    groups: list[Group] = [(own.cells, own.order)]
    groups += [(cells, order) for order in (1, 2) for cells in (halved_meshes(scene, MESHES) or (None,))]
    found = []
    for cells, order in dict.fromkeys(groups):
        for steps in step_counts(scene.time.steps, least_steps(scene)):
            setting = Setting(cells, order, steps)
            small = setting.unknowns(d) * steps <= POINT_WORK[d] or steps <= scene.time.steps / 4
            if small or (cells, order) == groups[0]:
                found.append(setting)
    base = replace(own, solver="auto")
    solvers = [replace(base, solver=name) for name in ("cholesky", "mumps")]
    return found + solvers + [replace(base, solver="cg", rtol=rtol) for rtol in CG_TOLERANCES]


def to_point(setting: Setting, row: Row, runs: FullRuns, reference: Reference, series: str = "") -> WorkPoint:
    """A run as a point of the diagram; its error may be anything in ``error_range``. Not collective."""
    error, displacement = errors_of(runs.series(row), reference.series)
    kept = ("n_e", "states", "steps", "dt", "mesh", "assembly", "factor", "per_step", "p50", "p99", "max")
    details = {
        "cells": None if setting.cells is None else list(setting.cells), "order": setting.order,
        "solver": setting.solver, "rtol": setting.rtol if setting.solver == "cg" else None,
        "error_deformation": error, "error_displacement": displacement, "error_range": reference.range_of(error),
        **{key: row[key] for key in kept},
    }  # fmt: skip
    return WorkPoint("forward", series or setting.mesh, setting.label, row["seconds"], error, True, details)


def sweep_forward(scene: Scene, runs: FullRuns, reference: Reference) -> list[WorkPoint]:
    """Run all settings of the diagram. Collective.

    Each point also carries ``error_time``, the change of the outputs against the most steps on its mesh.

    Raises:
        SolverError: a run failed.
        Interrupted: somebody asked to stop.
    """
    points: list[WorkPoint] = []
    finest: dict[Group, Row] = {}
    for setting in forward_settings(scene, reference.series.dimension):
        row = runs.run(setting)
        group = (setting.cells, setting.order)
        if setting.solver != "auto":
            points.append(to_point(setting, row, runs, reference, "solver"))
            continue
        best = finest.setdefault(group, row)
        point = to_point(setting, row, runs, reference)
        if best is not row:
            series, true = runs.series(row), runs.series(best)
            gap = largest(series.values - true.at(series.times), series.dimension)[0]
            scale = largest(true.values, true.dimension)[0]
            point.details["error_time"] = gap / scale if scale > 0 else 0.0
        points.append(point)
    return points


def setting_of(point: WorkPoint) -> Setting:
    """The setting of the full run of a point, or behind a reduced one. Not collective."""
    d = point.details
    cells = None if d["cells"] is None else tuple(d["cells"])
    return Setting(cells, d["order"], d["steps"], d["solver"], d["rtol"] or 1e-10)


def forward_slopes(points: Sequence[WorkPoint], reference_error: float) -> list[Slope]:
    """Orders: of the error in the cells (most steps), of the change in the steps, of time in the unknowns.

    Errors nearer than :data:`CLEAR` times that of the reference tell no order. Not collective.
    """
    found: list[Slope] = []
    plain = [p for p in points if p.series != "solver"]
    for order in (1, 2):
        mine = [
            p for p in plain if p.details["order"] == order and p.details["cells"] and "error_time" not in p.details
        ]
        mine = sorted((p for p in mine if p.error > CLEAR * reference_error), key=lambda p: p.details["n_e"])
        name = f"P{order}"
        for against, x, y in (
            ("cells along an edge", [p.details["cells"][0] for p in mine], [p.error for p in mine]),
            ("seconds", [p.seconds for p in mine], [p.error for p in mine]),
        ):
            power = power_law(x, y)
            if power is not None:
                found.append(Slope("forward", name, f"error against {against}", power, len(mine)))
    timed = [p for p in plain if p.details.get("error_time", 0) > 0]
    for series in dict.fromkeys(p.series for p in timed):
        mine = sorted((p for p in timed if p.series == series), key=lambda p: p.details["steps"])[-FINEST:]
        power = power_law([p.details["steps"] for p in mine], [p.details["error_time"] for p in mine])
        if power is not None:
            found.append(Slope("forward", series, "change in time against steps", power, len(mine)))
    power = power_law([p.details["n_e"] for p in plain], [p.details["per_step"] for p in plain])
    if power is not None:
        found.append(Slope("forward", "all", "seconds of a step against unknowns", power, len(plain)))
    return found


class Predictor:
    """Error and time of any setting from the points of the diagram: error <= space(mesh) + time(steps).

    The change between s and S steps of order 2 is (1 - (s / S)^2) of the error with s, and the error with S is a
    quarter of that with S / 2.

    Args:
        scene: the study's scene.
        points: of the forward diagram.
    """

    def __init__(self, scene: Scene, points: Sequence[WorkPoint]) -> None:
        self.scene = scene
        self.plain = [p for p in points if p.series != "solver"]
        self.tried = {setting_of(p): p for p in self.plain}
        self.space: dict[Group, WorkPoint] = {}
        for p in self.plain:
            s = setting_of(p)
            best = self.space.setdefault((s.cells, s.order), p)
            if p.details["steps"] > best.details["steps"]:
                self.space[(s.cells, s.order)] = p
        changing = [p for p in self.plain if p.details.get("error_time", 0) > 0]
        names = [p.series for p in changing]
        # the mesh with the most steps tried tells about time, the finest of those
        best_name = max(names, key=lambda n: (names.count(n), n), default="")
        most = max((p.details["steps"] for p in self.plain if p.series == best_name), default=1)
        self.time = {
            int(p.details["steps"]): p.details["error_time"] / (1 - (p.details["steps"] / most) ** 2)
            for p in changing if p.series == best_name
        }  # fmt: skip

    def space_error(self, group: Group) -> float:
        """Error of a mesh at its most steps; of others by the slope of their element order."""
        if group in self.space:
            return self.space[group].error
        cells, order = group
        known = [(c, p) for (c, o), p in self.space.items() if o == order and c is not None and cells is not None]
        nested = set(nested_meshes(self.scene))
        known = [(c, p) for c, p in known if c in nested] or known
        if not known or cells is None:
            return float("inf")
        return interpolate(cells[0], [c[0] for c, _ in known], [p.error for _, p in known])

    def time_error(self, steps: int) -> float:
        """Error through the time step; order 2 beyond the steps tried."""
        return interpolate(steps, list(self.time), list(self.time.values()), -2.0) if self.time else 0.0

    def predict(self, setting: Setting) -> Prediction:
        """Error and times of a setting. Not collective."""
        cells, order = setting.cells, setting.order
        error = self.space_error((cells, order)) + self.time_error(setting.steps)
        mine = self.space.get((cells, order))
        if mine is None:
            d = len(cells or ())
            others = [p for (c, o), p in self.space.items() if o == order]
            sizes = [p.details["n_e"] for p in others]
            n = float(setting.unknowns(d))

            def grown(key: str) -> float:
                return interpolate(n, sizes, [p.details[key] for p in others])

            stages, per_step = sum(grown(key) for key in ("mesh", "assembly", "factor")), grown("per_step")
        else:
            stages = sum(mine.details[key] for key in ("mesh", "assembly", "factor"))
            per_step = mine.details["per_step"]
        return Prediction(setting, error, stages + setting.steps * per_step, self.tried.get(setting))

    def candidates(self) -> list[Prediction]:
        """All settings worth a thought: tried ones, other steps on their meshes, and finer meshes. Not collective."""
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

    def affordable(self, found: Prediction) -> bool:
        """Whether a setting may be run to measure it. Not collective."""
        s, d = found.setting, len(found.setting.cells or ()) or self.scene.dimension or 3
        small = s.unknowns(d) <= LARGEST[d] and s.unknowns(d) * s.steps <= GROWTH * POINT_WORK[d]
        return found.point is not None or small
