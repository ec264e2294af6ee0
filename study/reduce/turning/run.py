"""``softgrasp reduce`` on a scene with effects.frame: run, tables, page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from softgrasp.fem import Scene, Stopwatch
from softgrasp.reduction.archive import save
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.reduce.times import measured_run
from softgrasp.study.reduce.turning.measure import measure_turning
from softgrasp.study.reduce.turning.page import best, compose
from softgrasp.study.report import Page
from softgrasp.study.shell import Session


def run_turning(session: Session, scene: Scene, names: Sequence[str]) -> dict[str, Any]:
    """Reduce the scene and write the results. Collective. Raises SoftgraspError: with one sentence."""
    model, watch = session.model(scene), Stopwatch(session.comm)
    with session.counting("full run") as say:
        with watch.stage("full"):
            full, times = measured_run(model, say)
        with watch.stage("reduced"):
            points, models, refused = measure_turning(full, names, say)
    files = {session.out / "models" / f"{name}.h5": rom for name, rom in models.items()}
    for path, rom in files.items():
        save(rom, path)
    own = {"frame": [asdict(p) | {"speed_up": times.against(p)} for p in points], "refused": refused,
           "best": asdict(best(points))}  # fmt: skip
    result = reduce_result(full, own, times.to_json() | watch.seconds)

    def page() -> Page:
        drawn = []
        if session.pictures:
            from softgrasp.study.reduce.turning.plots import draw  # brings Matplotlib

            drawn = draw(session.out, points)
        return compose(full, times, points, refused, drawn, [*files])

    session.write(scene, result, page)
    return result
