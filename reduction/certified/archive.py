"""One HDF5 file for a certified model: a reduced model's own file, the triangles and the box.

:func:`softgrasp.reduction.archive.load` reads the reduced model in it too, which then answers without a certificate.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import Profile
from softgrasp.reduction.archive import CONTACT, LINEAR, about, read_linear, reading, write_model, write_small
from softgrasp.reduction.certified.certificate import OfflineMeshEstimate
from softgrasp.reduction.certified.dual import OutputDuals
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.reduction.certified.motion import Drive
from softgrasp.reduction.certified.oscillators import SecondOrder
from softgrasp.reduction.certified.residual import ResidualNorms
from softgrasp.reduction.system import ModelError

FORMAT = "softgrasp certified model 3"
GROUP = "certificate"


def save_certified(model: CertifiedModel, path: str | Path) -> None:
    """Write a certified model to one HDF5 file, atomically. Collective when it has a reconstruction.

    Raises:
        OSError: the file cannot be written.
    """

    def small(file: h5py.File) -> None:
        write_small(model.fine, file)
        _write(model, file.create_group(GROUP))

    write_model(Path(path), LINEAR, about(model.fine), model.fine.reconstruction, small)


def _write(model: CertifiedModel, group: h5py.Group) -> None:
    norms, mesh, box = model.norms, model.mesh, model.box
    data = {
        "k": model.k,
        "certify": model.certify,
        "tolerance": model.tolerance,
        "norm": model.norm,
        "box": None if box is None else {"lam": box.lam, "mu": box.mu, "apart": box.independent_layers},
        "mesh": None if mesh is None else asdict(mesh),
        "reference": [asdict(m) for m in norms.reference],
        "n_s": norms.n_s,
        "dimension": norms.dimension,
        "omega": norms.omega,
        "training": model.training,
    }
    group.attrs["format"] = FORMAT
    group["about"] = np.frombuffer(json.dumps(data).encode(), dtype=np.uint8)  # attributes end at 64 kB
    group["static"], group["mass"], group["compliance"] = norms.static, norms.mass, model.compliance
    if model.duals is not None:
        for key in ("K_mu", "K_lambda", "M", "G"):
            group[f"duals/{key}"] = getattr(model.duals.blocks, key)
        group["duals/C"], group["duals/triangle"] = model.duals.C, model.duals.triangle
    drive, name = model.drive, "drive"
    while drive is not None:
        part = group.create_group(name)
        part.attrs["dt"], part.attrs["start"] = drive.dt, drive.start
        if drive.hand is not None:
            part["q_s"], part["v_s"] = drive.hand
        if drive.force is not None:
            part["force"] = drive.force
        if drive.profile is not None:
            _write_profile(drive.profile, part.create_group("profile"))
        drive, name = drive.finer, "finer"


def _write_profile(profile: Profile, part: h5py.Group) -> None:
    for key in ("drive", "end", "duration"):
        part.attrs[key] = getattr(profile, key)
    part["target"] = profile.target
    if profile.table is not None:
        part["times"], part["values"] = profile.table


def load_certified(path: str | Path, layout: BlockLayout | None = None) -> CertifiedModel:
    """Read a certified model. Collective over ``layout.comm``; without a layout each caller reads for itself.

    Args:
        path: file of :func:`save_certified`.
        layout: where the reconstruction goes, see :func:`softgrasp.reduction.archive.load`; None leaves it out: runs do
            without.

    Raises:
        ModelError: the file is missing, damaged, without a certificate, or of another mesh.
    """
    with reading(Path(path), layout) as (file, data):
        if file.attrs["format"] == CONTACT:
            raise ModelError(
                f"{path} has contact, which no certificate covers; run it in Python by sg.load, or reduce the scene "
                "without effects.obstacles by softgrasp reduce SCENE --tolerance"
            )
        group = file.get(GROUP)
        if group is None or group.attrs.get("format") != FORMAT:
            raise ModelError(
                f"{path} has no certificate of this version ({FORMAT!r}); "
                "build it by softgrasp reduce SCENE --tolerance"
            )
        return CertifiedModel(read_linear(file, data, layout), **_read(group))


def _read(group: h5py.Group) -> dict[str, Any]:
    drive = None
    for name in ("finer", "drive"):
        if name in group:
            drive = _read_drive(group[name], drive)
    static, mass, compliance = (group[name][()] for name in ("static", "mass", "compliance"))
    data = json.loads(group["about"][()].tobytes())
    duals = None
    if "duals" in group:
        arrays = {key: value[()] for key, value in group["duals"].items()}
        C, triangle = arrays.pop("C"), arrays.pop("triangle")
        duals = OutputDuals(SecondOrder(**arrays), C, triangle)
    return {**_about(data, static, mass), "compliance": compliance, "drive": drive, "duals": duals}


def _about(data: dict[str, Any], static: Array, mass: Array) -> dict[str, Any]:
    reference = tuple(LayerMaterial(**m) for m in data["reference"])
    low, high = data["omega"]
    norms = ResidualNorms(static, mass, reference, data["n_s"], data["dimension"], (low, high))
    mesh, box = data["mesh"], data["box"]
    if mesh is not None:
        mesh = OfflineMeshEstimate(tuple((a, b) for a, b in mesh["places"]), tuple(mesh["estimates"]))
    if box is not None:
        box = ParameterDomain(tuple(box["lam"]), tuple(box["mu"]), box["apart"])
    kept = {key: data[key] for key in ("k", "certify", "tolerance", "norm", "training")}
    return {**kept, "norms": norms, "box": box, "mesh": mesh}


def _read_drive(part: h5py.Group, finer: Drive | None) -> Drive:
    hand = (part["q_s"][()], part["v_s"][()]) if "q_s" in part else None
    force = part["force"][()] if "force" in part else None
    profile = _read_profile(part["profile"]) if "profile" in part else None
    return Drive(float(part.attrs["dt"]), hand, force, part.attrs["start"], finer, profile)


def _read_profile(part: h5py.Group) -> Profile:
    table = (part["times"][()], part["values"][()]) if "times" in part else None
    about = part.attrs
    return Profile(about["drive"], float(about["end"]), part["target"][()], float(about["duration"]), table)
