"""``softgrasp reduce --tolerance``: one reduced model with a bound of its error, built by the greedy over a box."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import Progress, TaskProgressColumn

from softgrasp.fem import Model, Scene, SoftgraspError, Stopwatch
from softgrasp.reduction import CertifiedModel, Greedy, Materials, ModelError, load_certified, run_at, save_certified
from softgrasp.reduction.certified.trainer import (
    PLACES,
    SHARE,
    Trainer,
    build_certified,
    offline_mesh_estimate,
    state_of,
    train_key,
    validate,
)
from softgrasp.study.reduce.certified.measure import REPEATS, BoxCheck, check_box
from softgrasp.study.reduce.certified.page import compose, shown
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.report import Page
from softgrasp.study.shell import Session, median_seconds

FILE = "certified.h5"
PAUSE = 2.0  # seconds between files of an unfinished model: a file takes as long as three points of the greedy


def run_certify(session: Session, scene: Scene) -> dict[str, Any]:
    """Build, save and show a certified model of a scene; an interrupted run goes on from its last round. Collective."""
    model, file, console = session.model(scene), session.out / "models" / FILE, session.console
    watch, tolerance, options = Stopwatch(session.comm), scene.reduction.tolerance, scene.reduction
    earlier = _earlier(model, file)
    state = None if earlier is None else state_of(earlier)
    if state is not None:
        console.print(f"going on from round {len(state.rounds)} in {file}", soft_wrap=True, markup=False)
    trainer = Trainer(model, earlier)
    lam, mu = (f"{low:.4g} to {high:.4g} Pa" for low, high in (trainer.box.lam, trainer.box.mu))
    about = f"trained in lambda {lam} and mu {mu} on {options.grid} x {options.grid} points"
    console.print(about, soft_wrap=True, markup=False)
    try:
        with watch.stage("greedy"), session.progress(TaskProgressColumn()) as bar:
            certified = build_certified(trainer, tolerance, state, _saver(bar, trainer, file, SHARE * tolerance))
        training = dict(certified.training)
        if options.validation:
            with watch.stage("validation"):
                training["validation"] = asdict(validate(trainer, certified, options.validation))
    finally:
        trainer.destroy()
    certified = replace(certified, training=training)
    save_certified(certified, file)  # before an estimate, which may fail
    places = list(dict.fromkeys(trainer.parameters[r["at"]] for r in training["rounds"]))[:PLACES]
    with watch.stage("mesh"):
        certified, unknown = _with_mesh(certified, model, places)
    save_certified(certified, file)
    with watch.stage("tests"):
        check = check_box(model, certified)
    result = certify_result(model, certified, check, watch)

    def page() -> Page:
        drawn: list[Path] = []
        if session.pictures:
            from softgrasp.study.reduce.certified.plots import draw  # brings Matplotlib

            drawn = draw(session.out, certified, check, tolerance)
        return compose(certified, check, result, unknown, drawn, file)

    session.write(scene, result, page)
    return result


def _with_mesh(certified: CertifiedModel, model: Model, places: list[Materials]) -> tuple[CertifiedModel, str]:
    """The model with the estimate of its mesh, or without one and the reason. Collective."""
    try:
        return replace(certified, mesh=offline_mesh_estimate(model, places)), ""
    except SoftgraspError as error:
        return certified, f"The error of the mesh could not be estimated: {error}"


def _saver(bar: Progress, trainer: Trainer, file: Path, goal: float) -> Callable[[Greedy, CertifiedModel], None]:
    """Called after every round: says how far its largest bound is on the way to a goal, and saves at intervals."""
    task, saved = bar.add_task("greedy", total=1.0), time.monotonic()

    def after(state: Greedy, so_far: CertifiedModel) -> None:
        nonlocal saved
        if trainer.comm.bcast(time.monotonic() - saved >= PAUSE):
            save_certified(so_far, file)
            saved = time.monotonic()
        bounds = [r.bound for r in state.rounds if np.isfinite(r.bound)]
        if bounds and bounds[-1] < bounds[0]:
            share = np.log(bounds[0] / bounds[-1]) / np.log(bounds[0] / min(goal, bounds[-1] * 0.999))
            bar.update(task, completed=float(min(share, 0.99)))
        r, (lam, mu) = state.rounds[-1], trainer.points[state.rounds[-1].worst]
        bar.console.print(
            f"round {len(state.rounds)}: k = {r.k}, largest bound {shown(r.bound)} at ({lam:.3g}, {mu:.3g}), "
            f"{r.evaluations} evaluations, {r.seconds:.1f} s",
            markup=False,
        )

    return after


def _earlier(model: Model, file: Path) -> CertifiedModel | None:
    """An interrupted or coarser training of the same scene, if the folder has one. Collective."""
    if not model.system.layout.comm.bcast(file.exists()):
        return None
    try:
        old = load_certified(file, model.system.layout)
    except ModelError:
        return None
    return old if old.training.get("key") == train_key(model) and old.fine.reconstruction is not None else None


def certify_result(model: Model, certified: CertifiedModel, check: BoxCheck | None, watch: Stopwatch) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    first, comm = model.system.materials[0], model.system.layout.comm
    with watch.stage("full"):
        full = run_at(model, first.lam, first.mu)
    run = certified.run(allow=True)
    certificate, training = run.certificate, certified.training
    query = median_seconds(comm, partial(certified.run, allow=True), REPEATS)
    own = {
        **{key: getattr(certificate, key) for key in ("reduction", "proved", "effectivity_at_most", "time_step")},
        "estimate": None if certificate.estimate is None else certificate.estimate.relative,
        "mesh": None if certificate.mesh is None else certificate.mesh.largest,
        "outputs_proved": certificate.outputs.largest.tolist(),
        "outputs_error": np.abs(full.trajectory.outputs - run.trajectory.outputs).max(axis=0).tolist(),
        "sentence": certificate.sentence(),
        "reasons": certificate.reasons,
    }
    about = {
        **{key: getattr(certified, key) for key in ("k", "k2", "certify", "tolerance", "norm", "box", "mesh")},
        "N": certified.coarse.N,
        "N2": certified.fine.N,
        "own": own,
        **{key: value for key, value in training.items() if key not in ("known", "points", "key")},
    }
    return reduce_result(full, {"certified": about, "tests": check}, {**watch.seconds, "query": query})
