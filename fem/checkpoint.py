"""Restart files: one HDF5 file a rank, and a manifest written last, so that a torn write is never read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from fem.errors import CheckpointError, agree
from fem.scene_file import scene_hash

if TYPE_CHECKING:
    from fem.run import Run
    from fem.scene import Scene

FORMAT = 3
FREE_OUTPUT = ("fields", "frames", "checkpoint_every", "memory")  # what a run shows and keeps, not what it computes
FREE = ("name", "description", "reduction", "study")


def _rank_file(directory: Path, step: int, rank: int) -> Path:
    return directory / f"step{step}-rank{rank}.h5"


def write_checkpoint(run: Run, directory: Path) -> Path:
    """Write everything that a bitwise restart needs; older files are removed afterwards. Collective.

    Returns:
        The manifest file.

    Raises:
        CheckpointError: the folder cannot be written.
    """
    comm = run.model.system.layout.comm
    manifest = directory / "checkpoint.json"
    with agree(comm):
        try:
            directory.mkdir(parents=True, exist_ok=True)
            _write_rank(run, _rank_file(directory, run.reached, comm.rank))
        except OSError as error:
            raise CheckpointError(
                f"{directory}: the restart file cannot be written ({error}); free the disk"
            ) from error
    with agree(comm):
        if comm.rank == 0:
            _write_manifest(run, directory, manifest)
    return manifest


def _write_manifest(run: Run, directory: Path, manifest: Path) -> None:
    """Put the new manifest in place of the old one and remove older states. Rank 0 only."""
    entry = {
        "format": FORMAT,
        "scene_hash": _numbers_hash(run.model.scene),
        "scene": run.model.scene.model_dump(mode="json", by_alias=True),
        "ranks": run.layout.comm.size,
        "step": run.reached,
        "legs": run.legs,
    }
    try:
        fresh = manifest.with_suffix(".new")
        fresh.write_text(json.dumps(entry, indent=2) + "\n")
        fresh.replace(manifest)
    except OSError as error:
        raise CheckpointError(f"{manifest} cannot be written ({error}); free the disk") from error
    for old in directory.glob("step*-rank*.h5"):
        if not old.name.startswith(f"step{run.reached}-"):
            old.unlink(missing_ok=True)


def _write_rank(run: Run, path: Path) -> None:
    midpoint, n = run.midpoint, run.reached
    with h5py.File(path, "w") as file:
        file["state"] = run.state.array
        file["r"] = midpoint.held.leave(midpoint.r.array_r)
        file["pending"] = midpoint.pending
        file["hand_q"] = run.drive.q[: n + 1]
        file["hand_v"] = run.drive.v[: n + 1]
        file["outputs"] = run.local_outputs[: n + 1]
        file["snapshots"] = run.store.kept(n)
        file["loads"] = run.drive.c[:n]
        file["pulls"] = run.pulls[: n + 1]
        if run.drive.u is not None:
            file["forces"] = run.drive.u[:n]
        file["energies"] = [midpoint.dissipated, run.initial_energy, run.peak_energy]
        file["residual_first"] = run.residual_first


def read_checkpoint(run: Run, directory: Path) -> None:
    """Put a run back where it was stopped. Collective.

    Raises:
        CheckpointError: no restart file, or one of another scene, rank count or format.
    """
    comm = run.model.system.layout.comm
    with agree(comm):
        entry = _manifest(run, directory)
        path = _rank_file(directory, entry["step"], comm.rank)
        try:
            with h5py.File(path) as file:
                _restore(run, file, entry["step"])
        except (OSError, KeyError, ValueError, TypeError) as error:
            raise CheckpointError(f"{path} is damaged ({error}); run again without --resume") from error
        legs = [leg for leg in entry["legs"] if leg < run.reached]
        run.begun, run.legs = run.reached, [*legs, run.reached]
    for vector in (run.state.z, run.state.v, run.midpoint.r):
        vector.stateIncrease()
    run.midpoint.join(run.state)


def _manifest(run: Run, directory: Path) -> dict[str, Any]:
    comm = run.model.system.layout.comm
    manifest = directory / "checkpoint.json"
    try:
        entry: dict[str, Any] = json.loads(manifest.read_text())
    except FileNotFoundError:
        raise CheckpointError(f"{manifest} does not exist; run once without --resume") from None
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{manifest} cannot be read ({error}); run again without --resume") from error
    if entry.get("format") != FORMAT:
        raise CheckpointError(
            f"{manifest} was written by another version of softgrasp (format {entry.get('format')}, this one reads "
            f"{FORMAT}); run again without --resume"
        )
    scene = run.model.scene
    found, why = {"ranks": entry.get("ranks")}, {"ranks": comm.size}
    if entry.get("scene_hash") != _numbers_hash(scene):
        found, why = _flat(entry.get("scene", {})), _flat(scene.model_dump(mode="json", by_alias=True))
    keys = [*why, *(key for key in found if key not in why)]
    for key in sorted(keys, key=lambda key: key in ("tissue.mesh", "motion.csv")):  # their contents count, not the name
        if found.get(key) != why.get(key) and not _free(key):
            raise CheckpointError(
                f"{manifest} was written with {key} = {_short(found.get(key))}, this run has {_short(why.get(key))}; "
                "resume with the same scene and rank count, or run again without --resume"
            )
    if entry.get("scene_hash") != _numbers_hash(scene):
        raise CheckpointError(
            f"a file that the scene names is not what it was when {manifest} was written; put the old one back, or run "
            "again without --resume"
        )
    return entry


def _numbers_hash(scene: Scene) -> str:
    """Hash of what may change the numbers of a run."""
    usual = type(scene.output)()
    output = scene.output.model_copy(update={key: getattr(usual, key) for key in FREE_OUTPUT})
    return scene_hash(scene.model_copy(update={"output": output}), FREE)


def _free(key: str) -> bool:
    section, _, rest = key.partition(".")
    return section in FREE or (section == "output" and rest in FREE_OUTPUT)


def _flat(value: dict[str, Any], path: str = "") -> dict[str, Any]:
    """Leaves of nested tables by their dotted keys."""
    result: dict[str, Any] = {}
    for key, item in value.items():
        result |= _flat(item, f"{path}{key}.") if isinstance(item, dict) and item else {f"{path}{key}": item}
    return result


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _restore(run: Run, file: h5py.File, step: int) -> None:
    n = step + 1
    run.store.restore(np.asarray(file["snapshots"]), step)
    run.state = run.store.target(step)
    run.state.array[:] = file["state"][:]
    r = file["r"][:]
    if r.shape != run.midpoint.r_array.shape:
        raise ValueError(f"r has {len(r)} rows, the run {len(run.midpoint.r_array)}")
    run.midpoint.r.array_w[:] = run.midpoint.held.enter(r)
    run.midpoint.pending = file["pending"][:]
    run.drive.q[:n] = file["hand_q"][:]
    run.drive.v[:n] = file["hand_v"][:]
    run.local_outputs[:n] = file["outputs"][:]
    run.drive.c[:step] = file["loads"][:]
    run.pulls[:n] = file["pulls"][:]
    if run.drive.u is not None:
        run.drive.u[:step] = file["forces"][:]
    energies = file["energies"][:]
    run.midpoint.dissipated, run.initial_energy, run.peak_energy = (float(value) for value in energies)
    run.residual_first = float(file["residual_first"][()])
    run.reached = step
