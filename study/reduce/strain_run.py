"""``softgrasp reduce`` on a scene with effects.finite_strain."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from rich.progress import MofNCompleteColumn

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Stopwatch
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.archive import save
from softgrasp.study.reduce.result import head_of
from softgrasp.study.reduce.strain_measure import measure_strain
from softgrasp.study.reduce.strain_page import cell_table, error_table, sections, sentences, summary, time_table
from softgrasp.study.reduce.strain_result import StrainPoint, StrainStudy
from softgrasp.study.reduce.times import measured_run
from softgrasp.study.report.files import to_json
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.session import Page, Session, list_files


def run_strain(session: Session, scene: Scene) -> dict[str, Any]:
    """Reduce the scene and write the results. Collective. Raises SoftgraspError: with one sentence."""
    if scene.reduction.methods:
        raise SceneError(
            "reduction.methods names linear bases; leave it out with effects.finite_strain, whose models have one basis"
        )
    model, watch = session.model(scene), Stopwatch(session.comm)
    with session.progress(MofNCompleteColumn()) as bar:
        task = bar.add_task("full run", total=scene.time.steps)

        def say(what: str, done: int, of: int) -> None:
            bar.update(task, description=what, completed=done, total=of)

        with watch.stage("full"):
            full, times = measured_run(model, lambda run: say("full run", run.reached, run.steps))
        with watch.stage("reduced"):
            study = measure_strain(model, full, times, say)
    last = study.families[-1]
    models = [session.out / "models" / f"{f.key}_N{N}.h5" for f in study.families for N in f.models]
    for path, rom in zip(models, [rom for f in study.families for rom in f.models.values()], strict=True):
        save(rom, path)
    picture = None
    if session.pictures:
        from softgrasp.fem.fields.picture import gather_picture
        from softgrasp.study.reduce.strain_pictures import draw  # brings Matplotlib

        picture = gather_picture(model)
    result = strain_result(study, watch)

    def page() -> Page:
        files = draw(session.out, study, picture) if session.pictures else []
        names = tuple(StrainPoint.__dataclass_fields__)
        rows = [(f.runs, *asdict(p).values()) for f in study.families for p in f.curves]
        points = {"points.csv": Table(("runs", *names), rows)}
        title = f"{scene.name}: reduced models at finite strain, {last.points[0].engine} stepper"
        return Page(title, summary(study), sections(study, files), points, [*files, *models])

    for table in (error_table(study), time_table(study), cell_table(study)):
        session.console.print(table.terminal(wrap=(0,), width=session.console.width))
    for sentence in sentences(study):
        session.console.print(sentence, markup=False)
    list_files(session.console, session.write(scene, result, page))
    return result


def strain_result(study: StrainStudy, watch: Stopwatch) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    model = study.full.model
    head, _ = head_of(model, study.full.trajectory)
    families = {}
    for f in study.families:
        names = ("again", "new", "break_even_runs")
        speeds = [dict(zip(names, study.speed_up(p), strict=True)) for p in f.points]
        families[f.key] = {
            "runs": f.runs,
            "box": {key: np.asarray(value).tolist() for key, value in asdict(f.box).items()},
            "points": [asdict(p) | {"speed_up": s} for p, s in zip(f.points, speeds, strict=True)],
            "cells": [asdict(p) for p in f.curves],
            "held_out": [asdict(t) for t in f.tests],
            "refused": f.refused,
        }
    result = head | {
        "finite_strain": families,
        "error_linear": study.linear,
        "reason_for_none": study.none,
        "findings": sentences(study),
        "time": {"full_steps_median": study.times.steps, "full_factor_median": study.times.factor, **watch.seconds},
        "memory_peak_mb": peak_memory_mb(model.system.layout.comm),
    }
    return dict(to_json(result))
