"""``softgrasp reduce`` on a scene with effects.finite_strain: run, tables, sentences, page."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from softgrasp.fem import Scene, SceneError, Stopwatch
from softgrasp.reduction.archive import save
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.reduce.strain.measure import measure_strain
from softgrasp.study.reduce.strain.page import compose, sentences
from softgrasp.study.reduce.strain.result import StrainFamily, StrainStudy
from softgrasp.study.reduce.times import measured_run
from softgrasp.study.report import Page
from softgrasp.study.shell import Session


def run_strain(session: Session, scene: Scene) -> dict[str, Any]:
    """Reduce the scene and write the results. Collective. Raises SoftgraspError: with one sentence."""
    if scene.reduction.methods:
        raise SceneError(
            "reduction.methods names linear bases; leave it out with effects.finite_strain, whose models have one basis"
        )
    model, watch = session.model(scene), Stopwatch(session.comm)
    with session.counting("full run") as say:
        with watch.stage("full"):
            full, times = measured_run(model, say)
        with watch.stage("reduced"):
            study = measure_strain(full, times, say)
    folder = session.out / "models"
    models = {folder / f"{f.key}_N{N}.h5": rom for f in study.families for N, rom in f.models.items()}
    for path, rom in models.items():
        save(rom, path)
    picture = None
    if session.pictures:
        from softgrasp.fem.fields.picture import gather_picture
        from softgrasp.study.reduce.strain.plots import draw  # brings Matplotlib

        picture = gather_picture(model)
    result = reduce_result(
        study.full,
        {
            "finite_strain": {f.key: _family(study, f) for f in study.families},
            "error_linear": study.linear,
            "reason_for_none": study.none,
            "findings": sentences(study),
            "headline": study.turns,
        },
        study.times.to_json() | watch.seconds,
    )

    def page() -> Page:
        return compose(study, draw(session.out, study, picture) if session.pictures else [], [*models])

    session.write(scene, result, page)
    return result


def _family(study: StrainStudy, f: StrainFamily) -> dict[str, Any]:
    """One entry of "finite_strain" in ``result.json``."""
    return {
        "runs": f.runs,
        "box": f.box,
        "points": [asdict(p) | {"speed_up": study.times.against(p)} for p in f.points],
        "cells": f.curves,
        "held_out": f.tests,
        "refused": f.refused,
    }
