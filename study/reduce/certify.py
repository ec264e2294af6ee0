"""``softgrasp reduce --tolerance``: one reduced model that knows its error, built by the greedy over a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import TaskProgressColumn

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.certificate import MeshNumber
from softgrasp.reduction.certified.greedy import REASONS, Greedy
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.trainer import (
    PLACES,
    SHARE,
    Trainer,
    Validation,
    build_certified,
    mesh_number,
    state_of,
    train_key,
    validate,
)
from softgrasp.reduction.model import ModelError
from softgrasp.reduction.parameters import run_at
from softgrasp.study.reduce.certify_check import BoxCheck, check_box
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.report.page import Section
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.session import Page, Session, list_files
from softgrasp.study.shell.timing import median_seconds

FILE = "certified.h5"
REPEATS = 7  # behind the median time of a query

CAPTIONS = {
    "certified_box.png": "Relative error of the deformation over the box, in the energy norm: the proved bound, the "
    "estimate by two bases, and the truth from full runs at parameters that were not trained.",
    "certified_greedy.png": "The greedy: largest bound on its grid after every round, and where it ran the full model "
    "(numbers: rounds; a place may come again). With two bases it goes on to half the tolerance: the rest is for "
    "the small basis.",
    "certified_sizes.png": "Leading parts of the basis: bound over true error at the tests (line: median, bar: from "
    "least to largest), and largest error against the time of an answer, beside the time of a full run.",
}


def run_certify(session: Session, scene: Scene) -> dict[str, Any]:
    """Build, save and show the certified model of a scene; an interrupted run goes on from its last round. Collective.

    Raises:
        SoftgraspError: with one sentence.
    """
    model, file, console = session.model(scene), session.out / "models" / FILE, session.console
    watch, tolerance = Stopwatch(session.comm), scene.reduction.tolerance
    earlier = _earlier(model, file)
    state = None if earlier is None else state_of(earlier)
    if state is not None:
        console.print(f"going on from round {len(state.rounds)} in {file}", soft_wrap=True, markup=False)
    trainer = Trainer(model, earlier)
    count = scene.reduction.grid
    about = f"trained in lambda {_range(trainer.box.lam)} and mu {_range(trainer.box.mu)} on {count} x {count} points"
    console.print(about, soft_wrap=True, markup=False)
    with watch.stage("greedy"), session.progress(TaskProgressColumn()) as bar:
        task, goal = bar.add_task("greedy", total=1.0), SHARE * tolerance

        def after(state: Greedy, so_far: CertifiedModel) -> None:
            save_certified(so_far, file)
            bounds = [r.bound for r in state.rounds if np.isfinite(r.bound)]
            if bounds and bounds[-1] < bounds[0]:
                share = np.log(bounds[0] / bounds[-1]) / np.log(bounds[0] / min(goal, bounds[-1] * 0.999))
                bar.update(task, completed=float(min(share, 0.99)))
            r, (lam, mu) = state.rounds[-1], trainer.points[state.rounds[-1].worst]
            bar.console.print(
                f"round {len(state.rounds)}: k = {r.k}, largest bound {_shown(r.bound)} at ({lam:.3g}, {mu:.3g}), "
                f"{r.evaluations} evaluations, {r.seconds:.1f} s",
                markup=False,
            )

        certified = build_certified(trainer, tolerance, state, after)
    try:
        validation = None
        if scene.reduction.validation:
            with watch.stage("validation"):
                validation = validate(trainer, certified, scene.reduction.validation)
    finally:
        trainer.destroy()
    with watch.stage("mesh"):
        mesh = _mesh(model, trainer, certified)
    tested = {} if validation is None else {"validation": asdict(validation)}
    certified = replace(certified, mesh=mesh, training={**certified.training, **tested})
    save_certified(certified, file)
    with watch.stage("tests"):
        check = check_box(model, certified)
    result = certify_result(model, certified, check, watch)

    def page() -> Page:
        drawn: list[Path] = []
        if session.pictures:
            from softgrasp.study.reduce.certify_plots import draw  # brings Matplotlib

            drawn = draw(session.out, certified, check, tolerance)
        tables = {"greedy.csv": greedy_table(certified)}
        if check is not None:
            tables["tests.csv"] = tests_table(check)
        title, told = f"{scene.name}: certified reduced model", sentences(certified, result)[:3]
        return Page(title, told, sections(certified, result, drawn), tables, [*drawn, file])

    for sentence in sentences(certified, result):
        console.print(sentence, markup=False)
    list_files(console, session.write(scene, result, page))
    return result


def _shown(bound: float) -> str:
    return f"{bound:.1e}" if np.isfinite(bound) else "above 1"


def _range(pair: tuple[float, float]) -> str:
    return f"{pair[0]:.4g} to {pair[1]:.4g} Pa"


def _earlier(model: Model, file: Path) -> CertifiedModel | None:
    """An interrupted or coarser training of the same scene, if the folder has one. Collective."""
    if not model.system.layout.comm.bcast(file.exists()):
        return None
    try:
        old = load_certified(file, model.system.layout)
    except ModelError:
        return None
    return old if old.training.get("key") == train_key(model) and old.fine.lift is not None else None


def _mesh(model: Model, trainer: Trainer, certified: CertifiedModel) -> MeshNumber | None:
    """What is known of the mesh at some of the trained parameters; None where it has no estimate."""
    places = list(dict.fromkeys(trainer.parameters[r["at"]] for r in certified.training["rounds"]))[:PLACES]
    try:
        return mesh_number(model, places)
    except SoftgraspError:
        return None


def certify_result(model: Model, certified: CertifiedModel, check: BoxCheck | None, watch: Stopwatch) -> dict[str, Any]:
    """The keys of ``result.json``. Collective."""
    first, comm = model.system.materials[0], model.system.layout.comm
    with watch.stage("full"):
        full = run_at(model, first.lam, first.mu)
    run = certified.run(allow=True)
    assert certified.drive is not None
    query = median_seconds(comm, lambda: certified.run(allow=True), REPEATS)
    certificate, training = run.certificate, certified.training
    own = {
        "reduction": certificate.reduction,
        "proved": certificate.proved,
        "estimate": None if certificate.estimate is None else certificate.estimate.relative,
        "effectivity_at_most": certificate.effectivity_at_most,
        "time_step": certificate.time_step,
        "mesh": None if certificate.mesh is None else certificate.mesh.largest,
        "outputs_proved": certificate.outputs.largest.tolist(),
        "outputs_error": np.abs(full.trajectory.outputs - run.trajectory.outputs).max(axis=0).tolist(),
        "sentence": certificate.sentence(),
        "reasons": certificate.reasons,
    }
    about = {
        "k": certified.k,
        "N": certified.coarse.N,
        "k2": certified.k2,
        "N2": certified.fine.N,
        "certify": certified.certify,
        "tolerance": certified.tolerance,
        "norm": certified.norm,
        "box": asdict(certified.box) if certified.box is not None else None,
        "mesh": None if certified.mesh is None else asdict(certified.mesh),
        "own": own,
        **{key: value for key, value in training.items() if key not in ("known", "points", "key")},
    }
    tests = None if check is None else asdict(check)
    return reduce_result(full, {"certified": about, "tests": tests}, {**watch.seconds, "query": query})


def tests_table(check: BoxCheck) -> Table:
    """One row a size and test."""
    rows = [
        (s.k, s.k2, t.lam, t.mu, t.truth, t.estimate if np.isfinite(t.estimate) else None, t.bound, t.effectivity)
        for s in check.sizes
        for t in s.tested
    ]
    header = ("k", "k2", "lambda [Pa]", "mu [Pa]", "true error", "estimate", "bound", "bound / true error")
    return Table(header, rows, "Tests")


def greedy_table(certified: CertifiedModel) -> Table:
    """One row a round."""
    hand, points = 2 * len(certified.fine.parts["M_hand"]), certified.training["points"]
    rows = [
        (
            i + 1, *(f"{x:.4g}" for x in points[r["at"]]), r["k"], hand + 2 * r["k"], _shown(r["bound"]),
            *(f"{x:.4g}" for x in points[r["worst"]]), r["evaluations"], f"{r['seconds']:.1f}",
        )
        for i, r in enumerate(certified.training["rounds"])
    ]  # fmt: skip
    header = (
        "round", "trained at lambda [Pa]", "mu [Pa]", "k", "N", "largest bound", "at lambda [Pa]", "at mu [Pa]",
        "bounds computed", "time [s]",
    )  # fmt: skip
    return Table(header, rows, "The greedy")


def sentences(certified: CertifiedModel, result: dict[str, Any]) -> list[str]:
    """What was built and how good it is."""
    about, time = result["certified"], result["time"]
    how = "estimated" if certified.certify == "estimate" else "proved"
    share, tolerance = certified.training["proved"], about["tolerance"]
    box = f"everywhere on the grid and at {about['checked'] - len(certified.training['points'])} random parameters"
    result_line = f"The certified model has N = {about['N']} columns"
    if certified.k < certified.k2:
        result_line += f" and is measured by one of N = {about['N2']}"
    if np.isfinite(share):
        result_line += f": its error is at most {share:.1e} of the deformation {box}, {how}."
    else:
        result_line += ": in parts of the box its bound is larger than the deformation itself."
    if share > tolerance:
        result_line += f" That is above the tolerance {tolerance:g}: runs above it are refused."
    lines = [result_line, f"The greedy stopped after {len(about['rounds'])} rounds: {REASONS[about['reason']]}."]
    if added := len(about["added"]):
        lines.append(f"Of the random parameters {added} had a larger bound than the grid and were trained on too.")
    if "validation" in about:
        v = Validation(**about["validation"])
        lines.append(
            f"In {v.n} random full runs the error was at most {v.factor:.3g} times the estimate; with 95 % confidence "
            f"it is larger on at most {v.share:.1%} of the box."
        )
    lines.append(f"At the scene's own material: {about['own']['sentence']}.")
    lines += about["own"]["reasons"]
    query, full = time["query"], time["full"]
    lines.append(f"A query takes {query * 1e3:.3g} ms, a full run {full * 1e3:.3g} ms with its factor.")
    if result["tests"] is not None:
        own, count = result["tests"]["own"], len(result["tests"]["own"]["tested"])
        ratios = [t["bound"] / t["truth"] for t in own["tested"] if t["truth"]]
        true = max(t["truth"] for t in own["tested"])
        lines.append(
            f"Against {count} full runs between the corners of the box: true error at most {true:.1e}, bound "
            f"{np.median(ratios):.3g} times as large in the median, {max(ratios):.3g} at most."
        )
    if query > full:
        lines.append("A query takes longer than a full run here: the model pays on a finer mesh only.")
    return lines


def sections(certified: CertifiedModel, result: dict[str, Any], drawn: Sequence[Path] = ()) -> list[Section]:
    """Parts of the page."""
    figures = [(file, CAPTIONS[file.name]) for name in CAPTIONS for file in drawn if file.name == name]
    return [
        Section("What holds", text="\n\n".join(sentences(certified, result)), figures=figures),
        greedy_table(certified).section("Each round runs the full model where the proved bound was largest."),
    ]
