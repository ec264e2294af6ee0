"""One HDF5 file for a reduced model of any kind: small matrices, reconstruction and its nodes, SHA-256 of all of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError, no_pipe, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import MARGIN, reserve_room
from softgrasp.reduction.contact.model import ContactModel
from softgrasp.reduction.contact.parts import about_contact, read_contact, write_contact
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.operators import Reconstruction
from softgrasp.reduction.system import ModelError, Outputs
from softgrasp.reduction.turning.model import TurningModel
from softgrasp.reduction.turning.strained import TurningFiner, TurningStrainModel

if TYPE_CHECKING:
    from softgrasp.reduction.strain.model import StrainModel

LINEAR, STRAIN = "softgrasp reduced model 2", "softgrasp reduced model at finite strain 3"
TURNING = "softgrasp reduced model in the frame of the hand 1"
TURNING_STRAIN = "softgrasp reduced model at finite strain in the frame of the hand 1"
CONTACT = "softgrasp reduced model with contact 2"
# what h5py and the reading of a model raise of a file that is not whole
DAMAGE = (OSError, LookupError, TypeError, ValueError, RuntimeError, AttributeError, MemoryError)
GROUP = "reconstruction"  # of the rows on the mesh; its checksum is an attribute sha256_reconstruction
OLD_GROUP = "lift"  # its name in files of earlier versions, which stay readable
ROWS = 1 << 16  # rows of the reconstruction read at a time: 30 MB for 60 columns
# entries of a model in the JSON of its file, beside its materials and the names of its outputs
LINEAR_KEYS = (
    "name", "N", "coordinates", "frame", "structure", "fixed_solid", "split", "alpha", "in_space", "damped",
    "hand_weight", "two_way", "scene_hash", "origin", "seconds",
)  # fmt: skip
STRAIN_KEYS = (
    "cells_full", "alpha", "in_space", "tau", "residual", "error_galerkin", "scene_hash", "origin", "seconds",
)  # fmt: skip
TURNING_KEYS = (
    "name", "sizes", "alpha", "damped", "hand_weight", "two_way", "scene_hash", "origin", "seconds",
)  # fmt: skip
STRAIN_ARRAYS = {
    "cells": ("B", "weight", "xi", "layer", "cell", "centre"),
    "box": ("lam", "mu", "load", "reach"),
    "parts": ("K_mu", "K_lambda", "G"),
}
FINER_ARRAYS = ("K_mu", "K_lambda", "G", "gram")
FRAME_KEYS, FRAME_ARRAYS, PAIRS = ("sizes", "hand_weight"), ("S", "E", "M_hand", "rigid"), ("S", "E")  # with a frame
# fields whose key in a file is another word
FIELDS = {"tau": "cubature_tolerance", "residual": "cubature_residual", "reach": "largest_coordinates"}


def save(model: ReducedModel | StrainModel | TurningModel | ContactModel, path: str | Path) -> None:
    """Write a reduced model to one HDF5 file, atomically. Collective when the model has a reconstruction.

    The file has the small matrices in full precision, the outputs, and the reconstruction (2 or 3 arrays of n_e x N)
    by the coordinates of its nodes; every rank adds its rows in turn.

    >>> import tempfile, softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> rom = sg.reduce(model, sg.simulate(model), "psd_fixed", N=14)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sg.save(rom, f"{folder}/rom.h5")
    ...     online = sg.load(f"{folder}/rom.h5")  # no mesh, no full model
    >>> online.N, online.at().stable
    (14, True)

    Folders are created.

    Raises:
        ResourceError: the folder cannot be made, nothing may be written there, or the disk is full; what was there
            before stays.
    """
    if isinstance(model, ContactModel):
        reconstruction = None
        if model.V is not None and model.Phi is not None and model.layout is not None:
            reconstruction = Reconstruction(model.layout, model.V, model.Phi)
        write_model(Path(path), CONTACT, about_contact(model), reconstruction, partial(write_contact, model))
        return
    if isinstance(model, ReducedModel):
        kind, reconstruction = LINEAR, model.reconstruction
    else:
        kind, reconstruction = TURNING if isinstance(model, TurningModel) else STRAIN, None
        if isinstance(model, TurningStrainModel):
            kind = TURNING_STRAIN
        if model.Phi is not None and model.layout is not None:
            reconstruction = Reconstruction(model.layout, model.Phi, model.Phi[:, :0])
    write_model(Path(path), kind, about(model), reconstruction, partial(write_small, model))


def about(model: ReducedModel | StrainModel | TurningModel) -> dict[str, Any]:
    """Description of a model in JSON, for its file."""
    linear = isinstance(model, ReducedModel)
    keys: tuple[str, ...] = LINEAR_KEYS if linear else TURNING_KEYS if isinstance(model, TurningModel) else STRAIN_KEYS
    keys += FRAME_KEYS if isinstance(model, TurningStrainModel) else ()
    data: dict[str, Any] = {key: getattr(model, FIELDS.get(key, key)) for key in keys}
    data |= {"materials": [asdict(m) for m in model.materials], "names": list(model.outputs.names)}
    return data if isinstance(model, ReducedModel | TurningModel) else data | {"law": model.cells.law}


def write_small(model: ReducedModel | StrainModel | TurningModel, file: h5py.File) -> None:
    """The arrays of a model that are no reconstruction."""
    groups: dict[str, dict[str, Array]]
    if isinstance(model, ReducedModel):
        groups = {"parts": model.parts}
    elif isinstance(model, TurningModel):
        groups = {"parts": model.parts, "hand": {"M_hand": model.M_hand}}
    else:
        groups = {
            group: {
                key: getattr(model if group == "parts" else getattr(model, group), FIELDS.get(key, key)) for key in keys
            }
            for group, keys in STRAIN_ARRAYS.items()
        }
        if isinstance(model, TurningStrainModel):
            groups["hand"] = {key: getattr(model, key) for key in FRAME_ARRAYS}
        if model.finer is not None:
            groups["finer"] = {key: getattr(model.finer, key) for key in FINER_ARRAYS}
            if isinstance(model.finer, TurningFiner):
                groups["finer"] |= {key: getattr(model.finer, key) for key in PAIRS}
            groups["finer/cells"] = {key: getattr(model.finer.cells, key) for key in STRAIN_ARRAYS["cells"]}
    for group, arrays in groups.items():
        for key, value in arrays.items():
            file[f"{group}/{key}"] = value
    file["outputs/C_z"], file["outputs/C_s"] = model.outputs.C_z, model.outputs.C_s
    if model.gravity is not None:
        file["gravity"] = model.gravity


def load(
    path: str | Path, layout: BlockLayout | None = None, scene_hash: str | None = None
) -> ReducedModel | StrainModel | TurningModel | ContactModel:
    """Read a reduced model of any kind. Collective over ``layout.comm``; without a layout each caller for itself.

    Of a certified model it reads the larger basis alone, a model without certificate;
    :func:`softgrasp.reduction.certified.archive.load_certified` reads the whole.

    Args:
        path: file of :func:`save`.
        layout: where the reconstruction goes, by node coordinates: any rank count; None leaves it out (online use).
        scene_hash: refuse a model of another scene.

    Raises:
        ModelError: the file is missing, damaged, of another version, scene or mesh.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    >>> sg.save(sg.reduce(model, sg.simulate(model), "psd", N=8), "small.h5")
    >>> sg.load("small.h5").at().stable
    True
    """
    with reading(Path(path), layout, scene_hash) as (file, data):
        if file.attrs["format"] == CONTACT:
            return read_contact(file, data, None if layout is None else read_reconstruction(file, layout))
        if file.attrs["format"] == TURNING:
            return read_turning(file, data, layout)
        strained = file.attrs["format"] in (STRAIN, TURNING_STRAIN)
        return (read_strain if strained else read_linear)(file, data, layout)


def read_linear(file: h5py.File, data: dict[str, Any], layout: BlockLayout | None) -> ReducedModel:
    """A linear model of an open file and its :func:`about`."""
    shared, reconstruction = _read_shared(file, data), None if layout is None else read_reconstruction(file, layout)
    parts = {key: value[()] for key, value in file["parts"].items()}
    return ReducedModel(**data | shared | {"split": tuple(data["split"])}, parts=parts, reconstruction=reconstruction)


def read_strain(file: h5py.File, data: dict[str, Any], layout: BlockLayout | None) -> StrainModel:
    """The same at finite strain."""
    from softgrasp.reduction.strain.cells import Cells  # only scenes with finite strain pay for it
    from softgrasp.reduction.strain.indicator import Finer
    from softgrasp.reduction.strain.model import StrainModel, TrainingDomain

    cells, box, parts = (
        {FIELDS.get(key, key): file[f"{group}/{key}"][()] for key in keys} for group, keys in STRAIN_ARRAYS.items()
    )
    shared, law = _read_shared(file, data), data.pop("law")
    data = {FIELDS.get(key, key): value for key, value in data.items()}
    Phi = None if layout is None else np.asarray(read_reconstruction(file, layout).L_q)
    finer, frame = None, dict[str, Any]()
    made: type[StrainModel] = StrainModel
    of: type[Finer] = Finer
    more: tuple[str, ...] = FINER_ARRAYS
    if file.attrs["format"] == TURNING_STRAIN:
        made, of, more = TurningStrainModel, TurningFiner, (*FINER_ARRAYS, *PAIRS)
        frame = {key: file[f"hand/{key}"][()] for key in FRAME_ARRAYS} | {"sizes": tuple(data.pop("sizes"))}
    if "finer" in file:
        sampled = Cells(law, **{key: file[f"finer/cells/{key}"][()] for key in STRAIN_ARRAYS["cells"]})
        finer = of(sampled, **{key: file[f"finer/{key}"][()] for key in more})
    return made(
        cells=Cells(law, **cells), box=TrainingDomain(**box), **parts, **shared, **data, layout=layout, Phi=Phi,
        finer=finer, **frame,
    )  # fmt: skip


def read_turning(file: h5py.File, data: dict[str, Any], layout: BlockLayout | None) -> TurningModel:
    """The same in the frame of the hand."""
    shared, sizes = _read_shared(file, data), tuple(data.pop("sizes"))
    parts = {key: value[()] for key, value in file["parts"].items()}
    Phi = None if layout is None else np.asarray(read_reconstruction(file, layout).L_q)
    return TurningModel(
        parts=parts, M_hand=file["hand/M_hand"][()], sizes=sizes, **shared, **data, layout=layout, Phi=Phi
    )


def _read_shared(file: h5py.File, data: dict[str, Any]) -> dict[str, Any]:
    outputs = Outputs(file["outputs/C_z"][()], file["outputs/C_s"][()], tuple(data.pop("names")))
    materials = tuple(LayerMaterial(**m) for m in data.pop("materials"))
    gravity = file["gravity"][()] if "gravity" in file else None
    return {"outputs": outputs, "materials": materials, "gravity": gravity}


def write_model(
    path: Path,
    kind: str,
    about: dict[str, Any],
    reconstruction: Reconstruction | None,
    small: Callable[[h5py.File], None],
) -> None:
    """Write a file of one of these kinds beside its place and move it there whole.

    Collective with a reconstruction, whose rows every rank adds in turn; ``small`` writes the arrays.

    Raises ResourceError: as :func:`save`.
    """
    comm = MPI.COMM_SELF if reconstruction is None else reconstruction.layout.comm
    unfinished = path.with_name(path.name + ".part")
    try:
        with raise_on_all_ranks(comm):
            if comm.rank == 0:
                with _named(path):
                    path.parent.mkdir(parents=True, exist_ok=True)
                note(unfinished, path)
                # written by Python: HDF5 ends the program on a full disk
                with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
                    file.attrs["format"], file.attrs["model"] = kind, json.dumps(about)
                    small(file)
                    file.flush()
                    image = file.id.get_file_image()
                with _named(path):
                    unfinished.write_bytes(image)
        for rank in range(comm.size):
            # one file, one writer at a time: the file library here is not a parallel one
            with raise_on_all_ranks(comm):
                if reconstruction is not None and comm.rank == rank:
                    _write_rows(reconstruction, unfinished)
        with raise_on_all_ranks(comm):
            if comm.rank == 0:
                with _named(path):
                    reserve_room(unfinished, MARGIN)
                with h5py.File(unfinished, "r+") as file:
                    write_checksums(file)
                unfinished.replace(path)
    finally:  # of a file that was not written whole
        if comm.rank == 0:
            with suppress(OSError):  # its folder may be none
                unfinished.unlink()


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Raises ResourceError in place of an OSError, with the name of the file."""
    try:
        yield
    except OSError as error:
        raise ResourceError(
            f"{path} cannot be written ({error.strerror or error}); free the disk or name another file"
        ) from error


