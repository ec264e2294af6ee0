"""Restart files: one file of arrays a rank, and a manifest, written last, with the SHA-256 of each."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.checksums import (
    AGAIN,
    digest,
    read_arrays,
    read_manifest,
    remove_others,
    write_arrays,
    write_manifest,
)
from softgrasp.fem.errors import CheckpointError, raise_on_all_ranks, shortened
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.shown import counted

FORMAT = 8
FRICTION = 6  # form of the sets of friction in them
CONTACT = 5  # form of what contact carries on
ITERATIONS = 2  # form of the iterations of steps at finite strain or in a frame
COMPILED = "compiled contact"
FREE_OUTPUT = ("fields", "frames", "checkpoint_every", "memory")  # keys of [output] that change no number of a run
FREE = ("name", "description", "reduction", "study")
OLD = ("*step*-rank*", "*frame*.npz")  # patterns of the files that a new manifest makes useless


@dataclass(frozen=True)
class RestartState:
    """State of a run from which it continues bit by bit: this rank's share of its arrays, and a few numbers."""

    run: str  # name of the run
    step: int  # number n of the last step [1]
    legs: list[int]  # numbers of the steps at which the run was started and resumed
    beside: dict[str, str]  # SHA-256 of each further file of the folder by its name; rank 0's is written
    state: Array  # state [z; v_z] of this rank's nodes, (2 n_local,) [m; m/s]
    low: Array  # what z lacks of the sum of its steps, like r [m], see `softgrasp.fem.run.displacement`
    r: Array  # right-hand side of the next step, (n_local,) [N]
    pending: Array  # coefficients of the load that ``r`` lacks, (n_s,)
    hand_q: Array  # displacement of the hand so far, (n + 1, n_s) [m, rad]
    hand_v: Array  # velocity of the hand so far, (n + 1, n_s) [m/s, rad/s]
    outputs: Array  # this rank's share of the outputs so far, (n + 1, components) [m, rad]
    snapshots: Array  # stored states of this rank's nodes, one a column
    loads: Array  # coefficients c of the load G c of each step so far, (n, n_s)
    pulls: Array  # products G'w of each step so far, (n + 1, n_s or 2 n_s); c'G'w is half the work of the load
    energies: Array  # dissipated energy, and that at the start, (2,) [J]
    residual_first: float  # relative residual of the first solve [1]
    taken: Array | None = None  # energy dissipated here, and work of contact, so far, (n + 1, 2) [J]; None without both
    forces: Array | None = None  # force on the hand so far, (n, n_s) [N, N m]; None where the motion is prescribed
    solver_rows: Array | None = None  # vectors kept by the iterations of finite strain or of a solver, or None
    solver_numbers: Array | None = None  # numbers kept by these iterations, or None

    def arrays(self) -> dict[str, Any]:
        """Arrays of this rank's file, by their names there."""
        names = [field.name for field in fields(self)[4:]]
        return {name: value for name in names if (value := getattr(self, name)) is not None}

    @property
    def size(self) -> int:
        """Approximate size of this rank's file [byte]."""
        return sum(np.asarray(array).nbytes for array in self.arrays().values())


def write_checkpoint(state: RestartState, scene: Scene, layout: BlockLayout, directory: Path) -> Path:
    """Write everything that a bitwise restart needs; older files are removed afterwards. Collective.

    The files carry the name of the run, so that no other run in the folder writes over one that a manifest names.

    Returns:
        The manifest file.

    Raises CheckpointError: the folder cannot be written.
    """
    comm = layout.comm
    manifest = directory / "checkpoint.json"
    name, sha256 = f"{state.run}-step{state.step}-rank{comm.rank}.npz", ""
    with raise_on_all_ranks(comm):
        try:
            sha256 = write_arrays(directory / name, {"numbering": _numbering(layout), **state.arrays()})
        except OSError as error:
            raise CheckpointError(
                f"{directory}: the restart file cannot be written ({error}); free the disk"
            ) from error
    files = comm.gather((name, sha256))
    with raise_on_all_ranks(comm):
        if files is not None:
            _write_manifest(state, scene, manifest, files)
    return manifest


def _write_manifest(state: RestartState, scene: Scene, manifest: Path, files: list[tuple[str, str]]) -> None:
    """Put the new manifest in place of the old one and remove older states. Rank 0 only."""
    entry = {
        "format": FORMAT,
        "run": state.run,
        "scene_hash": _numbers_hash(scene),
        "scene": scene.model_dump(mode="json", by_alias=True),
        "ranks": len(files),
        "step": state.step,
        "legs": state.legs,
        "files": files,
        "beside": state.beside,
        **_forms(scene),
    }
    try:
        write_manifest(manifest, entry)
    except OSError as error:
        raise CheckpointError(f"{manifest} cannot be written ({error}); free the disk") from error
    remove_others(manifest.parent, OLD, [*dict(files), *state.beside])


