"""Restart files: one file of arrays a rank, and a manifest written last that knows the SHA-256 of each."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.errors import CheckpointError, agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.petsc import Array
from softgrasp.fem.sealed import AGAIN, read_arrays, read_manifest, remove_others, write_arrays, write_manifest

if TYPE_CHECKING:
    from softgrasp.fem.run.simulate import Run
    from softgrasp.fem.scene.scene import Scene

FORMAT = 4
FREE_OUTPUT = ("fields", "frames", "checkpoint_every", "memory")  # what a run shows and keeps, not what it computes
FREE = ("name", "description", "reduction", "study")
OLD = ("*step*-rank*", "*frame*.npz")  # patterns of the files that a new manifest makes useless


def write_checkpoint(run: Run, directory: Path) -> Path:
    """Write everything that a bitwise restart needs; older files are removed afterwards. Collective.

    The files carry the name of the run, so that no other run in the folder writes over one that a manifest names.

    Returns:
        The manifest file.

    Raises:
        CheckpointError: the folder cannot be written.
    """
    comm = run.model.system.layout.comm
    manifest = directory / "checkpoint.json"
    name, sha256 = f"{run.name}-step{run.reached}-rank{comm.rank}.npz", ""
    with agree(comm):
        try:
            sha256 = _write_rank(run, directory / name)
        except OSError as error:
            raise CheckpointError(
                f"{directory}: the restart file cannot be written ({error}); free the disk"
            ) from error
    files = comm.gather((name, sha256))
    with agree(comm):
        if files is not None:
            _write_manifest(run, manifest, files)
    return manifest


def _write_manifest(run: Run, manifest: Path, files: list[tuple[str, str]]) -> None:
    """Put the new manifest in place of the old one and remove older states. Rank 0 only."""
    entry = {
        "format": FORMAT,
        "run": run.name,
        "scene_hash": _numbers_hash(run.model.scene),
        "scene": run.model.scene.model_dump(mode="json", by_alias=True),
        "ranks": run.layout.comm.size,
        "step": run.reached,
        "legs": run.legs,
        "files": files,
        "beside": run.beside,
    }
    try:
        write_manifest(manifest, entry)
    except OSError as error:
        raise CheckpointError(f"{manifest} cannot be written ({error}); free the disk") from error
    remove_others(manifest.parent, OLD, [*dict(files), *run.beside])


def restart_bytes(run: Run) -> int:
    """About what a restart file takes, of all ranks. Collective."""
    return int(run.layout.comm.allreduce(sum(np.asarray(array).nbytes for array in _arrays(run).values())))


def _write_rank(run: Run, path: Path) -> str:
    """Write this rank's file and return its SHA-256. Not collective."""
    return write_arrays(path, _arrays(run))


def _arrays(run: Run) -> dict[str, Any]:
    """What this rank needs to go on. Not collective."""
    midpoint, n = run.midpoint, run.reached
    arrays: dict[str, Any] = {
        "numbering": _numbering(run.layout),
        "state": run.state.array,
        "r": midpoint.held.leave(midpoint.r.array_r),
        "pending": midpoint.pending,
        "hand_q": run.drive.q[: n + 1],
        "hand_v": run.drive.v[: n + 1],
        "outputs": run.local_outputs[: n + 1],
        "snapshots": run.store.kept(n),
        "loads": run.drive.c[:n],
        "pulls": run.pulls[: n + 1],
        "energies": [midpoint.dissipated, run.initial_energy, run.peak_energy],
        "residual_first": run.residual_first,
    }
    if run.drive.u is not None:
        arrays["forces"] = run.drive.u[:n]
    return arrays


def read_checkpoint(run: Run, directory: Path) -> None:
    """Put a run back where it was stopped. Collective.

    Raises:
        CheckpointError: no restart file, a damaged one, or one of another scene, rank count, mesh numbering or format.
    """
    comm = run.model.system.layout.comm
    with agree(comm):
        manifest = directory / "checkpoint.json"
        entry = _fitting(run, manifest, read_manifest(manifest, FORMAT))
        name, sha256 = entry["files"][comm.rank]
        arrays = read_arrays(directory / name, sha256)
        if not np.array_equal(arrays["numbering"], _numbering(run.layout)):
            raise CheckpointError(
                f"{directory / name} was written with other nodes on rank {comm.rank}, as another version of DOLFINx "
                f"deals them out; {AGAIN}"
            )
        run.name, run.beside = entry["run"], entry["beside"]
        _restore(run, arrays, entry["step"])
        legs = [leg for leg in entry["legs"] if leg < run.reached]
        run.begun, run.legs = run.reached, [*legs, run.reached]
    for vector in (run.state.z, run.state.v, run.midpoint.r):
        vector.stateIncrease()
    run.midpoint.join(run.state)


def _fitting(run: Run, manifest: Path, entry: dict[str, Any]) -> dict[str, Any]:
    """The manifest's entry if it is of this scene and rank count. Not collective.

    Raises:
        CheckpointError: it is not; the message names the key.
    """
    comm, scene = run.model.system.layout.comm, run.model.scene
    before, now = {"ranks": entry["ranks"]}, {"ranks": comm.size}
    same = entry["scene_hash"] == _numbers_hash(scene)
    if not same:
        before, now = _flat(entry["scene"]), _flat(scene.model_dump(mode="json", by_alias=True))
    keys = [*now, *(key for key in before if key not in now)]
    for key in sorted(keys, key=lambda key: key in ("tissue.mesh", "motion.csv")):  # their contents count, not the name
        if before.get(key) != now.get(key) and not _free(key):
            raise CheckpointError(
                f"{manifest} was written with {key} = {_short(before.get(key))}, this run has {_short(now.get(key))}; "
                "resume with the same scene and rank count, or run again without --resume"
            )
    if not same:
        raise CheckpointError(
            f"a file that the scene names is not what it was when {manifest} was written; put the old one back, or run "
            "again without --resume"
        )
    return entry


def _numbering(layout: BlockLayout) -> Array:
    """SHA-256 of this rank's nodes in their order, 32 numbers. Not collective."""
    digest = hashlib.sha256(np.ascontiguousarray(layout.nodes)).digest()
    return np.frombuffer(digest, dtype=np.uint8).astype(np.float64)


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


def _restore(run: Run, arrays: dict[str, Array], step: int) -> None:
    n = step + 1
    run.store.restore(arrays["snapshots"], step, run.name)
    run.state = run.store.target(step)
    run.state.array[:] = arrays["state"]
    r, rows = arrays["r"], len(run.midpoint.r_array)
    if len(r) != rows:
        raise CheckpointError(f"the restart file holds {len(r)} rows of the right-hand side, this run {rows}; {AGAIN}")
    run.midpoint.r.array_w[:] = run.midpoint.held.enter(r)
    run.midpoint.pending = arrays["pending"]
    run.drive.q[:n] = arrays["hand_q"]
    run.drive.v[:n] = arrays["hand_v"]
    run.local_outputs[:n] = arrays["outputs"]
    run.drive.c[:step] = arrays["loads"]
    run.pulls[:n] = arrays["pulls"]
    if run.drive.u is not None:
        run.drive.u[:step] = arrays["forces"]
    run.midpoint.dissipated, run.initial_energy, run.peak_energy = (float(value) for value in arrays["energies"])
    run.residual_first = float(arrays["residual_first"])
    run.reached = step
