"""The page: matrices of a reduced model's step, shapes of its coordinates at the vertices, and how the mouse pulls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from softgrasp.fem import Array, Model, PictureMesh
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.fem.fields.picture import gather_picture, vertex_displacement
from softgrasp.fem.shown import length_unit
from softgrasp.reduction.bases.registry import METHODS
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.origin import check_origin
from softgrasp.reduction.propagator import Propagator, propagator
from softgrasp.reduction.system import ModelError
from softgrasp.study.pictures import shapes
from softgrasp.study.pictures.turning import as_text, colours, rendered

TEMPLATE = Path(__file__).with_name("pull.html")
MOST_BYTES = 20_000_000  # of the shapes in the page
FOLLOWS = 25.0  # rate at which the hand follows the mouse, per second of the clock [1/s]
FRAME = 1 / 60  # between two pictures [s]
WIDE = 0.2  # share of the body by which it may deform before the page warns of linear elasticity


def pull_page(rom: ReducedModel, model: Model, dt: float | None = None) -> str:
    """Page in which the mouse pulls the hand and the tissue follows, by the step of ``rom.at()``. Collective.

    Rank 0 gets the page, the others an empty text.

    Args:
        rom: linear reduced model that keeps the hand apart.
        model: scene that it was made of, with its mesh.
        dt: time step [s]; None: that of the scene, no longer than from one picture to the next.

    Raises ModelError: the scene differs in more than materials and motion, the hand is inside the basis, the model is
        unstable or was loaded without its basis, or the shapes are more than a page may hold.
    """
    check_origin(rom.origin, model.scene_keys, rom.name)
    small = rom.at(model.system.materials)
    if not small.stable:
        raise ModelError("an unstable model has no page to pull at; use another N or basis", rom.name)
    end = model.scene.time.end or model.scene.motion.duration
    slower = 1 / shapes.speed_up(np.array([0.0, end]))
    step = propagator(small, dt or min(end / model.scene.time.steps, FRAME / slower), driven=True)
    start = step.at.X_inverse @ small.equilibrium()[2 * small.n_s :]
    picture, page = gather_picture(model), ""
    with raise_on_all_ranks(model.system.layout.comm):  # before the shapes, which cost the work
        if picture is not None:
            _check_size(picture, 2 * small.n_s + step.size, rom.name)
    shown = shapes_of(rom, model, step)
    with raise_on_all_ranks(model.system.layout.comm):
        if picture is not None and shown is not None:
            page = _page(rom, picture, step, start, shown, slower)
    return page


def shapes_of(rom: ReducedModel, model: Model, step: Propagator) -> Array | None:
    """Displacement of the vertices relative to the hand for q_s, v_s and w = 1, (2 n_s + k, n, d). Collective."""
    k = 2 * model.system.layout.n_s
    coordinates = np.eye(rom.N)
    coordinates[k:, k:] = 0.0
    coordinates = np.hstack([coordinates[:, :k], np.vstack([np.zeros((k, step.size)), step.at.X])])
    z, _ = rom.reconstruct(step.model, coordinates)
    return vertex_displacement(model, z, np.zeros((model.system.layout.n_s, coordinates.shape[1])))


def _faces(picture: PictureMesh) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Vertices that are drawn, and the triangles in their numbers."""
    return np.unique(picture.cells if picture.dimension == 2 else picture.facets, return_inverse=True)


def _check_size(picture: PictureMesh, columns: int, name: str) -> None:
    size = 4.0 * 3 * len(_faces(picture)[0]) * columns
    if size > MOST_BYTES:
        raise ModelError(
            f"a page to pull at would hold {size / 1e6:.0f} MB of shapes, more than {MOST_BYTES / 1e6:.0f}; use a "
            "coarser mesh",
            name,
        )


def _page(rom: ReducedModel, picture: PictureMesh, step: Propagator, start: Array, shown: Array, slower: float) -> str:
    flat, d = picture.dimension == 2, picture.dimension
    used, triangles = _faces(picture)
    points = np.pad(picture.points[used], ((0, 0), (0, 3 - d)))
    U = np.pad(shown[:, used], ((0, 0), (0, 0), (0, 3 - d))).transpose(1, 2, 0)
    across = float(np.linalg.norm(np.ptp(points, axis=0)))
    (factor, unit), (place_factor, place_unit) = length_unit(WIDE / 4 * across), length_unit(across)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    data = {
        "triangles": as_text(triangles.reshape(-1, 3).astype("<u4")), "colours": as_text(colours()), "obstacles": [],
        "step": as_text(step.matrix.astype("<f8")), "shapes": as_text(U.astype("<f4")),
        "held": as_text(np.isin(used, picture.contact).astype(np.uint8)), "rest": as_text(points.astype("<f4")),
        "start": start.tolist(), "dimension": d, "hand": picture.n_s,
        "dt": step.dt, "slower": slower, "rate": FOLLOWS * slower, "factor": factor,
        "place_factor": place_factor, "unit": place_unit,
        "wide": WIDE * float(np.ptp(points, axis=0).max()), "middle": middle.tolist(),
        "radius": 1.2 * across, "near": 0.8 * across,
        "yaw": -np.pi / 2 if flat else np.radians(shapes.AZIMUTH),
        "pitch": np.pi / 2 if flat else np.radians(shapes.ELEVATION),
    }  # fmt: skip
    name = METHODS[rom.name].title if rom.name in METHODS else rom.name  # a basis of the user's own
    title = f"{name}, N = {rom.N}: displacement relative to the hand [{unit}]"
    return rendered(TEMPLATE, data, title=title, low="0", high="0", space=not flat)