@contextmanager
def reading(
    path: Path, layout: BlockLayout | None, scene_hash: str | None = None
) -> Iterator[tuple[h5py.File, dict[str, Any]]]:
    """A file that is what was written, and its :func:`about`. Collective over ``layout.comm``, but not the block.

    Raises ModelError: the file is missing, damaged, or of another version or scene; or the block finds a key missing.
    """
    comm = MPI.COMM_SELF if layout is None else layout.comm
    with raise_on_all_ranks(comm):
        try:
            with h5py.File(no_pipe(path), "r") as file:
                if file.attrs.get("format") not in (LINEAR, STRAIN, TURNING, TURNING_STRAIN, CONTACT):
                    raise ModelError(f"{path} is no reduced model of this version; reduce the scene again")
                # one rank reads a reconstruction twice, not all of them
                for rows in (False, True) if layout is not None and comm.rank == 0 else (False,):
                    if file.attrs[_checksum(file, rows)] != _digest(file, rows):
                        raise ModelError(f"{path} is damaged: it is not what was written; reduce the scene again")
                about = json.loads(file.attrs["model"])
                if scene_hash is not None and about["scene_hash"] != scene_hash:
                    other = about["scene_hash"][:12]
                    raise ModelError(f"{path} was made for another scene (hash {other}); reduce the scene again")
                yield file, about
        except DAMAGE as error:
            reason = f"{error} is missing" if isinstance(error, KeyError) else getattr(error, "strerror", None) or error
            raise ModelError(f"{path} cannot be read as a reduced model ({reason}); reduce the scene again") from error


