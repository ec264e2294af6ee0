"""``softgrasp reduce`` by linear methods: every basis at every N, errors at other parameters, tables, page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from softgrasp.fem import Scene, Stopwatch, note
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.reduction import FullRun
from softgrasp.reduction.archive import save
from softgrasp.reduction.system import ModelError
from softgrasp.study.pictures import draw_in_background
from softgrasp.study.pull.page import pull_page
from softgrasp.study.reduce.linear import measure
from softgrasp.study.reduce.linear.memory import check_states
from softgrasp.study.reduce.linear.page import compose, findings
from softgrasp.study.reduce.linear.ranks import of_each_rank
from softgrasp.study.reduce.linear.result import MethodSweep, ReductionStudy, best, by_error
from softgrasp.study.reduce.linear.views import gather_views
from softgrasp.study.reduce.times import FullTimes, measured_run
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell import Session


def run_linear(session: Session, scene: Scene, names: Sequence[str]) -> dict[str, Any]:
    """Reduce the scene by the methods of these names, and write the results. Collective."""
    watch = Stopwatch(session.comm)
    model, ranks = of_each_rank(session.model(scene), scene)
    check_states(model, session.comm)
    with session.counting("full run") as say:
        with watch.stage("full"):
            full, times = measured_run(model, say, ranks)
        with watch.stage("sweep"):
            sweeps = measure.sweep_all(names, full, say, ranks=ranks)
        drawn = begin_to_draw(session, full, times, sweeps)
        with watch.stage("box"):
            box = measure.measure_box(full, sweeps, partial(say, "other parameters"), ranks)
        with watch.stage("turns"):
            turns = measure.headline_turns(full, sweeps, ranks)
    notes = measure.speed_notes(model.system.layout.n_e, scene.time.steps, times, sweeps)
    study = ReductionStudy(full, sweeps, times, box, turns, findings(sweeps), notes)
    chosen = [(s, p) for s in study.sweeps if (p := best(s.points)) is not None]
    models = [session.out / "models" / f"{s.method.key}.h5" for s, _ in chosen]
    with watch.stage("models"):
        for file, (s, p) in zip(models, chosen, strict=True):
            with raise_on_all_ranks(ranks):
                if ranks.rank == 0:
                    save(s.models[p.N], file)
    pulled = write_pull(session, study)
    result = study.result(watch.seconds) | {"ranks": session.comm.size, "memory_peak_mb": peak_memory_mb(session.comm)}

    session.write(scene, result, lambda: compose(study, drawn(), models, pulled))
    return result


def write_pull(session: Session, study: ReductionStudy) -> Path | None:
    """Write the page in which the mouse pulls the most accurate model that keeps the hand apart; None: there is none.

    Collective; all ranks get the name.
    """
    apart = [(s, p) for s, p in by_error(study.sweeps) if s.models[p.N].fixed_solid]
    if not (session.pictures and apart):
        return None
    (s, p), file = apart[0], session.out / "pull.html"
    page = ""
    with suppress(ModelError):  # larger than a page may be, or without a single equilibrium
        page = pull_page(s.models[p.N], study.full.model)
    if not session.comm.bcast(page != ""):
        return None
    with raise_on_all_ranks(session.comm):
        if page and session.comm.rank == 0:
            note(file)
            file.write_text(page, encoding="utf-8")
    return file


def begin_to_draw(
    session: Session, full: FullRun, times: FullTimes, sweeps: Sequence[MethodSweep]
) -> Callable[[], list[Path]]:
    """Draw beside what is measured next; the function returned waits for the pictures. Collective."""
    if not session.pictures:
        return list
    views = gather_views(full.model, full, sweeps)

    def draw(folder: Path) -> list[Path]:
        from softgrasp.study.reduce.linear.plots import draw_bodies, draw_errors  # bring Matplotlib

        return [*draw_errors(folder, sweeps, times.steps), *draw_bodies(folder, views)]

    return draw_in_background(session.comm, session.out, draw)
