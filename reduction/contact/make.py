"""Making of reduced models with contact: V in the span of K^-1 G and modes, Phi = (K^-1 - V (V'K V)^-1 V') N' [MacN71].

A model of N columns is the part of a rich one, of many modes, that a few motions need, see `train.py`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.model.surface import Surface, node_distance
from softgrasp.fem.obstacles import HalfSpace, Obstacle, make_obstacles
from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.fem.run.contact.expected import nearest_gaps
from softgrasp.fem.run.contact.general import contact_surface
from softgrasp.fem.run.midpoint import viscosity
from softgrasp.fem.run.motion import motion_table
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.solvers import make_solver
from softgrasp.fem.solve.stiffness import static_columns, static_solver
from softgrasp.fem.system import BlockSystem, dynamic_stiffness
from softgrasp.reduction.contact.model import ContactModel, Ints, plane
from softgrasp.reduction.contact.train import Training, train
from softgrasp.reduction.origin import origin_of
from softgrasp.reduction.system import ModelError

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

PREFIX = "softgrasp_landing_"
LANDING = 0.8, 3.5, 15.0, 60.0  # s of its answers to a landing over 2 / dt, up to instant ones [1]
DEPENDENT = 1e-13  # least share of a direction of the basis in its Gram matrix, scaled [1]
MODES = 100  # of a rich model, at most
NOTHING = 1e-12  # share of static answers outside V that is rounding [1]


def contact_model(model: Model, N: int = 30, reach: float | None = None) -> ContactModel:
    """The tissue as z = V a + Phi mu, V'M V = I, with what V lacks of answers to contact mu [MacN71]. Collective.

    Args:
        model: with ``effects.obstacles`` and a hand that does not feel the tissue.
        N: number of columns of V, at most: the response to the hand, and those that a rich model needs beside it on
            the motion of the scene and on others like it.
        reach: boundary nodes, and points between them at which full runs touch, may touch if they come nearer than
            this to an obstacle while the undeformed body follows the hand of the scene [m]; None: half the distance of
            boundary nodes. Of points behind each other the foremost may. A run in which another enters an obstacle is
            refused.

    Raises:
        ModelError: the scene has other obstacles, no contact or a two-way hand, or no node comes within reach, or N has
            too little room.

    >>> import softgrasp as sg
    >>> rom = sg.contact_model(sg.build("set_down", ["tissue.cells=[6, 4]"]), N=10)
    >>> run = rom.run(*rom.motion(), rom.dt)
    >>> rom.N, bool(run.gap.min() > -1e-12)
    (10, True)
    """
    return trained(model, reach).model(N)


def trained(model: Model, reach: float | None = None) -> Training:
    """What models of any N are taken from, see :func:`contact_model`. Collective."""
    return train(rich_model(model, reach))


def rich_model(model: Model, reach: float | None = None) -> ContactModel:
    """A model of many modes, see :func:`contact_model`. Collective."""
    scene, system = model.scene, model.system
    layout, obstacles = system.layout, check_contact_scene(model)
    comm, n_s, seconds, begin = layout.comm, layout.n_s, dict[str, float](), time.perf_counter()
    surface, table, dt = (
        contact_surface(model),
        motion_table(scene, layout.n_s),
        scene.time_end / scene.time.steps,
    )
    near = node_distance(model.space) / 2 if reach is None else reach
    reached = nearest_gaps(surface, obstacles, table.q, dt, len(table.q)) < near
    kept = np.flatnonzero(reached.any(axis=0))
    if not len(kept):
        raise ModelError(f"no boundary node comes within reach = {near:.3g} m of an obstacle; give a larger reach")
    kept = foremost(surface.X, kept, obstacles, reached[:, kept], near)
    normals, which = np.unique([plane(o)[0] for o in obstacles], axis=0, return_inverse=True)
    forces = _forces(layout.n_local, surface, kept, normals)
    answers = static_columns(system, np.asfortranarray(np.hstack([system.G, forces])))
    shapes = [
        lowest_modes(system, min(MODES, layout.n_e))[1],
        *(_landing(system, surface, kept, normals, s * 2 / dt) for s in LANDING),
    ]
    V, stiffness = _diagonal(model, np.hstack([answers[:, :n_s], *shapes]))
    Phi = answers[:, n_s:] - V @ (total(comm, V.T @ forces) / stiffness[:, None])
    seconds["basis"] = time.perf_counter() - begin
    begin = time.perf_counter()
    viscous = viscosity(system, 1.0)
    D = total(comm, V.T @ times_columns(viscous, V))
    lost = times_columns(viscous, np.asfortranarray(Phi))
    viscous.destroy()
    sizes = (Phi * lost).sum(), (Phi * forces).sum(), (answers[:, n_s:] * forces).sum()
    slow, lacking, whole = total(comm, np.array(sizes))
    outputs = make_outputs(scene, system)
    y = output_columns(outputs, layout.n_local).T
    on = np.zeros((len(surface.dofs), V.shape[1] + Phi.shape[1]))
    on[surface.mine] = np.hstack([V, Phi])[surface.rows]
    on = np.column_stack([surface.at_points(x) for x in total(comm, on).T])
    rows = (which[:, None] * len(kept) + np.arange(len(kept))).ravel()  # obstacles of one normal share their answers
    on = np.hstack([on[:, : len(stiffness)], on[:, len(stiffness) + rows]])
    Phi = Phi[:, rows]
    seconds["projection"] = time.perf_counter() - begin
    return ContactModel(
        stiffness, (D + D.T) / 2, total(comm, V.T @ system.G), total(comm, y @ V), np.vstack([o.C_s for o in outputs]),
        surface.X, surface.T, on[:, : len(stiffness)], on[:, len(stiffness) :],
        total(comm, y @ Phi), slow / lacking if lacking > NOTHING * whole else 0.0, kept, obstacles, system.fall,
        system.damping.drag, scene.time.start == "equilibrium" and system.gravity is not None, table, dt, layout.extent,
        tuple(name for o in outputs for name in o.names), model.scene_hash, origin_of(model.scene_keys), seconds,
        layout, V, Phi,
    )  # fmt: skip


def check_contact_scene(model: Model) -> tuple[Obstacle, ...]:
    """The half-spaces of its scene. Raises ModelError: a contact model cannot be made of it."""
    scene = model.scene
    if not scene.effects.obstacles or scene.effects.reaction or scene.motion.drive == "force":
        raise ModelError("contact_model needs effects.obstacles, motion.drive = 'motion' and effects.reaction = false")
    if scene.effects.finite_strain is not None:
        raise ModelError("contact_model is linear; use effects.finite_strain = false for the linear law")
    if any(entry.friction for entry in scene.obstacle or []):
        raise ModelError("contact_model has no friction yet; leave out the friction of every obstacle")
    obstacles = make_obstacles(scene, model.system.layout.dimension)
    if other := [o.kind for o in obstacles if not isinstance(o.shape, HalfSpace)]:
        raise ModelError(f"contact_model keeps half-spaces, whose normals do not turn, and no {other[0]}")
    return obstacles


def foremost(
    X: Array, kept: Ints, obstacles: tuple[Obstacle, ...], reached: NDArray[np.bool_], distance: float
) -> Ints:
    """The kept points with no other one straight before them at rest, towards an obstacle that they reach.

    ``reached``: whether each comes near to each obstacle, (obstacles, kept).
    """
    first = np.zeros(len(kept), dtype=bool)
    for o, reaches in zip(obstacles, reached, strict=True):
        gap = o.gap(X[kept])
        beside = X[kept] - gap[:, None] * plane(o)[0]
        close = np.linalg.norm(beside[:, None] - beside[None], axis=2) < distance
        first |= reaches & ~((gap[None, :] < gap[:, None] - distance) & close).any(axis=1)
    return kept[first]


def _forces(n_local: int, surface: Surface, kept: Ints, normals: Array) -> Array:
    """A unit force on each point along each normal, local rows (n_local, normals x points)."""
    d, nodes = surface.X.shape[1], len(kept)
    whole = np.zeros((surface.X.size, len(normals) * nodes))
    for j, normal in enumerate(normals):
        for a, component in enumerate(normal):
            whole[kept * d + a, j * nodes + np.arange(nodes)] = component
    result = np.zeros((n_local, whole.shape[1]), order="F")
    result[surface.rows] = np.column_stack([surface.on_nodes(x) for x in whole.T])[surface.mine]
    return result


def _landing(system: BlockSystem, surface: Surface, kept: Ints, normals: Array, s: float) -> Array:
    """(K + s D + s^2 M)^-1 of the momentum of the kept nodes as the body moves along each normal. Collective."""
    layout, d = system.layout, surface.X.shape[1]
    moved = times_columns(system.M_ee, np.asfortranarray(np.tile(normals.T, (layout.n_local // d, 1))))
    there, loads = np.zeros(len(surface.dofs), dtype=bool), np.zeros_like(moved, order="F")
    at = kept if surface.B is None else surface.weights(kept)[0]
    there[(at[:, None] * d + np.arange(d)).ravel()] = True
    rows = surface.rows[there[surface.mine]]
    loads[rows] = moved[rows]
    solver = make_solver(dynamic_stiffness(system, s), static_solver(system), layout, PREFIX, rtol=1e-12)
    try:
        return solver.columns(loads, "the answer to a landing")
    finally:
        solver.destroy()


def _diagonal(model: Model, X: Array) -> tuple[Array, Array]:
    """V of the span of X with V'M V = I and V'K V diagonal, and that diagonal. Collective."""
    system, comm = model.system, model.system.layout.comm
    X = np.asfortranarray(X)
    gram = total(comm, X.T @ times_columns(system.M_ee, X))
    X = np.asfortranarray(X / np.sqrt(gram.diagonal()))
    V = X
    for share in (DEPENDENT, 0.0):  # twice, for orthonormality to rounding
        V = np.asfortranarray(V @ normalising(total(comm, V.T @ times_columns(system.M_ee, V)), share))
    K = total(comm, V.T @ times_columns(system.K_ee, V))
    stiffness, vectors = np.linalg.eigh((K + K.T) / 2)
    return np.asfortranarray(V @ vectors), stiffness