def write_checksums(file: h5py.File) -> None:
    """Write the hashes of all arrays of a file."""
    for rows in (False, True):
        file.attrs[_checksum(file, rows)] = _digest(file, rows)


def _group(file: h5py.File) -> str:
    """Name of the group of the reconstruction in a file of this version or an earlier one."""
    return OLD_GROUP if OLD_GROUP in file else GROUP


def _checksum(file: h5py.File, reconstruction: bool) -> str:
    """Name of the attribute with a :func:`_digest`."""
    return f"sha256_{_group(file)}" if reconstruction else "sha256"


def _digest(file: h5py.File, reconstruction: bool) -> str:
    """SHA-256 of the numbers of the reconstruction, or of all others with their attributes."""
    names, group = list[str](), _group(file)
    checksums = [_checksum(file, rows) for rows in (False, True)]
    file.visit(names.append)
    digest = hashlib.sha256()
    for name in ["/", *sorted(names)]:
        item = file[name]
        if name.startswith(group) is reconstruction:
            attributes = sorted((key, str(value)) for key, value in item.attrs.items() if key not in checksums)
            digest.update(repr((name, attributes)).encode())
            if isinstance(item, h5py.Dataset):
                digest.update(repr(item.shape).encode())
                for at in range(0, item.shape[0] if item.ndim else 1, ROWS):
                    digest.update(np.ascontiguousarray(item[at : at + ROWS] if item.ndim else item[()]))
    return digest.hexdigest()


