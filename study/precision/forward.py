"""The forward question: mesh, order, time step and solver against the error of the outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from softgrasp.fem import Ends, Scene, expected_order
from softgrasp.study.precision.fit import Slope, series_of, slope
from softgrasp.study.precision.full import FullRuns, TimedRun, errors_of
from softgrasp.study.precision.points import ForwardPoint
from softgrasp.study.precision.result import Question, ReferenceSolution
from softgrasp.study.precision.settings import (
    GOALS,
    LEAST_STEPS,
    ORDERS,
    POINT_WORK,
    Setting,
    even_meshes,
    few_steps,
    least_steps,
    own_setting,
    scene_setting,
)

SHARES = (2.0, 1.0, 0.5, 0.25, 0.125)  # of the scene's steps
CG_TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
SLOW_SECONDS = 30.0  # of a run by CG, beyond which neither it nor a tighter tolerance is tried
FINEST = 3  # even meshes, or numbers of steps, behind a slope: coarser ones may not resolve ends or motion
CLEAR = 2.0  # times the error of the reference, from which on an error has an order


def step_counts(steps: int, least: int = LEAST_STEPS) -> list[int]:
    """Numbers of steps to try, most first."""
    return sorted({max(least, round(steps * share)) for share in SHARES}, reverse=True)


def mesh_series(scene: Scene, d: int) -> list[list[Setting]]:
    """The scene's own mesh, and even and graded ones of every order, each coarse to fine, at few steps."""
    own, few = own_setting(scene), few_steps(scene)
    series = [[own]]
    for order in ORDERS:
        even = [Setting(cells, order, few) for cells in even_meshes(scene, order)]
        series.append([s for s in even if s.group != own.group])
        series.append([Setting(None, order, few, refine=goal) for goal in GOALS[d][order]])
    return series


def solver_settings(scene: Scene, steps: int | None = None) -> list[Setting]:
    """Every solver on the scene's own mesh, at its own steps unless others are given."""
    base = replace(scene_setting(scene), solver="auto", steps=steps or scene.time.steps)
    solvers = [replace(base, solver=name) for name in ("cholesky", "mumps")]
    return solvers + [replace(base, solver="cg", rtol=rtol) for rtol in CG_TOLERANCES]


def to_point(setting: Setting, run: TimedRun, truth: ReferenceSolution, finest: TimedRun | None = None) -> ForwardPoint:
    """A run as a point of the diagram; ``finest`` is the run with the most steps on its mesh, when this is not it."""
    error, displacement = errors_of(run.series, truth.series)
    change = None if finest is None else errors_of(run.series, finest.series)[0]
    names = ("n_e", "states", "dt", "mesh", "assembly", "factor", "per_step", "p50", "p99", "max")
    return ForwardPoint(
        setting.mesh if setting.solver == "auto" else "solver", setting.label, run.seconds, error,
        error_displacement=displacement, error_range=truth.range_of(error), error_time=change,
        **setting.entries, **{name: getattr(run, name) for name in names},
    )  # fmt: skip


def ask_forward(runs: FullRuns, truth: ReferenceSolution, ends: Ends) -> Question:
    """Run all settings of the diagram. Collective."""
    points = list(_points(runs, truth))
    slopes = forward_slopes(points, truth, orders(runs.scene, ends, runs.dimension))
    return Question(tuple(points), tuple(slopes), truth)


def orders(scene: Scene, ends: Ends, d: int) -> dict[tuple[int, bool], float]:
    """Expected order in space by order of the elements and whether the mesh is graded."""
    edges = d == 3 and scene.tissue.size is None
    return {(p, graded): expected_order(ends, p, graded, edges) for p in ORDERS for graded in (False, True)}


