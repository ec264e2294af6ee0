"""What the file of a reduced model with contact holds, see :mod:`softgrasp.reduction.archive`."""

from __future__ import annotations

from typing import Any

import h5py

from softgrasp.fem.obstacles import HalfSpace, Obstacle
from softgrasp.fem.obstacles.obstacle import Path, Spline, Uniform
from softgrasp.fem.run.motion import HandTable
from softgrasp.reduction.contact.model import ContactModel, plane
from softgrasp.reduction.operators import Reconstruction

KEYS = ("N", "drag", "lag", "equilibrium", "dt", "extent", "scene_hash", "origin", "seconds")
ARRAYS = ("stiffness", "D", "G", "C", "C_s", "X", "T", "on_surface", "Phi_on_surface", "C_Phi", "kept", "fall")


def about_contact(model: ContactModel) -> dict[str, Any]:
    """Description of a model in JSON, for its file."""
    about = {key: getattr(model, key) for key in KEYS}
    obstacles = [{"name": o.name, "kind": o.kind} for o in model.obstacles]
    return about | {"names": list(model.names), "obstacles": obstacles}


def write_contact(model: ContactModel, file: h5py.File) -> None:
    """The arrays of a model that are not its columns on the mesh."""
    for key in ARRAYS:
        file[f"parts/{key}"] = getattr(model, key)
    for key in ("q", "v", "a"):
        file[f"hand/{key}"] = getattr(model.table, key)
    for i, obstacle in enumerate(model.obstacles):
        group = file.create_group(f"obstacles/{i}")
        group["normal"], group["offset"] = plane(obstacle)
        if isinstance(obstacle.path, Uniform):
            group["velocity"] = obstacle.path.velocity
        elif isinstance(obstacle.path, Spline):
            group["times"], group["coefficients"] = obstacle.path.spline.x, obstacle.path.spline.c


def read_contact(file: h5py.File, data: dict[str, Any], reconstruction: Reconstruction | None) -> ContactModel:
    """The model of an open file, with its columns on the mesh or without."""
    data.pop("N")
    on_mesh: dict[str, Any] = {}
    if reconstruction is not None:
        on_mesh = {"layout": reconstruction.layout, "V": reconstruction.L_q, "Phi": reconstruction.L_v}
    names, given = tuple(data.pop("names")), data.pop("obstacles")
    groups = [file[f"obstacles/{i}"] for i in range(len(given))]
    obstacles = tuple(
        Obstacle(**each, shape=HalfSpace(g["normal"][()], float(g["offset"][()])), path=_path(g))
        for each, g in zip(given, groups, strict=True)
    )
    return ContactModel(
        **data,
        **{key: file[f"parts/{key}"][()] for key in ARRAYS},
        obstacles=obstacles,
        table=HandTable(*(file[f"hand/{key}"][()] for key in ("q", "v", "a"))),
        names=names,
        **on_mesh,
    )


def _path(group: h5py.Group) -> Path | None:
    """Path of an obstacle, with the numbers that were written."""
    if "velocity" in group:
        return Uniform(group["velocity"][()])
    if "times" not in group:
        return None
    from scipy.interpolate import PPoly  # few files need it

    return Spline(PPoly(group["coefficients"][()], group["times"][()]))
