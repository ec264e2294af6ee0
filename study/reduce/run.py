"""``softgrasp reduce``: reduced models of a scene, their errors and their times beside the full model's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Unpack

from rich.console import Console

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Stopwatch
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.archive import save
from softgrasp.reduction.replay import FullRun
from softgrasp.study.pictures.background import draw_in_background
from softgrasp.study.reduce import measure, report
from softgrasp.study.reduce.findings import findings
from softgrasp.study.reduce.result import N_NOTE, FullTimes, ReductionStudy, best
from softgrasp.study.reduce.views import gather_views
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.folder import folder_lock
from softgrasp.study.shell.session import Flags, Page, Session, list_files


def check_scene(scene: Scene) -> tuple[str, ...]:
    """Methods of the scene. Raises SceneError: it keeps no snapshots for a basis. BasisError: a method is unknown."""
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
    return measure.chosen_methods(scene.reduction)


@folder_lock()
def run_reduce(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    tolerance: float | None = None,
    **flags: Unpack[Flags],
) -> dict[str, Any]:
    """Reduce a scene file by all its methods, or build one certified model, and write the results. Collective."""
    if tolerance is not None:
        overrides = [*overrides, f"reduction.tolerance={tolerance}", "reduction.train='greedy'"]
    session = Session("reduce", path, overrides, out, console, **flags)
    scene = session.scene()
    names = check_scene(scene)
    if scene.reduction.certify != "off" or scene.reduction.train == "greedy":
        from softgrasp.study.reduce.certify import run_certify  # only certified models pay for it

        return run_certify(session, scene)
    if scene.effects.finite_strain is not None:
        from softgrasp.study.reduce.strain import run_strain  # models of another kind

        return run_strain(session, scene)
    model, watch = session.model(scene), Stopwatch(session.comm)
    with session.counting("full run") as say:
        with watch.stage("full"):
            full, times = measure.measured_run(model, say)
        study, drawn = reduce_model(session, full, times, names, watch, say)
    chosen = [(s, p) for s in study.sweeps if (p := best(s.points)) is not None]
    models = [out / "models" / f"{s.method.key}.h5" for s, _ in chosen]
    with watch.stage("models"):
        for file, (s, p) in zip(models, chosen, strict=True):
            save(s.models[p.N], file)
    result = study.result(watch.seconds)

    def page() -> Page:
        files = drawn()
        points = {"points.csv": report.point_table(study)}
        parts = report.sections(study, files)
        return Page(f"{scene.name}: reduced models", report.summary(study), parts, points, [*files, *models])

    show(console, study)
    list_files(console, session.write(scene, result, page))
    return result


def reduce_model(
    session: Session, full: FullRun, times: FullTimes, names: Sequence[str], watch: Stopwatch, say: measure.Say
) -> tuple[ReductionStudy, Callable[[], list[Path]]]:
    """Every method, and errors over the box, beside which pictures are drawn. Collective.

    Returned with the study: what waits for the pictures on rank 0.
    """
    model, options = full.model, full.model.scene.reduction
    size = len(options.N)

    def swept(i: int, done: int, of: int) -> None:
        say(names[i], size * i + size * done // of, size * len(names))

    with watch.stage("sweep"):
        sweeps = tuple(measure.sweep(name, full, options, partial(swept, i)) for i, name in enumerate(names))
    drawn: Callable[[], list[Path]] = list
    if session.pictures:
        views = gather_views(model, full, sweeps)

        def draw_all(folder: Path) -> list[Path]:
            from softgrasp.study.reduce.plots import draw  # brings Matplotlib

            return draw(folder, sweeps, times.steps, views)

        drawn = draw_in_background(session.comm, session.out, draw_all)
    with watch.stage("box"):
        box = measure.measure_box(full, sweeps, partial(say, "other parameters"))
    notes = measure.speed_notes(model.system.layout.n_e, model.scene.time.steps, times, sweeps)
    return ReductionStudy(full, sweeps, times, box, findings(sweeps), notes), drawn


def show(console: Console, study: ReductionStudy) -> None:
    """Print tables and sentences."""
    energy, box = study.full.model.scene.reduction.energy, study.box
    _print(console, report.error_table(study.sweeps, energy, narrow=True))
    note = f"{report.error_note(energy)} fixed: with fixed solid modes. {N_NOTE} {report.inner_note(study.sweeps)}"
    console.print(note, style="dim", markup=False)
    for sentence in study.findings:
        console.print(sentence, markup=False)
    for sizes, titles, reason in report.refused_table(study.sweeps, narrow=True).rows:
        console.print(f"N = {sizes} refused for {titles}: {reason}.", markup=False)
    _print(console, report.time_table(study, narrow=True))
    for note in study.speed_notes:
        console.print(note)
    if box.none:
        console.print(f"no errors at other parameters: {box.none}")
    else:
        console.print(report.box_note(box), markup=False)
        _print(console, report.box_table(box, narrow=True))


def _print(console: Console, table: Table) -> None:
    """A table without its title; a narrow terminal breaks the first column and the last."""
    console.print(Table(table.header, table.rows).terminal(wrap=(0, len(table.header) - 1), width=console.width))
