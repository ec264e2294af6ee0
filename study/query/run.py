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

from softgrasp.fem import SceneError, Trajectory, adapt, on_root, raise_on_all_ranks, scene_keys, simulate
from softgrasp.fem.model.build import Model, Stopwatch, build
from softgrasp.fem.scene.file import load_scene, load_scene_collective, toml_value
from softgrasp.reduction import CertifiedModel, Drive, Materials, differing, load_certified, origin_of
from softgrasp.reduction.origin import MATERIAL, UNKNOWN
from softgrasp.study.query.answer import CertifiedAnswer, QueryResult
from softgrasp.study.query.page import box_text, compose, result_of
from softgrasp.study.query.request import drive_of, materials_of, parse_settings, read_batch
from softgrasp.study.report import percent
from softgrasp.study.shell import Session, folder_lock, list_files, show_warnings

REFUSED = 3  # exit status


@folder_lock()
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
    """Answer a query and print it, see ``softgrasp query --help`` for the options. Collective.

    Args:
        path: file of a certified model.
        console: where the answer goes.
        settings: ``lambda=77``, ``mu=60``, ``rho=1``.
        scene: of the full model; None looks for the scene.toml that ``reduce`` has left beside the model.
        out: CSV file of the trajectory, or of the answers of a batch.
        folder: where a page of the answer goes; None: no page.

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
    questions = [own] if batch is None else [{**own, **row} for row in read_batch(batch)]
    if not (path.is_file() and h5py.is_hdf5(path)):
        other = "is a folder" if path.is_dir() else "is a pipe" if path.exists() else "is not there"
        what = "is no HDF5 file" if path.is_file() else other
        raise SceneError(f"{path} {what}; name the certified model that softgrasp reduce SCENE --tolerance wrote")
    model = load_certified(path)
    many = [materials_of(model, setting) for setting in questions]
    with raise_on_all_ranks(MPI.COMM_WORLD):  # free memory and files differ between machines
        drive = drive_of(model, motion, dt, len(many))
    session = Session("query", path, settings, folder or Path(), console, empty=empty, writes=folder is not None)
    session.claim(model.fine.name, lambda: [file for file in (path, motion, scene, batch) if file is not None])
    modes = f"{model.k} modes" + (f", certified by {model.k2}" if model.k < model.k2 else "")
    trained = "" if model.box is None else f", trained for {box_text(model.box)}"
    limit = "" if model.tolerance is None else f", tolerance {percent(model.tolerance)}"
    console.print(f"{path.name}: {model.fine.name}, {modes}{trained}{limit}", soft_wrap=True, markup=False)
    begin = time.perf_counter()
    runs = model.run_batch(many, drive, tolerance=tolerance)
    seconds = time.perf_counter() - begin
    each = [
        CertifiedAnswer(
            m, run.certificate, run.trajectory if allow or run.certificate.passed else None, model.fine.outputs.C_s
        )
        for m, run in zip(many, runs, strict=True)
    ]
    if fallback and any(answer.run is None for answer in each):
        full = _full_model(console, model, path, scene, motion, drive)
        each = [replace(a, run=_full_run(full, a.materials)) if a.run is None else a for a in each]
    answers = QueryResult(path, model, each, seconds, batch is not None)
    given = {"motion": motion, "dt": dt, "tolerance": tolerance, "fallback": fallback, "batch": batch}
    options = [f"--{key} {shlex.quote(str(value))}" for key, value in given.items() if value is not None]
    words = "".join(f" {option}" for option in [*options, *["--allow"] * allow, f"--out {folder}"])
    session.write(None, result_of(answers), lambda: compose(answers, session, words), clock=False)
    if out is not None and any(answer.run is not None for answer in each):
        with raise_on_all_ranks(MPI.COMM_WORLD):
            if MPI.COMM_WORLD.rank == 0:
                answers.table().write_csv(out)
        list_files(console, [out])
    return REFUSED if answers.counts[0] else 0


def _full_model(
    console: Console, model: CertifiedModel, path: Path, scene: Path | None, motion: Path | None, drive: Drive
) -> Model:
    """The full model of the scene that a certified model was made from, under the motion of a query. Collective."""
    beside = (folder / "scene.toml" for folder in list(path.absolute().parents)[:2])
    scene = scene or next((file for file in beside if file.exists()), None)
    if scene is None:
        raise SceneError(f"--fallback full: no scene.toml beside {path}; name the scene of the model with --scene")
    file = scene
    keys = on_root(MPI.COMM_WORLD, lambda: origin_of(scene_keys(load_scene(file))))
    if not model.fine.origin:
        show_warnings(console, [f"{path} {UNKNOWN}"])
    elif difference := differing(model.fine.origin, keys, (MATERIAL,)):
        raise SceneError(
            f"--fallback full: the certified model was built {difference} ({scene}); name the scene that it was "
            "reduced from with --scene"
        )
    overrides = [f"time.steps={drive.steps}", f"time.end={drive.dt * drive.steps!r}", "output.snapshots='none'"]
    if motion is not None:
        kind = "motion" if drive.force is None else "force"
        table = {"profile": "csv", "csv": str(motion.absolute()), "drive": kind}
        overrides.append(f"motion={toml_value(table)}")
    # other steps and motions may need another mesh: the model is of that of its own scene
    own = load_scene_collective(MPI.COMM_WORLD, scene)
    tolerant = own.tissue.refine is not None and own.tissue.refine.tolerance is not None
    mesh = adapt.adapted_mesh(adapt.build(own, comm=MPI.COMM_WORLD, steps=False)) if tolerant else None
    full = build(load_scene_collective(MPI.COMM_WORLD, scene, overrides), comm=MPI.COMM_WORLD, mesh=mesh)
    load_certified(path, full.system.layout)  # refuses another mesh
    return full


def _full_run(full: Model, materials: Materials) -> Trajectory:
    """The full run at these materials. Collective."""
    system = full.system.with_materials(materials)
    return simulate(replace(full, system=system, watch=Stopwatch(system.layout.comm)))
