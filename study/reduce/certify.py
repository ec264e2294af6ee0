"""``softgrasp reduce --tolerance``: one reduced model that knows its error, built by the greedy over a box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.progress import Progress, TaskProgressColumn

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.greedy import REASONS, Greedy
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import Materials
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
from softgrasp.reduction.certified.validation import Tested, tested
from softgrasp.reduction.model import ModelError
from softgrasp.reduction.parameters import run_at
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.report.page import Section, captioned
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.session import Page, Session, list_files
from softgrasp.study.shell.timing import median_seconds

FILE = "certified.h5"
REPEATS = 7  # behind the median time of a query
TESTS, FEWER, LARGE = 5, 3, 20_000  # tests of each constant, and from so many unknowns on
SHARES = (1 / 12, 1 / 8, 1 / 6, 1 / 4, 1 / 3, 1 / 2)  # of the modes: sizes that are shown
SECOND = 3  # times as many modes in the basis that certifies, as far as there are
NEAR = 0.2  # of the model's own k: sizes that would hide it

CAPTIONS = {
    "certified_box.png": "Relative error of the deformation over the box, in the energy norm: the proved bound, the "
    "estimate by two bases, and the truth from full runs at parameters that were not trained.",
    "certified_greedy.png": "The greedy: largest bound on its grid after every round, and where it ran the full model "
    "(numbers: rounds; a place may come again). With two bases it goes on to half the tolerance: the rest is for "
    "the small basis.",
    "certified_sizes.png": "Leading parts of the basis: bound over true error at the tests (line: median, bar: from "
    "least to largest), and largest error against the time of an answer, beside the time of a full run.",
}


@dataclass(frozen=True)
class Size:
    """A certified model of k modes at all tests."""

    k: int  # k, k2: modes of the answer, and of the basis that certifies it
    k2: int
    N: int  # dimension of the answer
    query: float  # median seconds of an answer with its certificate
    tested: tuple[Tested, ...]  # one a parameter

    def largest(self, key: str) -> float:
        """Over the tests."""
        return max(float(getattr(t, key)) for t in self.tested)


@dataclass(frozen=True)
class BoxCheck:
    """A certified model and smaller ones of its basis over the box."""

    own: Size  # the model as it was built
    sizes: tuple[Size, ...]  # in the order of k, ``own`` among them
    full: float  # median seconds of a full run with its factor


def check_box(model: Model, certified: CertifiedModel) -> BoxCheck | None:
    """Full runs on a grid between the corners of the box, and every size against them. Collective.

    None where the bound is of tissue and hand together (a force on the hand, coupled both ways).
    """
    drive, reconstruction, box = certified.drive, certified.fine.reconstruction, certified.box
    if drive is None or reconstruction is None or box is None or (certified.fine.two_way and drive.hand is None):
        return None
    layout = model.system.layout
    drive, comm, Phi = replace(drive, finer=None), layout.comm, reconstruction.L_q[:, 2 * layout.n_s :]
    models = [certified.with_sizes(*sizes) for sizes in sizes_of(certified)]
    tests: list[list[Tested]] = [[] for _ in models]
    count = TESTS if layout.n_e < LARGE else FEWER
    inner = (np.arange(count) + 0.5) / count  # of the box; the training has its edges
    lam, mu = (low * (high / low) ** inner for low, high in (box.lam, box.mu))
    watch = Stopwatch(comm)
    for i, place in enumerate(product(lam.tolist(), mu.tolist())):
        with watch.stage(f"full run {i}"):
            full = run_at(model, *place)
        for part, own in zip(models, tests, strict=True):
            own.append(tested(full, part.run(full.model.system.materials, drive, allow=True), Phi[:, : part.k]))
    sizes = []
    for part, own in zip(models, tests, strict=True):
        query = median_seconds(comm, partial(part.run, allow=True), REPEATS)
        sizes.append(Size(part.k, part.k2, part.coarse.N, query, tuple(own)))
    built = next(s for s in sizes if (s.k, s.k2) == (certified.k, certified.k2))
    return BoxCheck(built, tuple(sizes), float(median(watch.seconds.values())))


def sizes_of(certified: CertifiedModel) -> list[tuple[int, int]]:
    """Pairs k, k2 that are shown: the model's own, and leading parts of its basis."""
    K = certified.k2
    pairs = {max(1, round(share * K)) for share in SHARES}
    own = {(k, min(SECOND * k, K)) for k in pairs if k < K and abs(k / certified.k - 1) > NEAR}
    return sorted({*own, (certified.k, certified.k2)})


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
    lines = [*sentences(certified, check, result), *([unknown] if unknown else [])]

    def page() -> Page:
        drawn: list[Path] = []
        if session.pictures:
            from softgrasp.study.reduce.certify_plots import draw  # brings Matplotlib

            drawn = draw(session.out, certified, check, tolerance)
        greedy = greedy_table(certified)
        parts = [
            Section("What holds", text="\n\n".join(lines), figures=captioned(drawn, CAPTIONS)),
            greedy.section("Each round runs the full model where the proved bound was largest."),
        ]
        tables = {"greedy.csv": greedy} | ({} if check is None else {"tests.csv": tests_table(check)})
        return Page(f"{scene.name}: certified reduced model", lines[:3], parts, tables, [*drawn, file])

    for sentence in lines:
        console.print(sentence, markup=False)
    list_files(console, session.write(scene, result, page))
    return result