def _write_rows(reconstruction: Reconstruction, path: Path) -> None:
    layout, d = reconstruction.layout, reconstruction.layout.dimension
    parts = {"nodes": layout.nodes, "L_q": reconstruction.L_q, "L_v": reconstruction.L_v, "W_G": reconstruction.W_G}
    size = sum(part.nbytes // max(len(part), 1) for part in parts.values() if part is not None)
    with _named(path.with_suffix("")):  # the first rank makes the datasets whole
        reserve_room(path, MARGIN + (size * layout.n_e if layout.start == 0 else 0))
    with h5py.File(path, "r+") as file:
        for key, part in parts.items():
            if part is None:
                continue
            n, start = (layout.n_e // d, layout.start // d) if key == "nodes" else (layout.n_e, layout.start)
            rows = file.require_dataset(f"{GROUP}/{key}", (n, part.shape[1]), "f8")
            for at in range(0, len(part), ROWS):
                rows[start + at : start + min(at + ROWS, len(part))] = part[at : at + ROWS]


def read_reconstruction(file: h5py.File, layout: BlockLayout) -> Reconstruction:
    """Rows of this rank, found by the coordinates of its nodes."""
    from scipy.spatial import cKDTree  # slow to import

    path, d, group = file.filename, layout.dimension, _group(file)
    if group not in file:
        raise ModelError(f"{path} has no basis on the mesh; load it without a layout, or reduce the scene again")
    nodes = file[f"{group}/nodes"][()]
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
    arrays = {key: _pick(file[f"{group}/{key}"], rows) for key in ("L_q", "L_v", "W_G") if f"{group}/{key}" in file}
    return Reconstruction(layout, arrays["L_q"], arrays["L_v"], arrays.get("W_G"))


def _pick(dataset: h5py.Dataset, rows: np.ndarray) -> Array:
    """Rows of a dataset, read slab by slab."""
    result = np.empty((len(rows), dataset.shape[1]), order="F")
    slab = rows // ROWS
    for s in np.unique(slab):
        block = dataset[s * ROWS : (s + 1) * ROWS]
        inside = np.flatnonzero(slab == s)
        result[inside] = block[rows[inside] - s * ROWS]
    return result
