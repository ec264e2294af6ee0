"""Fields of tissue in the frame of a turning hand, turned into the axes of space."""

from __future__ import annotations

from typing import Any

import numpy as np

from softgrasp.fem.frame.rotation import Pose
from softgrasp.fem.model.assembly import Discretisation
from softgrasp.fem.petsc import Array
from softgrasp.fem.system import BlockSystem


def turned_displacement(space: Discretisation, system: BlockSystem, z: Array, q_s: Array) -> Any:
    """Displacement p + (Q - I) r + Q z on the free nodes and p + (Q - I) r on the bonded ones [m]. Collective."""
    free, held = _displacements(space, system, z, np.asarray(q_s, dtype=float))
    return space.nodal(free.ravel(), held.ravel())


def turned_velocity(space: Discretisation, system: BlockSystem, z: Array, v: Array, q_s: Array, v_s: Array) -> Any:
    """Velocity p' + omega x (r + u - p) + Q z' on the free nodes, without z on the bonded ones [m/s]. Collective."""
    d, pose = space.layout.dimension, Pose.of(q_s, space.layout.dimension)
    free, held = _displacements(space, system, z, np.asarray(q_s, dtype=float))
    T, R = (x @ np.asarray(v_s, dtype=float) for x in (system.T, space.R))
    spin = np.asarray(v_s, dtype=float)[d:]
    moving = pose.velocity(free, T.reshape(-1, d), v.reshape(-1, d), spin)
    led = pose.velocity(held, R.reshape(-1, d), np.zeros_like(held), spin)
    return space.nodal(moving.ravel(), led.ravel())


def _displacements(space: Discretisation, system: BlockSystem, z: Array, q_s: Array) -> tuple[Array, Array]:
    """World displacements of the free nodes and of the owned nodes as if bonded, (n, d) each [m]."""
    d, pose = space.layout.dimension, Pose.of(q_s, space.layout.dimension)
    T, R = (x @ q_s for x in (system.T, space.R))
    return pose.displacement(T.reshape(-1, d), z.reshape(-1, d)), pose.rigid(R.reshape(-1, d))