def _points(runs: FullRuns, truth: ReferenceSolution) -> Iterator[ForwardPoint]:
    """Graded meshes and the scene's own with all numbers of steps, even ones with few. Collective."""
    scene, d = runs.scene, runs.dimension
    own = own_setting(scene)
    counts = step_counts(scene.time.steps, least_steps(scene))
    for line in mesh_series(scene, d):
        sizes: list[int] = []
        for setting in line:
            scenes = setting.group == own.group
            few = runs.run(setting)
            if few.n_e in sizes:  # a tolerance that changes nothing
                continue
            sizes.append(few.n_e)
            quick = [n for n in counts if few.n_e * n <= POINT_WORK[d] or (scenes and n <= scene.time.steps)]
            most = runs.run(replace(setting, steps=quick[0])) if quick and few.steps < quick[0] else few
            yield to_point(replace(setting, steps=most.steps), most, truth)
            for n in counts if scenes or setting.refine != "off" else ():
                if n < most.steps:
                    fewer = replace(setting, steps=n)
                    yield to_point(fewer, runs.run(fewer), truth, most)
            if few.n_e * few.steps > POINT_WORK[d]:
                break
    n_e = runs.run(own).n_e
    steps = next((n for n in counts if n <= own.steps and n_e * n <= POINT_WORK[d]), counts[-1])
    usual = runs.run(replace(own, steps=steps)).series
    tried: list[ForwardPoint] = []
    for setting in solver_settings(scene, steps):
        if setting.solver == "cg" and (seconds := runs.expected(setting)) > SLOW_SECONDS:
            tried.append(too_slow(tried[-1], setting, seconds))
            break
        run = runs.run(setting)
        tried.append(replace(to_point(setting, run, truth), error_solver=errors_of(run.series, usual)[0]))
    yield from tried


def too_slow(other: ForwardPoint, setting: Setting, seconds: float) -> ForwardPoint:
    """A setting that was not run, with its expected seconds; ``other`` is on the same mesh."""
    lost, step = float("inf"), seconds / setting.steps
    return replace(
        other, label=setting.label, solver=setting.solver, rtol=setting.rtol, ok=False, seconds=seconds, error=lost,
        error_displacement=lost, error_range=(0.0, lost), error_solver=None, factor=lost, per_step=step, p50=step,
        p99=step, max=step,
    )  # fmt: skip


def on_meshes(points: Sequence[ForwardPoint]) -> dict[str, list[ForwardPoint]]:
    """Points with the most steps on each mesh, by kind of mesh and order, coarse to fine; the scene's own if alone."""
    fine = [p for p in points if p.series != "solver" and p.error_time is None and p.refine != "scene"]
    lines = series_of(sorted(fine, key=lambda p: (p.setting.family, p.n_e)), lambda p: p.setting.family)
    own = {p.series for p in points if p.refine == "off" and p.error_time is not None}
    return {name: [p for p in line if p.series not in own] or line for name, line in lines.items()}


def over_steps(points: Sequence[ForwardPoint]) -> dict[str, list[ForwardPoint]]:
    """Points with a change in time on each mesh, few steps to many."""
    timed = [p for p in points if p.series != "solver" and p.error_time]
    return {name: sorted(line, key=lambda p: p.steps) for name, line in series_of(timed).items()}


def forward_slopes(
    points: Sequence[ForwardPoint], truth: ReferenceSolution, expected: dict[tuple[int, bool], float]
) -> list[Slope]:
    """Orders: of the error in n_e^(1/d), of the change in the steps, of time in the unknowns.

    Errors nearer than :data:`CLEAR` times that of the reference give no order.
    """
    slopes: list[Slope] = []
    d = truth.series.dimension
    for name, line in on_meshes(points).items():
        graded = line[0].refine != "off"
        last = [p for p in line if p.error > CLEAR * truth.error][0 if graded else -FINEST :]
        theory = -expected[line[0].order, graded]
        slopes += slope(last, f"error against n_e^(1/{d})", "n_e", "error", name, theory, root=d)
        slopes += slope(last, "error against seconds", "seconds", "error", name)
    for steps in {line[0].setting.family: line[-FINEST:] for line in over_steps(points).values()}.values():
        slopes += slope(steps, "change in time against steps", "steps", "error_time", expected=-2)
    runs = [p for p in points if p.series != "solver"]
    return slopes + slope(runs, "seconds of a step against unknowns", "n_e", "per_step", "all")
