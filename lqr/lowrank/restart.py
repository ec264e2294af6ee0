"""Restart files of Newton-ADI: one file a rank, and a manifest written last that knows the SHA-256 of each."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.errors import CheckpointError, agree
from softgrasp.fem.petsc import Array
from softgrasp.fem.sealed import digest, read_arrays, read_manifest, remove_others, write_arrays, write_manifest
from softgrasp.lqr.lowrank.adi import SHARE, AdiSweep, FactorColumns
from softgrasp.lqr.lowrank.adjoint import Right
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.block import Block

FORMAT = 4


@dataclass
class Iteration:
    """What Newton's method carries from step to step."""

    gain: Right  # K_j'
    step: int = 0  # Newton steps done
    solves: int = 0  # tissue solves done
    factor: tuple[Block, Array] | None = None  # (U, signs) with R_j = U diag(signs) U', unknown before the first step
    achieved: float = np.inf  # relative Riccati residual of the last finished step
    history: list[dict[str, float]] = field(default_factory=list)  # one dictionary a solve
    seconds: dict[str, float] = field(default_factory=dict)  # time by stage


def fingerprint(plant: Plant) -> str:
    """Digest of the problem that this rank sees, to refuse a foreign restart file."""
    damping = plant.system.damping
    numbers = (plant.comm.size, plant.layout.n_e, plant.two_way, plant.drag_es, damping.alpha, damping.beta)
    matrices = (plant.system.M_ee, plant.system.K_ee, damping.matrix)
    entries = [None if A is None else A.getValuesCSR()[2] for A in matrices]
    return digest(np.array(numbers), *entries, plant.C_s, plant.C_z, plant.B, plant.M_s, plant.G, plant.B_z)


def _manifest(folder: Path) -> Path:
    return folder / "newton.json"


def save_state(folder: Path, plant: Plant, state: Iteration, sweep: AdiSweep) -> None:
    """Write everything a resumed run needs. Collective. Raises CheckpointError: the folder cannot be written."""
    keys = sorted(set.intersection(*map(set, state.history))) if state.history else []  # the last of a sweep has more
    entries: dict[str, Any] = {
        "fingerprint": np.array(fingerprint(plant)),
        "numbers": np.array([state.step, state.solves, sweep.steps]),
        "norms": np.array([state.achieved, sweep.first]),
        "widths": np.array(sweep.Z.widths),
        "Z_hand": sweep.Z.block.hand,
        "Z_tall": sweep.Z.block.tall,
        "compressed_to": np.array(sweep.Z.compressed_to),
        "appended": np.array(sweep.Z.appended),
        "history_keys": np.array(keys, dtype=str),
        "history": np.array([[entry[key] for key in keys] for entry in state.history]),
        "sweep_hand": sweep.state.hand,
        "sweep_rows": sweep.state.rows,
    }
    if state.factor is not None:
        U, signs = state.factor
        entries |= {"factor_hand": U.hand, "factor_tall": U.tall, "factor_signs": signs}
    comm = plant.comm
    name, sha256 = f"newton-solve{state.solves}-rank{comm.rank}.npz", ""
    with agree(comm):
        try:
            sha256 = write_arrays(folder / name, entries)
        except OSError as error:
            raise CheckpointError(f"{folder}: the restart file cannot be written ({error}); free the disk") from error
    files = comm.gather((name, sha256))
    with agree(comm):
        if files is not None:
            try:
                write_manifest(_manifest(folder), {"format": FORMAT, "ranks": comm.size, "files": files})
            except OSError as error:
                raise CheckpointError(f"{_manifest(folder)} cannot be written ({error}); free the disk") from error
            remove_others(folder, ["newton-*"], dict(files))


def load_state(folder: Path, plant: Plant, state: Iteration, tol: float) -> AdiSweep | None:
    """Put ``state`` back and return the sweep in progress; None without restart files. Collective.

    Raises CheckpointError: the files are damaged or belong to another problem, tolerance apart, or rank count.
    """
    comm, manifest = plant.comm, _manifest(folder)
    if not comm.bcast(manifest.exists()):
        return None
    sweep: AdiSweep | None = None
    advice = f"remove the folder {folder}"
    with agree(comm):
        entry = read_manifest(manifest, FORMAT, advice)
        foreign = f"{manifest} belongs to another control problem or rank count; {advice} or name another one"
        if entry["ranks"] != comm.size:
            raise CheckpointError(foreign)
        name, sha256 = entry["files"][comm.rank]
        data = read_arrays(folder / name, sha256, advice)
        if str(data["fingerprint"]) != fingerprint(plant):
            raise CheckpointError(foreign)
        sweep = _restore(plant, state, data, tol)
    return sweep


def _restore(plant: Plant, state: Iteration, data: dict[str, Array], tol: float) -> AdiSweep:
    state.step, state.solves, steps = (int(value) for value in data["numbers"])
    state.achieved, first = (float(value) for value in data["norms"])
    keys = [str(key) for key in data["history_keys"]]
    state.history = [dict(zip(keys, map(float, row), strict=True)) for row in data["history"]]
    if "factor_signs" in data:
        state.factor = (Block(data["factor_hand"], data["factor_tall"]), data["factor_signs"])
    Z = FactorColumns(plant, SHARE * tol * plant.scale)
    Z.hand, Z.tall = np.ascontiguousarray(data["Z_hand"]), np.ascontiguousarray(data["Z_tall"])
    Z.count, Z.compressed_to = Z.hand.shape[1], int(data["compressed_to"])
    Z.appended = int(data["appended"])
    Z.widths = [int(width) for width in data["widths"]]
    sweep = AdiSweep(Right(data["sweep_hand"], data["sweep_rows"]), Z, steps, first=first)
    state.gain = sweep.gain
    return sweep
