"""What a file of a reduced model at finite strain holds: sampled cells, small matrices, and the lift with its nodes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.system import LayerMaterial
from softgrasp.reduction.files import STRAIN, read_lift, write_model
from softgrasp.reduction.model import Lift, Outputs
from softgrasp.reduction.strain.cells import Cells
from softgrasp.reduction.strain.model import StrainModel, TrainedBox

KEYS = ("cells_full", "alpha", "in_space", "tau", "residual", "error_galerkin", "scene_hash", "seconds")
ARRAYS = {
    "cells": ("B", "weight", "xi", "layer", "cell", "centre"),
    "box": ("lam", "mu", "load", "reach"),
    "parts": ("K_mu", "K_lambda", "G"),
    "outputs": ("C_z", "C_s"),
}


def save_strain(model: StrainModel, path: Path) -> None:
    """See :func:`softgrasp.reduction.archive.save`."""
    lift = None
    if model.Phi is not None and model.layout is not None:
        lift = Lift(model.layout, model.Phi, model.Phi[:, :0])
    data: dict[str, Any] = {key: getattr(model, key) for key in KEYS}
    data |= {"law": model.cells.law, "names": list(model.outputs.names)}
    data["materials"] = [asdict(m) for m in model.materials]

    def small(file: h5py.File) -> None:
        for group, keys in ARRAYS.items():
            source = model if group == "parts" else getattr(model, group)
            for key in keys:
                file[f"{group}/{key}"] = getattr(source, key)
        if model.gravity is not None:
            file["gravity"] = model.gravity

    write_model(path, STRAIN, data, lift, small)


def read_strain(file: h5py.File, data: dict[str, Any], layout: BlockLayout | None) -> StrainModel:
    """The model of an open file and what it says in JSON."""
    read = {group: {key: file[f"{group}/{key}"][()] for key in keys} for group, keys in ARRAYS.items()}
    return StrainModel(
        cells=Cells(law=data.pop("law"), **read["cells"]),
        materials=tuple(LayerMaterial(**m) for m in data.pop("materials")),
        outputs=Outputs(**read["outputs"], names=tuple(data.pop("names"))),
        box=TrainedBox(**read["box"]),
        gravity=file["gravity"][()] if "gravity" in file else None,
        layout=layout,
        Phi=None if layout is None else np.asarray(read_lift(file, layout).L_q),
        **read["parts"],
        **data,
    )
