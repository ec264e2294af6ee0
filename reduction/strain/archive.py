"""One HDF5 file for a reduced model at finite strain: sampled cells, small matrices, and the lift with its nodes."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from softgrasp.fem.errors import agree
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.system import LayerMaterial
from softgrasp.reduction.archive import read_lift, write_lift_header, write_model
from softgrasp.reduction.model import Lift, ModelError, Outputs
from softgrasp.reduction.strain.cells import Cells
from softgrasp.reduction.strain.model import Box, StrainModel

FORMAT = "softgrasp reduced model at finite strain 1"
KEYS = ("cells_full", "alpha", "in_space", "tau", "residual", "error_galerkin", "scene_hash", "seconds")
ARRAYS = {
    "cells": ("B", "weight", "xi", "layer", "cell", "centre"),
    "box": ("lam", "mu", "load", "reach"),
    "parts": ("K_mu", "K_lambda", "G"),
    "outputs": ("C_z", "C_s"),
}


def save_strain(model: StrainModel, path: str | Path) -> None:
    """Write a reduced model at finite strain to one HDF5 file, atomically. Collective when it holds a lift.

    Raises:
        OSError: the file cannot be written.
    """
    lift = None
    if model.Phi is not None and model.layout is not None:
        lift = Lift(model.layout, model.Phi, model.Phi[:, :0])

    def small(part: Path) -> None:
        data: dict[str, Any] = {key: getattr(model, key) for key in KEYS}
        data |= {"law": model.cells.law, "names": list(model.outputs.names)}
        data["materials"] = [asdict(m) for m in model.materials]
        with h5py.File(part, "w") as file:
            file.attrs["format"] = FORMAT
            file.attrs["model"] = json.dumps(data)
            for group, keys in ARRAYS.items():
                source = model if group == "parts" else getattr(model, group)
                for key in keys:
                    file[f"{group}/{key}"] = getattr(source, key)
            if model.gravity is not None:
                file["gravity"] = model.gravity
            if lift is not None:
                write_lift_header(file, lift)

    write_model(Path(path), lift, small)


def load_strain(path: str | Path, layout: BlockLayout | None = None, scene_hash: str | None = None) -> StrainModel:
    """Read a reduced model at finite strain. Collective over ``layout.comm``; without a layout each caller for itself.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60", "effects.finite_strain={}"])
    >>> run = sg.simulate(model)
    >>> sg.save(sg.reduce_strain(model, run, N=10), "strain.h5")
    >>> online = sg.load_strain("strain.h5")  # no mesh, no full model
    >>> online.at(dt=0.05).run((run.q_s, run.v_s)).energy_drift < 1e-8
    True

    Args:
        path: file of :func:`softgrasp.reduction.archive.save`.
        layout: where the lift goes, by node coordinates: any rank count; None leaves the lift out (online use).
        scene_hash: refuse a model of another scene.

    Raises:
        ModelError: the file is missing, damaged, of another scene or of another mesh, or holds a linear model.
    """
    path = Path(path)
    if layout is None:
        return _read(path, None, scene_hash)
    with agree(layout.comm):
        model = _read(path, layout, scene_hash)
    return model


def _read(path: Path, layout: BlockLayout | None, scene_hash: str | None) -> StrainModel:
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise ModelError(f"{path} is no reduced model at finite strain ({FORMAT!r}); reduce the scene again")
            data = json.loads(file.attrs["model"])
            read = {group: {key: file[f"{group}/{key}"][()] for key in keys} for group, keys in ARRAYS.items()}
            gravity = file["gravity"][()] if "gravity" in file else None
            lift = None if layout is None else read_lift(file, layout, path)
        if scene_hash is not None and data["scene_hash"] != scene_hash:
            found = data["scene_hash"][:12]
            raise ModelError(f"{path} was made for another scene (hash {found}); reduce the scene again")
        return StrainModel(
            cells=Cells(law=data.pop("law"), **read["cells"]),
            materials=tuple(LayerMaterial(**m) for m in data.pop("materials")),
            outputs=Outputs(**read["outputs"], names=tuple(data.pop("names"))),
            box=Box(**read["box"]),
            gravity=gravity,
            layout=layout,
            Phi=None if lift is None else np.asarray(lift.L_q),
            **read["parts"],
            **data,
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ModelError(f"{path} cannot be read as a reduced model ({reason}); reduce the scene again") from error
