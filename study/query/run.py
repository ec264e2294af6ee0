"""``softgrasp query``: ask a certified model for new materials, motions and steps; refuse, or run the full model."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.errors import SceneError, agree
from softgrasp.fem.model.build import Model, Stopwatch, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.file import load_scene_collective
from softgrasp.reduction.certified.archive import load_certified
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import Drive, Materials
from softgrasp.study.query.answer import Answer, answer_rows, batch_table, trajectory_table
from softgrasp.study.query.asked import drive_of, materials_of, parse_settings, read_batch
from softgrasp.study.query.page import write_page
from softgrasp.study.report.origin import command_line
from softgrasp.study.report.tables import pairs
from softgrasp.study.shell.folder import claim
from softgrasp.study.shell.session import list_files, show_warnings

REFUSED = 3  # exit status
SHOWN = 20  # lines of a batch in the terminal


def run_query(
    path: Path,
    console: Console,
    *,
    settings: Sequence[str] = (),
    motion: Path | None = None,
    dt: float | None = None,
    tolerance: float | None = None,
    allow: bool = False,
    fallback: str | None = None,
    scene: Path | None = None,
    batch: Path | None = None,
    out: Path | None = None,
    folder: Path | None = None,
    empty: bool = False,
) -> int:
    """Answer a query and print it. Collective.

    Args:
        path: file of a certified model.
        console: where the answer goes.
        settings: ``lambda=77``, ``mu=60``, ``rho=1``.
        motion: CSV file of the hand's motion; None takes the model's own.
        dt: time step [s]; None takes the model's own.
        tolerance: relative; None takes the model's own.
        allow: answer above the tolerance too.
        fallback: "full" runs the full model where the answer is refused.
        scene: of the full model; None looks for the scene.toml that ``reduce`` has left beside the model.
        batch: CSV table of parameters.
        out: CSV file of the trajectory, or of the answers of a batch.
        folder: where a page of the answer goes; None: no page.
        empty: first remove what an earlier command has left in that folder.

    Returns:
        Exit status: 0, or 3 when an answer is refused.

    Raises:
        SoftgraspError: with one sentence.
    """
    if fallback not in (None, "full"):
        raise SceneError(f"--fallback {fallback}: the only model to fall back on is full")
    if tolerance is not None and not tolerance > 0:
        raise SceneError(f"--tolerance {tolerance:g}: the largest relative error must be positive, for example 1e-2")
    if out is not None and (out.is_dir() or not out.absolute().parent.is_dir()):
        why = "it is a folder" if out.is_dir() else f"there is no folder {out.parent}"
        raise SceneError(f"--csv {out}: {why}; name a file in a folder that is there")
    own = parse_settings(settings)
    asked = [own] if batch is None else [{**own, **row} for row in read_batch(batch)]
    if not h5py.is_hdf5(path):
        what = "is no HDF5 file" if path.is_file() else "is a folder" if path.is_dir() else "is not there"
        raise SceneError(f"{path} {what}; name the certified model that softgrasp reduce SCENE --tolerance wrote")
    model = load_certified(path)
    many = [materials_of(model, setting) for setting in asked]
    drive = drive_of(model, motion, dt)
    with agree(MPI.COMM_WORLD):
        if folder is not None and MPI.COMM_WORLD.rank == 0:
            claim(folder, "query", model.fine.name, path=path, empty=empty)
    console.print(_about(model, path), soft_wrap=True, markup=False)
    begin = time.perf_counter()
    runs = model.run_batch(many, drive, tolerance=tolerance)
    seconds = time.perf_counter() - begin
    answers = [
        Answer(m, run.certificate, run.trajectory if allow or run.certificate.passed else None)
        for m, run in zip(many, runs, strict=True)
    ]
    refused = [i for i, answer in enumerate(answers) if answer.run is None]
    if refused and fallback:
        full = _Full(model, path, scene, motion, drive)
        for i in refused:
            answers[i] = replace(answers[i], run=full.run(answers[i].materials))
    show = _show_one if batch is None else _show_batch
    show(console, model, answers, seconds)
    if out is not None and any(answer.run is not None for answer in answers):
        _write(model, answers, batch is not None, out)
        list_files(console, [out])
    if folder is not None:
        with agree(MPI.COMM_WORLD):
            if MPI.COMM_WORLD.rank == 0:
                given = {"motion": motion, "dt": dt, "tolerance": tolerance, "fallback": fallback, "batch": batch}
                options = [f"--{key} {shlex.quote(str(value))}" for key, value in given.items() if value is not None]
                words = "".join(f" {option}" for option in [*options, *["--allow"] * allow, f"--out {folder}"])
                line = command_line("query", path, settings, MPI.COMM_WORLD.size, words)
                list_files(console, write_page(folder, path, model, answers, seconds, line, batch is not None))
    return REFUSED if any(answer.run is None for answer in answers) else 0


def _about(model: CertifiedModel, path: Path) -> str:
    fine, box = model.fine, model.box
    modes = f"{model.k} modes" + (f", certified by {model.k2}" if model.k < model.k2 else "")
    trained = ""
    if box is not None:
        trained = f", trained for lambda {box.lam[0]:g} to {box.lam[1]:g} Pa, mu {box.mu[0]:g} to {box.mu[1]:g} Pa"
    limit = "" if model.tolerance is None else f", tolerance {model.tolerance:g}"
    return f"{path.name}: {fine.name}, {modes}{trained}{limit}"


def _show_one(console: Console, model: CertifiedModel, answers: Sequence[Answer], seconds: float) -> None:
    (answer,) = answers
    if answer.run is None:
        console.print(f"refused: {answer.refusal}", style="red", soft_wrap=True, markup=False)
    if answer.run is not None:
        rows = answer_rows(answer, model.fine.outputs.C_s)
        console.print(pairs([*rows, ("time of the reduced answer", f"{1e3 * seconds:.3g} ms")]))
    show_warnings(console, answer.warnings[answer.run is None :])


def _show_batch(console: Console, model: CertifiedModel, answers: Sequence[Answer], seconds: float) -> None:
    short = [(a.materials[0].lam, a.materials[0].mu, a.source, f"{a.certificate.reduction:.2g}") for a in answers]
    rows = [
        (f"lambda = {lam:g}, mu = {mu:g} Pa", f"{source}, error at most {error}") for lam, mu, source, error in short
    ]
    console.print(pairs(rows[:SHOWN]))
    if len(rows) > SHOWN:
        console.print(f"... and {len(rows) - SHOWN} more")
    refused, full = sum(a.run is None for a in answers), sum(a.full for a in answers)
    outside = sum(not a.certificate.inside for a in answers)
    text = f"{len(answers)} parameters in {1e3 * seconds:.3g} ms"
    text += f", {refused} refused" * bool(refused) + f", {full} by the full model" * bool(full)
    console.print(text, soft_wrap=True)
    if outside:
        lie = "1 parameter lies" if outside == 1 else f"{outside} parameters lie"
        show_warnings(console, [f"{lie} outside the box of the training; the bound holds all the same"])


def _write(model: CertifiedModel, answers: Sequence[Answer], many: bool, out: Path) -> None:
    """Collective."""
    with agree(MPI.COMM_WORLD):
        if MPI.COMM_WORLD.rank == 0:
            outputs = model.fine.outputs
            table = (
                batch_table(answers, outputs.names, outputs.C_s)
                if many
                else trajectory_table(answers[0], model.norms.dimension)
            )
            table.write_csv(out)


class _Full:
    """The full model of the scene that a certified model was made from, under the motion of a query."""

    def __init__(
        self, model: CertifiedModel, path: Path, scene: Path | None, motion: Path | None, drive: Drive
    ) -> None:
        scene = scene or next(
            (f for f in (p / "scene.toml" for p in list(path.absolute().parents)[:2]) if f.exists()), None
        )
        if scene is None:
            raise SceneError(f"--fallback full: no scene.toml beside {path}; name the scene of the model with --scene")
        end = drive.dt * drive.steps
        overrides = [f"time.steps={drive.steps}", f"time.end={end!r}", "output.snapshots='none'"]
        if motion is not None:
            kind = "motion" if drive.force is None else "force"
            overrides.append(f"motion={{profile='csv', csv='{motion.absolute()}', drive='{kind}'}}")
        self.model: Model = build(load_scene_collective(MPI.COMM_WORLD, scene, overrides), comm=MPI.COMM_WORLD)
        load_certified(path, self.model.system.layout)  # refuses another mesh

    def run(self, materials: Materials) -> Trajectory:
        """The full run at these materials. Collective."""
        system = self.model.system.with_materials(materials)
        return simulate(replace(self.model, system=system, watch=Stopwatch(system.layout.comm)))