def _with_mesh(certified: CertifiedModel, model: Model, places: list[Materials]) -> tuple[CertifiedModel, str]:
    """The model with the estimate of its mesh, or without one and the reason. Collective."""
    try:
        return replace(certified, mesh=mesh_number(model, places)), ""
    except SoftgraspError as error:
        return certified, f"The error of the mesh could not be estimated: {error}"


def _saver(bar: Progress, trainer: Trainer, file: Path, goal: float) -> Callable[[Greedy, CertifiedModel], None]:
    """Called after every round: saves the model so far, and says how far its largest bound is on the way to a goal."""
    task = bar.add_task("greedy", total=1.0)

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


def _shown(bound: float) -> str:
    return f"{bound:.1e}" if np.isfinite(bound) else "above 1"


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


def sentences(certified: CertifiedModel, check: BoxCheck | None, result: dict[str, Any]) -> list[str]:
    """What was built and how good it is."""
    about, time, share = result["certified"], result["time"], certified.training["proved"]
    lines = [f"The certified model has N = {about['N']} columns"]
    if certified.k < certified.k2:
        lines[0] += f" and is measured by one of N = {about['N2']}"
    if np.isfinite(share):
        lines[0] += (
            f": its error is at most {share:.1e} of the deformation everywhere on the grid and at "
            f"{about['checked'] - len(certified.training['points'])} random parameters, "
            f"{'estimated' if certified.certify == 'estimate' else 'proved'}."
        )
    else:
        lines[0] += ": in parts of the box its bound is larger than the deformation itself."
    if share > about["tolerance"]:
        lines[0] += f" That is above the tolerance {about['tolerance']:g}: runs above it are refused."
    lines.append(f"The greedy stopped after {len(about['rounds'])} rounds: {REASONS[about['reason']]}.")
    if added := len(about["added"]):
        lines.append(f"Of the random parameters {added} had a larger bound than the grid and were trained on too.")
    if "validation" in about:
        v = Validation(**about["validation"])
        if v.factor is not None:  # null in result.json where there is no estimate
            lines.append(
                f"In {v.n} random full runs the error was at most {v.factor:.3g} times the estimate; with 95 % "
                f"confidence it is larger on at most {v.share:.1%} of the box."
            )
    query, full = time["query"], time["full"]
    lines += [
        f"At the scene's own material: {about['own']['sentence']}.",
        *about["own"]["reasons"],
        f"A query takes {query * 1e3:.3g} ms, a full run {full * 1e3:.3g} ms with its factor.",
    ]
    if check is not None:
        ratios = [t.effectivity for t in check.own.tested if t.truth]
        lines.append(
            f"Against {len(check.own.tested)} full runs between the corners of the box: true error at most "
            f"{check.own.largest('truth'):.1e}, bound {np.median(ratios):.3g} times as large in the median, "
            f"{max(ratios):.3g} at most."
        )
    if query > full:
        lines.append("A query takes longer than a full run here: the model pays on a finer mesh only.")
    return lines
