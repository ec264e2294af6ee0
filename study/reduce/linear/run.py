"""``softgrasp reduce`` by linear methods: every basis at every N, errors at other parameters, tables, page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from softgrasp.fem.model.build import Stopwatch
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.archive import save
from softgrasp.reduction.replay import FullRun
from softgrasp.study.pictures.background import draw_in_background
from softgrasp.study.reduce.linear import measure, report
from softgrasp.study.reduce.linear.findings import findings
from softgrasp.study.reduce.linear.result import N_NOTE, MethodSweep, ReductionStudy, best
from softgrasp.study.reduce.linear.views import gather_views
from softgrasp.study.reduce.times import FullTimes, measured_run
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.session import Page, Session


def run_linear(session: Session, scene: Scene, names: Sequence[str]) -> dict[str, Any]:
    """Reduce the scene by the methods of these names, and write the results. Collective."""
    model, watch = session.model(scene), Stopwatch(session.comm)
    with session.counting("full run") as say:
        with watch.stage("full"):
            full, times = measured_run(model, say)
        with watch.stage("sweep"):
            sweeps = measure.sweep_all(names, full, say)
        drawn = begin_to_draw(session, full, times, sweeps)
        with watch.stage("box"):
            box = measure.measure_box(full, sweeps, partial(say, "other parameters"))
        with watch.stage("turns"):
            turns = measure.headline_turns(full, sweeps)
    notes = measure.speed_notes(model.system.layout.n_e, scene.time.steps, times, sweeps)
    study = ReductionStudy(full, sweeps, times, box, turns, findings(sweeps), notes)
    chosen = [(s, p) for s in study.sweeps if (p := best(s.points)) is not None]
    models = [session.out / "models" / f"{s.method.key}.h5" for s, _ in chosen]
    with watch.stage("models"):
        for file, (s, p) in zip(models, chosen, strict=True):
            save(s.models[p.N], file)
    result = study.result(watch.seconds)

    def page() -> Page:
        files = drawn()
        points = {"points.csv": report.point_table(study)}
        parts = report.sections(study, files)
        return Page(f"{scene.name}: reduced models", report.summary(study), parts, points, [*files, *models])

    show(session.console, study)
    session.write(scene, result, page)
    return result


def begin_to_draw(
    session: Session, full: FullRun, times: FullTimes, sweeps: Sequence[MethodSweep]
) -> Callable[[], list[Path]]:
    """Draw beside what is measured next; the function returned waits for the pictures. Collective."""
    if not session.pictures:
        return list
    views = gather_views(full.model, full, sweeps)

    def draw_all(folder: Path) -> list[Path]:
        from softgrasp.study.reduce.linear.plots import draw  # brings Matplotlib

        return draw(folder, sweeps, times.steps, views)

    return draw_in_background(session.comm, session.out, draw_all)


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
    for sentence in report.summary(study):
        console.print(sentence, markup=False)
    if box.none:
        console.print(f"no errors at other parameters: {box.none}")
    else:
        console.print(report.box_note(box), markup=False)
        _print(console, report.box_table(box, narrow=True))


def _print(console: Console, table: Table) -> None:
    """A table without its title; a narrow terminal breaks the first column and the last."""
    console.print(Table(table.header, table.rows).terminal(wrap=(0, len(table.header) - 1), width=console.width))
