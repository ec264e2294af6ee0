"""``softgrasp control --gain-only``: the Riccati equation and the controllers, without closed loop and pictures."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.lqr.design.controller import CertifiedController, NoController, certified_controller
from softgrasp.lqr.design.feedback import Design, design
from softgrasp.lqr.design.orders import BasisGains, orders, reduce_gains
from softgrasp.lqr.design.scene import finite_problem, linearised
from softgrasp.lqr.reduced.bases import A_PRIORI
from softgrasp.study.control.loop import save_controllers, tick_seconds
from softgrasp.study.control.result import Note, a_priori, gain_result
from softgrasp.study.control.tables import controller_rows, gain_rows, gain_summary
from softgrasp.study.report.page import Section
from softgrasp.study.report.tables import pairs
from softgrasp.study.shell.session import Page, Session, list_files


def small_controller(
    feedback: Design, basis: BasisGains | None
) -> tuple[CertifiedController | None, float, list[Note]]:
    """Controller and median seconds of one tick of it; or a note why there is none. Collective."""
    try:
        controller = certified_controller(feedback, basis)
    except NoController as error:
        return None, float("nan"), [Note("controller", f"There is no small controller: {error}")]
    return controller, feedback.problem.layout.comm.bcast(tick_seconds(controller.controller)), []


def run_gain(
    session: Session,
    model: Model,
    watch: Stopwatch,
    progress: Callable[[dict[str, float]], None],
    notes: list[Note],
    restart: Path | None,
) -> dict[str, Any]:
    """Solve, reduce a priori, write the controllers. Collective; arguments as for ``control_model``."""
    feedback = design(linearised(model), watch, progress, restart)
    bases: tuple[BasisGains, ...] = ()
    if not feedback.modal:
        with watch.stage("reduced"):
            bases = reduce_gains(feedback, orders(feedback)[0], names=(A_PRIORI,))
    controller, tick, refused = small_controller(feedback, a_priori(bases))
    session.out.mkdir(parents=True, exist_ok=True)
    target = feedback.target
    if model.system.points is not None:
        _, target = finite_problem(feedback.problem, model.system, target)
    saved = save_controllers(feedback, controller, session.out, target.state)
    result = gain_result(feedback, controller, tick, [*notes, *refused], {**model.watch.seconds, **watch.seconds})
    rows = [*gain_rows(feedback), *controller_rows(controller, tick)]
    page = Page(
        f"{model.scene.name}: optimal gain",
        gain_summary(feedback, controller, tick),
        [Section("Result", rows=rows)],
        files=saved,
        options=" --gain-only",
    )
    session.console.print(pairs(rows))
    list_files(session.console, session.write(model.scene, result, lambda: page))
    if restart is not None and session.comm.rank == 0:
        shutil.rmtree(restart, ignore_errors=True)
    return result
