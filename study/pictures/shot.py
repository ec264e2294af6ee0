"""What every view of one move shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem import Array, PictureMesh


@dataclass(frozen=True)
class Shot:
    """What every view of one move shares."""

    picture: PictureMesh  # the body
    states: Array  # absolute vertex displacements at the instants, shape (k, n, d) [m]
    times: Array  # instants, shape (k,) [s]
    hands: Array  # hand coordinates at the instants, shape (k, n_s)
    tractions: Array | None  # traction of contact on the vertices at the instants, shape (k, n, d) [Pa], if any
    pressure: float  # largest length of a traction at any instant of the move [Pa]
    room: Array  # corners of the scene in space without obstacles, (2, d) [m]
    path: Array  # where the grip of the hand passes, shape (steps, d) [m]
    norm: Any  # scale of the colours [unit]; from 0 to 0 when nothing deforms
    unit: tuple[float, str]  # factor and name of the unit of the colours
    low: Array  # lower corner of the scene in the plane of the picture, (2,) [m]
    high: Array  # upper corner of the scene in the plane of the picture, (2,) [m]
    hand: list[Array]  # polygons of the hand where it starts, each (corners, d); empty in 3D
    edges: Any  # outline and interfaces of layers in 2D, shape (m, 2); empty in 3D
    aim: list[Array]  # closed lines around the body at the target in the plane of the picture, each (k, 2) [m]

    def values(self, displacement: Array, q_s: Array) -> Array:
        """|u - R q_s| at the vertices in the unit of the colour bar, shape (n,)."""
        return np.asarray(self.unit[0] * np.linalg.norm(displacement - self.picture.rigid(q_s), axis=1))
