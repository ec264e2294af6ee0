"""``softgrasp reduce`` by linear methods: every basis at every N, errors at other parameters, tables, page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from softgrasp.fem import Scene, Stopwatch
from softgrasp.reduction import FullRun
from softgrasp.reduction.archive import save
from softgrasp.study.pictures import draw_in_background
from softgrasp.study.reduce.linear import measure
from softgrasp.study.reduce.linear.page import compose, findings
from softgrasp.study.reduce.linear.result import MethodSweep, ReductionStudy, best
from softgrasp.study.reduce.linear.views import gather_views
from softgrasp.study.reduce.times import FullTimes, measured_run
from softgrasp.study.shell import Session


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

    session.write(scene, result, lambda: compose(study, drawn(), models))
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
