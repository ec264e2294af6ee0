"""One HDF5 file for a reduced model: small matrices, and the lift with the nodes it belongs to."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from scipy.spatial import cKDTree

from softgrasp.fem.errors import agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array
from softgrasp.fem.system import LayerMaterial
from softgrasp.reduction.model import Lift, ModelError, Outputs, ReducedModel

if TYPE_CHECKING:
    from softgrasp.reduction.strain.model import StrainModel

FORMAT = "softgrasp reduced model 1"
ROWS = 1 << 16  # rows of the lift read at a time: 30 MB for 60 columns
KEYS = (
    "name", "N", "coordinates", "frame", "structure", "fixed_solid", "split", "alpha", "in_space", "damped",
    "hand_weight", "two_way", "scene_hash", "seconds",
)  # fmt: skip


def save(model: ReducedModel | StrainModel, path: str | Path) -> None:
    """Write a reduced model to one HDF5 file, atomically. Collective when the model holds a lift.

    The file holds the small matrices in full precision, the outputs, and the lift (2 or 3 arrays of n_e x N) beside the
    coordinates of the nodes it belongs to; every rank adds its rows in turn.

    >>> import tempfile, softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> rom = sg.reduce(model, sg.simulate(model), "psd_fixed", N=14)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sg.save(rom, f"{folder}/rom.h5")
    ...     online = sg.load(f"{folder}/rom.h5")  # no mesh, no full model
    >>> online.N, online.at().stable
    (14, True)

    Args:
        model: reduced model.
        path: of the file; folders are created.

    Raises:
        OSError: the file cannot be written.
    """
    if not isinstance(model, ReducedModel):
        from softgrasp.reduction.strain.archive import save_strain  # only scenes with finite strain pay for it

        save_strain(model, path)
        return
    write_model(Path(path), model.lift, lambda part: _write_small(model, part))


def write_model(path: Path, lift: Lift | None, small: Callable[[Path], None]) -> None:
    """Write a file by ``small`` on one rank, then the rows of the lift, and rename it. Collective with a lift."""
    comm = None if lift is None else lift.layout.comm
    partial = path.with_name(path.name + ".part")
    if lift is None or comm is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        small(partial)
        partial.replace(path)
        return
    with agree(comm):
        if comm.rank == 0:
            path.parent.mkdir(parents=True, exist_ok=True)
            small(partial)
    for rank in range(comm.size):
        # one file, one writer at a time: the file library here is not a parallel one
        with agree(comm):
            if comm.rank == rank:
                _write_rows(lift, partial)
    with agree(comm):
        if comm.rank == 0:
            partial.replace(path)


def _write_small(model: ReducedModel, path: Path) -> None:
    lift = model.lift
    data: dict[str, Any] = {key: getattr(model, key) for key in KEYS}
    data["materials"] = [asdict(m) for m in model.materials]
    data["names"] = list(model.outputs.names)
    with h5py.File(path, "w") as file:
        file.attrs["format"] = FORMAT
        file.attrs["model"] = json.dumps(data)
        for key, value in model.parts.items():
            file[f"parts/{key}"] = value
        file["outputs/C_z"], file["outputs/C_s"] = model.outputs.C_z, model.outputs.C_s
        if model.gravity is not None:
            file["gravity"] = model.gravity
        if lift is not None:
            write_lift_header(file, lift)


def write_lift_header(file: h5py.File, lift: Lift) -> None:
    """Empty rows of a lift and its nodes."""
    layout, d = lift.layout, lift.layout.dimension
    file.create_dataset("lift/nodes", (layout.n_e // d, d), dtype="f8")
    for key, part in _lift_arrays(lift).items():
        file.create_dataset(f"lift/{key}", (layout.n_e, part.shape[1]), dtype="f8")


def _lift_arrays(lift: Lift) -> dict[str, Array]:
    arrays = {"L_q": lift.L_q, "L_v": lift.L_v, "W_G": lift.W_G}
    return {key: array for key, array in arrays.items() if array is not None}


def _write_rows(lift: Lift, path: Path) -> None:
    layout, d = lift.layout, lift.layout.dimension
    with h5py.File(path, "r+") as file:
        first, count = layout.start // d, layout.n_local // d
        file["lift/nodes"][first : first + count] = layout.nodes
        for key, part in _lift_arrays(lift).items():
            for at in range(0, layout.n_local, ROWS):
                rows = part[at : at + ROWS]
                file[f"lift/{key}"][layout.start + at : layout.start + at + len(rows)] = rows


def load(path: str | Path, layout: BlockLayout | None = None, scene_hash: str | None = None) -> ReducedModel:
    """Read a reduced model. Collective over ``layout.comm``; without a layout each caller reads for itself.

    Args:
        path: file of :func:`save`.
        layout: where the lift goes, by node coordinates: any rank count; None leaves the lift out (online use).
        scene_hash: refuse a model of another scene.

    Raises:
        ModelError: the file is missing, damaged, of another scene or of another mesh.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    >>> sg.save(sg.reduce(model, sg.simulate(model), "psd", N=8), "small.h5")
    >>> sg.load("small.h5").at().stable
    True
    """
    path = Path(path)
    if layout is None:
        return _read(path, None, scene_hash)
    with agree(layout.comm):
        model = _read(path, layout, scene_hash)
    return model


def _read(path: Path, layout: BlockLayout | None, scene_hash: str | None) -> ReducedModel:
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                strain = "at finite strain" in str(file.attrs.get("format"))
                advice = "softgrasp.load_strain reads it" if strain else "reduce the scene again"
                raise ModelError(f"{path} is no reduced model of this version ({FORMAT!r}); {advice}")
            data = json.loads(file.attrs["model"])
            parts = {key: value[()] for key, value in file["parts"].items()}
            outputs = Outputs(file["outputs/C_z"][()], file["outputs/C_s"][()], tuple(data.pop("names")))
            gravity = file["gravity"][()] if "gravity" in file else None
            lift = None if layout is None else read_lift(file, layout, path)
    except (OSError, KeyError, ValueError) as error:
        raise ModelError(f"{path} cannot be read as a reduced model ({error}); reduce the scene again") from error
    if scene_hash is not None and data["scene_hash"] != scene_hash:
        raise ModelError(f"{path} was made for another scene (hash {data['scene_hash'][:12]}); reduce the scene again")
    materials = tuple(LayerMaterial(**m) for m in data.pop("materials"))
    data["split"] = tuple(data.get("split", ()))
    known = {f.name for f in fields(ReducedModel)}
    return ReducedModel(
        **{key: value for key, value in data.items() if key in known},
        parts=parts,
        materials=materials,
        outputs=outputs,
        gravity=gravity,
        lift=lift,
    )


def read_lift(file: h5py.File, layout: BlockLayout, path: Path) -> Lift:
    """Rows of this rank, found by the coordinates of its nodes."""
    if "lift" not in file:
        raise ModelError(f"{path} holds no lift; load it without a layout, or reduce the scene again")
    nodes = file["lift/nodes"][()]
    d = layout.dimension
    if nodes.shape != (layout.n_e // d, d):
        raise ModelError(
            f"{path} belongs to a mesh of {len(nodes)} free nodes in {nodes.shape[1]}D, this one has "
            f"{layout.n_e // d} in {d}D; load it with its own scene"
        )
    distance, index = cKDTree(nodes).query(layout.nodes) if len(layout.nodes) else (np.zeros(0), np.zeros(0, int))
    size = float(np.ptp(nodes, axis=0).max())
    # coordinates are read back bit for bit; another partition may have computed them with other rounding
    if distance.max(initial=0.0) > 1e-9 * size or len(np.unique(index)) != len(index):
        raise ModelError(f"{path} belongs to another mesh: its nodes lie elsewhere; load it with its own scene")
    rows = (index[:, None] * d + np.arange(d)).ravel()
    arrays = {key: _pick(file[f"lift/{key}"], rows) for key in ("L_q", "L_v", "W_G") if f"lift/{key}" in file}
    return Lift(layout, arrays["L_q"], arrays["L_v"], arrays.get("W_G"))


def _pick(dataset: h5py.Dataset, rows: np.ndarray) -> Array:
    """Rows of a dataset, read slab by slab."""
    result = np.empty((len(rows), dataset.shape[1]), order="F")
    slab = rows // ROWS
    for s in np.unique(slab):
        block = dataset[s * ROWS : (s + 1) * ROWS]
        inside = np.flatnonzero(slab == s)
        result[inside] = block[rows[inside] - s * ROWS]
    return result
