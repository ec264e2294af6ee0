"""One HDF5 file for a certified model: a reduced model's own file, the triangles, the box, and hashes of all of it.

:func:`softgrasp.reduction.archive.load` reads the reduced model in it too, which then answers without a certificate.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, rows_on_root
from softgrasp.fem.system import LayerMaterial
from softgrasp.reduction.archive import ROWS, load, save
from softgrasp.reduction.certified.certificate import MeshNumber
from softgrasp.reduction.certified.model import Box, CertifiedModel
from softgrasp.reduction.certified.motion import Drive
from softgrasp.reduction.certified.residual import ResidualNorms
from softgrasp.reduction.model import ModelError

FORMAT = "softgrasp certified model 3"
GROUP = "certificate"


def save_certified(model: CertifiedModel, path: str | Path) -> None:
    """Write a certified model to one HDF5 file, atomically. Collective when it holds a lift.

    Raises:
        OSError: the file cannot be written.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".certified")
    lift = model.fine.lift
    comm = MPI.COMM_SELF if lift is None else lift.layout.comm
    key = "" if lift is None else mesh_key(lift.layout)
    save(model.fine, partial)
    with agree(comm):
        if comm.rank == 0:
            _append(model, partial, key)
            partial.replace(path)


def _append(model: CertifiedModel, path: Path, key: str) -> None:
    norms, mesh = model.norms, model.mesh
    about = {
        "k": model.k,
        "certify": model.certify,
        "tolerance": model.tolerance,
        "norm": model.norm,
        "box": None if model.box is None else asdict(model.box),
        "mesh": None if mesh is None else asdict(mesh),
        "mesh_key": key,
        "reference": [asdict(m) for m in norms.reference],
        "n_s": norms.n_s,
        "dimension": norms.dimension,
        "omega": norms.omega,
        "training": model.training,
    }
    with h5py.File(path, "r+") as file:
        group = file.create_group(GROUP)
        group.attrs["format"] = FORMAT
        group["about"] = np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)  # attributes end at 64 kB
        group["static"], group["mass"], group["compliance"] = norms.static, norms.mass, model.compliance
        for i, T in enumerate(norms.shape or ()):
            group[f"shape/{i}"] = T
        drive, name = model.drive, "drive"
        while drive is not None:
            part = group.create_group(name)
            part.attrs["dt"], part.attrs["start"] = drive.dt, drive.start
            if drive.hand is not None:
                part["q_s"], part["v_s"] = drive.hand
            if drive.force is not None:
                part["force"] = drive.force
            drive, name = drive.finer, "finer"
        group.attrs["sha256"] = _digest(file, lift=False)
        group.attrs["sha256_lift"] = _digest(file, lift=True)


def load_certified(path: str | Path, layout: BlockLayout | None = None) -> CertifiedModel:
    """Read a certified model. Collective over ``layout.comm``; without a layout each caller reads for itself.

    Args:
        path: file of :func:`save_certified`.
        layout: where the lift goes, see :func:`softgrasp.reduction.archive.load`; None leaves it out, which runs do
        without.

    Raises:
        ModelError: the file is missing, damaged, without a certificate, or of another mesh.
    """
    path = Path(path)
    with agree(MPI.COMM_SELF if layout is None else layout.comm):  # before the model itself, which trusts what it reads
        fields = _read(path, layout is not None)
    if layout is not None and fields.pop("mesh_key") != mesh_key(layout):
        raise ModelError(f"{path} belongs to another mesh; load it with its own scene")
    fields.pop("mesh_key", None)
    return CertifiedModel(load(path, layout), **fields)


def _read(path: Path, lift: bool) -> dict[str, Any]:
    try:
        with h5py.File(path, "r") as file:
            group = file.get(GROUP)
            if group is None or group.attrs.get("format") != FORMAT:
                raise ModelError(
                    f"{path} holds no certificate of this version ({FORMAT!r}); "
                    "build it by softgrasp reduce SCENE --tolerance"
                )
            for name in ("sha256", "sha256_lift") if lift else ("sha256",):
                if group.attrs[name] != _digest(file, lift=name != "sha256"):
                    raise ModelError(f"{path} is damaged: it is not what was written; reduce the scene again")
            about = json.loads(group["about"][()].tobytes())
            drive = None
            for name in ("finer", "drive"):
                if name in group:
                    drive = _read_drive(group[name], drive)
            shape = (group["shape/0"][()], group["shape/1"][()]) if "shape" in group else None
            static, mass, compliance = (group[name][()] for name in ("static", "mass", "compliance"))
        return {**_about(about, static, mass, shape), "compliance": compliance, "drive": drive}
    except (OSError, KeyError, TypeError, ValueError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ModelError(f"{path} cannot be read as a certified model ({reason}); reduce the scene again") from error


def _about(about: dict[str, Any], static: Array, mass: Array, shape: tuple[Array, Array] | None) -> dict[str, Any]:
    reference = tuple(LayerMaterial(**m) for m in about["reference"])
    low, high = about["omega"]
    norms = ResidualNorms(static, mass, reference, about["n_s"], about["dimension"], (low, high), shape)
    mesh, box = about["mesh"], about["box"]
    if mesh is not None:
        mesh = MeshNumber(tuple((a, b) for a, b in mesh["places"]), tuple(mesh["estimates"]))
    if box is not None:
        box = Box(tuple(box["lam"]), tuple(box["mu"]), box["apart"])
    kept = {key: about[key] for key in ("k", "certify", "tolerance", "norm", "training", "mesh_key")}
    return {**kept, "norms": norms, "box": box, "mesh": mesh}


def _read_drive(part: h5py.Group, finer: Drive | None) -> Drive:
    hand = (part["q_s"][()], part["v_s"][()]) if "q_s" in part else None
    force = part["force"][()] if "force" in part else None
    return Drive(float(part.attrs["dt"]), hand, force, part.attrs["start"], finer)


def _datasets(file: h5py.File) -> list[str]:
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    return sorted(names)


def _digest(file: h5py.File, lift: bool) -> str:
    """SHA-256 of all numbers of the lift, or of all others with what the file says about them."""
    digest = hashlib.sha256()
    if not lift:
        digest.update(file.attrs["model"].encode())
        for name in ("drive", "finer"):
            if name in file[GROUP]:
                digest.update(repr(sorted((k, str(v)) for k, v in file[f"{GROUP}/{name}"].attrs.items())).encode())
    for name in _datasets(file):
        if name.startswith("lift/") is lift:
            digest.update(f"{name} {file[name].shape}".encode())
            for block in _blocks(file[name]):
                digest.update(np.ascontiguousarray(block))
    return digest.hexdigest()


def _blocks(data: h5py.Dataset) -> Iterator[Array]:
    if data.ndim == 0:
        yield np.atleast_1d(data[()])
        return
    for at in range(0, data.shape[0], ROWS):
        yield data[at : at + ROWS]


def mesh_key(layout: BlockLayout) -> str:
    """SHA-256 of the coordinates of all free nodes, whatever their order and ranks. Collective."""
    nodes = rows_on_root(layout.comm, layout.rounded(layout.nodes) + 0.0)
    key = "" if nodes is None else hashlib.sha256(nodes[np.lexsort(nodes.T)].tobytes()).hexdigest()
    return str(layout.comm.bcast(key))