def read_checkpoint(scene: Scene, layout: BlockLayout, directory: Path) -> RestartState:
    """State that a stopped run of this scene has written. Collective.

    Raises:
        CheckpointError: no restart file, a damaged one, or one of another scene, rank count, mesh numbering or format.
    """
    with raise_on_all_ranks(layout.comm):
        manifest = directory / "checkpoint.json"
        entry = _fitting(scene, layout.comm.size, manifest, read_manifest(manifest, FORMAT))
        name, sha256 = entry["files"][layout.comm.rank]
        arrays: dict[str, Any] = dict(read_arrays(directory / name, sha256))
        if not np.array_equal(arrays.pop("numbering"), _numbering(layout)):
            raise CheckpointError(
                f"{directory / name} was written with other nodes on rank {layout.comm.rank}, as another version of "
                f"DOLFINx distributes them; {AGAIN}"
            )
        arrays["residual_first"] = float(arrays["residual_first"])
        return RestartState(entry["run"], entry["step"], entry["legs"], entry["beside"], **arrays)


def check_ranks(comm: MPI.Intracomm, directory: Path) -> None:
    """Refuse before anything is built what :func:`read_checkpoint` would refuse after it. Collective.

    Raises CheckpointError: no restart file, a damaged one, or one of another rank count.
    """
    with raise_on_all_ranks(comm):
        if comm.rank == 0:
            manifest = directory / "checkpoint.json"
            _same_ranks(manifest, read_manifest(manifest, FORMAT), comm.size)


def _same_ranks(manifest: Path, entry: dict[str, Any], ranks: int) -> None:
    if entry["ranks"] != ranks:
        raise CheckpointError(
            f"{manifest} was written on {counted(entry['ranks'], 'rank')}, this run has {ranks}; resume with "
            f"mpiexec -n {entry['ranks']}, or run again without --resume"
        )


def _fitting(scene: Scene, ranks: int, manifest: Path, entry: dict[str, Any]) -> dict[str, Any]:
    """The manifest's entry if it is of this scene and rank count.

    Raises CheckpointError: it is not; the message names the key.
    """
    _same_ranks(manifest, entry, ranks)
    if entry["scene_hash"] == _numbers_hash(scene):
        for name, form in _forms(scene).items():
            if name == COMPILED and entry.get(name) != form:
                raise CheckpointError(
                    f"{manifest} was written {'without' if form else 'with'} compiled contact, which this machine "
                    f"{'has' if form else 'lacks: install cffi and a C compiler there, or name one in CC'}; the two "
                    "continue with other bits: resume where the run began, or run again without --resume"
                )
            if entry.get(name) != form:
                raise CheckpointError(
                    f"{manifest} was written by another version of softgrasp, which continues "
                    f"{name} in another form; {AGAIN}"
                )
        return entry
    before, now = _flat(entry["scene"]), _flat(scene.model_dump(mode="json", by_alias=True))
    keys = [*now, *(key for key in before if key not in now)]
    for key in sorted(keys, key=lambda key: key in ("tissue.mesh", "motion.csv")):  # their contents count, not the name
        if before.get(key) != now.get(key) and not _free(key):
            raise CheckpointError(
                f"{manifest} was written with {key} = {_short(before.get(key))}, this run has {_short(now.get(key))}; "
                "resume with the same scene, or run again without --resume"
            )
    raise CheckpointError(
        f"a file that the scene names is not what it was when {manifest} was written; put the old one back, or run "
        "again without --resume"
    )


def _forms(scene: Scene) -> dict[str, int]:
    """Form of what the iterations of a run of the scene carry on, by its name in the manifest; empty without any."""
    effects = scene.effects
    rubs = bool(effects.obstacles) and any(entry.friction for entry in scene.obstacle or [])
    iterates = effects.finite_strain is not None or effects.frame is not None
    forms: dict[str, int] = ({"friction": FRICTION} if rubs else {}) | ({"iterations": ITERATIONS} if iterates else {})
    if effects.obstacles:
        from softgrasp.fem.obstacles.compiled import contact_library  # only scenes with contact pay for it

        forms |= {"contact": CONTACT, COMPILED: contact_library() is not None}
    return forms


def _numbering(layout: BlockLayout) -> Array:
    """SHA-256 of this rank's nodes in their order, 32 numbers."""
    return np.frombuffer(bytes.fromhex(digest(layout.nodes)), dtype=np.uint8).astype(np.float64)


def _numbers_hash(scene: Scene) -> str:
    """Hash of all keys that may change the numbers of a run."""
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
    return "nothing" if value is None else shortened(json.dumps(value))
