"""``softgrasp reduce``: reduced models of a scene, their errors and their times beside the full model's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Unpack

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.run.simulate import Run
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.archive import save
from softgrasp.reduction.replay import FullRun
from softgrasp.study.pictures.beside import beside
from softgrasp.study.reduce import tables
from softgrasp.study.reduce.box import measure_box
from softgrasp.study.reduce.findings import findings
from softgrasp.study.reduce.page import sections
from softgrasp.study.reduce.result import BoxTests, FullTimes, MethodSweep, ReductionStudy, best, head_of
from softgrasp.study.reduce.sweep import chosen_methods, sweep
from softgrasp.study.reduce.times import measured_run, speed_notes, speed_of
from softgrasp.study.reduce.views import gather_views
from softgrasp.study.report.files import to_json
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.session import Flags, Page, Session, list_files


def check_scene(scene: Scene) -> tuple[str, ...]:
    """Methods of the scene.

    Raises:
        SceneError: the scene keeps no snapshots that a basis could be built from.
        BasisError: a method is unknown.
    """
    if scene.output.snapshots != "memory":
        raise SceneError(
            f"output.snapshots is '{scene.output.snapshots}'; it must be 'memory' for a reduction, which builds its "
            "bases from the states in memory"
        )
    if scene.effects.reaction and scene.output.every != 1:
        raise SceneError(
            f"output.every is {scene.output.every}; it must be 1 with effects.reaction, because the force on the hand "
            "needs every state"
        )
    return chosen_methods(scene.reduction)


def run_reduce(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    tolerance: float | None = None,
    **flags: Unpack[Flags],
) -> dict[str, Any]:
    """Reduce a scene file by all its methods, or build one certified model, and write the results. Collective.

    Raises SoftgraspError: with one sentence.
    """
    if tolerance is not None:
        overrides = [*overrides, f"reduction.tolerance={tolerance}", "reduction.train='greedy'"]
    session = Session("reduce", path, overrides, out, console, **flags)
    scene = session.scene()
    names = check_scene(scene)
    if scene.reduction.certify != "off" or scene.reduction.train == "greedy":
        from softgrasp.study.reduce.certify import run_certify  # only certified models pay for it

        return run_certify(session, scene)
    if scene.effects.finite_strain is not None:
        from softgrasp.study.reduce.strain_run import run_strain  # models of another kind

        return run_strain(session, scene)
    model = session.model(scene)
    watch = Stopwatch(session.comm)
    with session.progress(MofNCompleteColumn()) as bar:
        study, drawn = reduce_model(session, model, names, bar, watch)
    with watch.stage("models"):
        models = save_models(out, study.sweeps)
    result = reduce_result(study, watch)

    def page() -> Page:
        files = drawn()
        parts = sections(study, files)
        points = {"points.csv": tables.point_table(study)}
        return Page(f"{scene.name}: reduced models", tables.summary(study), parts, points, [*files, *models])

    show(console, study)
    list_files(console, session.write(scene, result, page))
    return result


def reduce_model(
    session: Session, model: Model, names: Sequence[str], bar: Progress, watch: Stopwatch
) -> tuple[ReductionStudy, Callable[[], list[Path]]]:
    """Full run, every method, errors over the box, beside which pictures are drawn. Collective.

    Returned with the study: what waits for the pictures on rank 0.

    Raises:
        SolverError: a solve failed or a factorisation did.
        ResourceError: the snapshots do not fit.
    """
    scene = model.scene
    task = bar.add_task("full run", total=scene.time.steps)

    def stepped(run: Run) -> None:
        bar.update(task, completed=run.reached)

    with watch.stage("full"):
        full, times = measured_run(model, stepped)
    bar.remove_task(task)
    size = len(scene.reduction.N)
    task = bar.add_task("bases", total=size * len(names))
    sweeps: list[MethodSweep] = []
    with watch.stage("sweep"):
        for name in names:

            def reduced(key: str, done: int, of: int) -> None:
                bar.update(task, completed=size * len(sweeps) + size * done // of, description=key)

            sweeps.append(sweep(name, full, scene.reduction, reduced))
            bar.update(task, completed=size * len(sweeps))
    bar.remove_task(task)
    drawn = _drawn(session, full, sweeps, times)
    task = bar.add_task("other parameters", total=None)
    with watch.stage("box"):
        box = measure_box(full, sweeps, lambda done, of: bar.update(task, completed=done, total=of))
    bar.remove_task(task)
    speeds = tuple(speed for s in sweeps if (speed := speed_of(s, times)) is not None)
    notes = speed_notes(model.system.layout.n_e, scene.time.steps, times, speeds)
    return ReductionStudy(full, tuple(sweeps), times, speeds, box, findings(sweeps), notes), drawn


def _drawn(
    session: Session, full: FullRun, sweeps: Sequence[MethodSweep], times: FullTimes
) -> Callable[[], list[Path]]:
    """Begin to draw on rank 0. Collective."""
    if not session.pictures:
        return list
    views = gather_views(full.model, full, sweeps)

    def draw_all(out: Path) -> list[Path]:
        from softgrasp.study.reduce.pictures import draw  # brings Matplotlib

        return draw(out, sweeps, times.steps, views)

    return beside(session.comm, session.out, draw_all)


def save_models(out: Path, sweeps: Sequence[MethodSweep]) -> list[Path]:
    """Write the best stable model of every method into ``out/models``. Collective."""
    files = []
    for s in sweeps:
        i = best(s.points)
        if i is not None:
            files.append(out / "models" / f"{s.method.key}.h5")
            save(s.models[i], files[-1])
    return files


def reduce_result(study: ReductionStudy, watch: Stopwatch) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    model = study.full.model
    head, seconds = head_of(model, study.full.trajectory)
    result = head | {
        "N_means": tables.N_NOTE,
        "methods": {s.method.key: [asdict(p) for p in s.points] for s in study.sweeps},
        "about": {s.method.key: _about(s) for s in study.sweeps},
        "findings": study.findings,
        "speed": [speed.to_json() for speed in study.speeds],
        "speed_notes": study.speed_notes,
        "box": _box_result(study.box),
        "time": {
            **{key: seconds[key] for key in ("mesh", "assembly", "factor", "steps", "per_step")},
            "full_steps_median": study.times.steps,
            "full_factor_median": study.times.factor,
            **watch.seconds,
        },
        "memory_peak_mb": peak_memory_mb(model.system.layout.comm),
    }
    return dict(to_json(result))


def _about(s: MethodSweep) -> dict[str, Any]:
    return {
        "title": s.method.title,
        "paper": s.method.paper,
        "structure_preserving": s.method.preserving,
        "inner": s.inner,
        "N_energy": s.N_energy,
        "N_refused": {N: f"N = {N}: {reason}" for N, reason in s.refused.items()},
    }


def _box_result(box: BoxTests) -> dict[str, Any]:
    models = [{"method": m.method.key, "N": m.model.N, "several": m.several} for m in box.models]
    return {
        "reason_for_none": box.none,
        "trained_at": box.trained_at,
        "summary": [asdict(e) for e in box.summary],
        "points": [
            {
                "lambda": p.lam,
                "mu": p.mu,
                "trained": p.trained,
                "errors": [m | {"error_deformation": e} for m, e in zip(models, p.errors, strict=True)],
            }
            for p in box.points
        ],
    }


def show(console: Console, study: ReductionStudy) -> None:
    """Print the tables."""
    energy, box = study.full.model.scene.reduction.energy, study.box
    _print(console, tables.error_table(study.sweeps, energy, narrow=True))
    note = (
        f"{tables.error_note(energy)} fixed: with fixed solid modes. {tables.N_NOTE} {tables.inner_note(study.sweeps)}"
    )
    console.print(note, style="dim", markup=False)
    for sentence in study.findings:
        console.print(sentence, markup=False)
    for sizes, titles, reason in tables.refused_table(study.sweeps, narrow=True).rows:
        console.print(f"N = {sizes} refused for {titles}: {reason}.", markup=False)
    _print(console, tables.time_table(study.speeds, narrow=True))
    for note in study.speed_notes:
        console.print(note)
    if box.none:
        console.print(f"no errors at other parameters: {box.none}")
    else:
        console.print(tables.box_note(box), markup=False)
        _print(console, tables.box_table(box, narrow=True))


def _print(console: Console, table: Table) -> None:
    """A table without its title; a narrow terminal breaks the first column and the last."""
    console.print(Table(table.header, table.rows).terminal(wrap=(0, len(table.header) - 1), width=console.width))
