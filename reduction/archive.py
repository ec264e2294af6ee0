"""One HDF5 file for a reduced model: small matrices, and the lift with the nodes it belongs to."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.system import LayerMaterial
from softgrasp.reduction.files import LINEAR, STRAIN, read_lift, reading, write_model
from softgrasp.reduction.model import Outputs, ReducedModel

if TYPE_CHECKING:
    from softgrasp.reduction.strain.model import StrainModel

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
    if isinstance(model, ReducedModel):
        write_model(Path(path), LINEAR, about(model), model.lift, lambda file: write_small(model, file))
    else:
        from softgrasp.reduction.strain.archive import save_strain  # only scenes with finite strain pay for it

        save_strain(model, Path(path))


def about(model: ReducedModel) -> dict[str, Any]:
    """What a file says of a linear model in JSON."""
    data: dict[str, Any] = {key: getattr(model, key) for key in KEYS}
    return data | {"materials": [asdict(m) for m in model.materials], "names": list(model.outputs.names)}


def write_small(model: ReducedModel, file: h5py.File) -> None:
    """The arrays of a linear model that are no lift."""
    for key, value in model.parts.items():
        file[f"parts/{key}"] = value
    file["outputs/C_z"], file["outputs/C_s"] = model.outputs.C_z, model.outputs.C_s
    if model.gravity is not None:
        file["gravity"] = model.gravity


def load(
    path: str | Path, layout: BlockLayout | None = None, scene_hash: str | None = None
) -> ReducedModel | StrainModel:
    """Read a reduced model of either kind. Collective over ``layout.comm``; without a layout each caller for itself.

    Args:
        path: file of :func:`save`.
        layout: where the lift goes, by node coordinates: any rank count; None leaves the lift out (online use).
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
        if file.attrs["format"] == STRAIN:
            from softgrasp.reduction.strain.archive import read_strain

            return read_strain(file, data, layout)
        return read_linear(file, data, layout)


def read_linear(file: h5py.File, data: dict[str, Any], layout: BlockLayout | None) -> ReducedModel:
    """A linear model of an open file and its :func:`about`."""
    names, materials = tuple(data.pop("names")), tuple(LayerMaterial(**m) for m in data.pop("materials"))
    return ReducedModel(
        **data | {"split": tuple(data["split"])},
        parts={key: value[()] for key, value in file["parts"].items()},
        materials=materials,
        outputs=Outputs(file["outputs/C_z"][()], file["outputs/C_s"][()], names),
        gravity=file["gravity"][()] if "gravity" in file else None,
        lift=None if layout is None else read_lift(file, layout),
    )
