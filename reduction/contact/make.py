"""Making of reduced models with contact: V = [K^-1 G, modes, K^-1 N', S^-1 N'm], orthonormal in the mass [CB68].

On fine meshes rows of hat functions h_j over several nodes replace those of nodes: mean gaps are >= 0. The last
columns, S = K + s D + s^2 M, answer the impulse m that stops a face landing at once. A model of N columns is the part
of a rich one of this kind that a few motions need, see `train.py`.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.model.surface import Surface, make_surface, node_distance
from softgrasp.fem.obstacles import HalfSpace, Obstacle, make_obstacles
from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.fem.run.contact.expected import nearest_gaps
from softgrasp.fem.run.midpoint import viscosity
from softgrasp.fem.run.motion import motion_table
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.solvers import make_solver
from softgrasp.fem.solve.stiffness import static_columns, static_solver
from softgrasp.fem.system import BlockSystem, dynamic_stiffness
from softgrasp.reduction.contact.hats import foremost, hat_functions
from softgrasp.reduction.contact.model import ContactModel, Ints, plane
from softgrasp.reduction.contact.train import Training, train
from softgrasp.reduction.origin import origin_of
from softgrasp.reduction.system import ModelError

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

PREFIX = "softgrasp_landing_"
DEPENDENT = 1e-13  # least share of a direction of the basis in its Gram matrix, scaled [1]
# s of the answers to a landing over 2 / dt, and EACH: chosen with the errors on set_down and the paper's block in
# sight, also those of the motions that docs/guide calls held out [1].
LANDING = 0.15, 4.5
EACH = 6  # modes per such answer, of which the second helps the force and the mode in its place the deformation
RICH = 60  # modes of a rich model
RICH_LANDING = 0.01, 0.05, 0.2, 0.8, 3.5, 15.0  # s of its answers to a landing over 2 / dt, from slow to instant [1]


def contact_model(
    model: Model, modes: int = 10, reach: float | None = None, rows: int | None = None, N: int | None = None
) -> ContactModel:
    """The tissue in coordinates z = V a, V = [K^-1 G, modes, K^-1 N', S^-1 N'm] orthonormal in M [CB68]. Collective.

    Args:
        model: with ``effects.obstacles`` and a hand that does not feel the tissue.
        modes: number of columns beside the responses to the hand and to the rows, at least 2: clamped modes, and for
            each direction of the half-spaces an answer to a landing, two from 12 columns per direction on.
        reach: rows N are kept for boundary nodes that come nearer than this to an obstacle while the undeformed body
            follows the hand of the scene [m]; None: half the distance of boundary nodes. A run in which another node
            enters an obstacle is refused.
        rows: number of hat functions along each half-space in 2D, at least 2, whose mean gaps are >= 0, for N that does
            not grow with the mesh; None: a row for each node. Of nodes behind each other the foremost is in them.
        N: number of columns in all, at most; it replaces ``modes`` and ``rows``. The columns beside the responses, and
            in 2D the number of rows, are those that a rich model needs on the motion of the scene and on others like
            it, which takes longer. None: no training.

    Raises:
        ModelError: the scene has other obstacles, no contact or a two-way hand, or no node comes within reach, or N is
            given with ``rows`` or has too little room.

    >>> import softgrasp as sg
    >>> rom = sg.contact_model(sg.build("set_down", ["tissue.cells=[6, 4]"]), modes=8)
    >>> run = rom.run(*rom.motion(), rom.dt)
    >>> rom.N, bool(run.gap.min() > -1e-12)
    (17, True)
    """
    if N is None:
        return _assembled(model, modes, reach, rows)
    if rows is not None:
        raise ModelError("rows cannot go with N, which chooses them; give one of both")
    return trained(model, reach).model(N)


def trained(model: Model, reach: float | None = None) -> Training:
    """What models of any N are taken from, see :func:`contact_model`. Collective."""
    return train(_assembled(model, min(RICH, model.system.layout.n_e), reach, rich=True))


def _assembled(
    model: Model, modes: int, reach: float | None, rows: int | None = None, rich: bool = False
) -> ContactModel:
    """A model of given modes and rows; a rich one has the nodes of a face and more answers to a landing. Collective."""
    scene, system = model.scene, model.system
    layout, obstacles = system.layout, check_contact_scene(model)
    seconds, begin = {}, time.perf_counter()
    surface, table, dt = (
        make_surface(model.space, system),
        motion_table(scene, layout.n_s),
        scene.time_end / scene.time.steps,
    )
    near = node_distance(model.space) / 2 if reach is None else reach
    kept = np.flatnonzero(nearest_gaps(surface, obstacles, table.q, dt, len(table.q)).min(axis=0) < near)
    if not len(kept):
        raise ModelError(f"no boundary node comes within reach = {near:.3g} m of an obstacle; give a larger reach")
    if rows is not None or rich:  # a hat goes along one face: of what lies above another node none
        kept = foremost(surface.X, kept, obstacles, near)
    hats = tuple(hat_functions(surface.X, kept, o, rows) for o in obstacles)
    V, stiffness = _diagonal(model, _columns(model, surface, kept, obstacles, hats, modes, rich))
    seconds["basis"] = time.perf_counter() - begin
    begin = time.perf_counter()
    viscous = viscosity(system, 1.0)
    D = total(layout.comm, V.T @ times_columns(viscous, V))
    viscous.destroy()
    outputs = make_outputs(scene, system)
    on = np.zeros((len(surface.dofs), V.shape[1]))
    on[surface.mine] = V[surface.rows]
    seconds["projection"] = time.perf_counter() - begin
    return ContactModel(
        stiffness, (D + D.T) / 2, total(layout.comm, V.T @ system.G),
        total(layout.comm, output_columns(outputs, layout.n_local).T @ V), np.vstack([o.C_s for o in outputs]),
        surface.X, surface.T, total(layout.comm, on), kept, hats, obstacles, system.fall, system.damping.drag,
        scene.time.start == "equilibrium" and system.gravity is not None, table, dt, layout.extent,
        tuple(name for o in outputs for name in o.names), model.scene_hash, origin_of(model.scene_keys), seconds,
        layout, V,
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


def _columns(
    model: Model, surface: Surface, kept: Ints, obstacles: tuple[Obstacle, ...], hats: tuple[Array, ...], modes: int,
    rich: bool,
) -> Array:  # fmt: skip
    """K^-1 G, K^-1 N', modes and answers to a landing, local rows (n_local, columns). Collective."""
    system = model.system
    loads = _responses(model, surface, kept, obstacles, hats)
    normals = np.unique([plane(o)[0] for o in obstacles], axis=0)
    answers = RICH_LANDING if rich else LANDING[: max(1, modes // (EACH * len(normals)))]
    shapes = lowest_modes(system, max(1, modes - len(answers) * len(normals)))[1]
    fast = 2 * model.scene.time.steps / model.scene.time_end
    return np.hstack([
        static_columns(system, np.asfortranarray(np.hstack([system.G, loads]))), shapes,
        *(_landing(system, surface, kept, normals, s * fast) for s in answers),
    ])  # fmt: skip


def _responses(
    model: Model, surface: Surface, kept: Ints, obstacles: tuple[Obstacle, ...], hats: tuple[Array, ...]
) -> Array:
    """N' of the rows, those of equal half-spaces once, local rows (n_local, columns)."""
    d = surface.X.shape[1]
    normals = [plane(o)[0] for o in obstacles]
    each = [j for j, n in enumerate(normals) if not any(np.array_equal(n, other) for other in normals[:j])]
    whole = np.zeros((len(surface.dofs), sum(len(hats[j]) for j in each)))
    loads = np.hstack([np.einsum("ri,d->idr", hats[j], normals[j]).reshape(len(kept) * d, -1) for j in each])
    whole[(kept[:, None] * d + np.arange(d)).ravel()] = loads
    result = np.zeros((model.system.layout.n_local, whole.shape[1]), order="F")
    result[surface.rows] = whole[surface.mine]
    return result


def _landing(system: BlockSystem, surface: Surface, kept: Ints, normals: Array, s: float) -> Array:
    """(K + s D + s^2 M)^-1 of the momentum of the kept nodes as the body moves along each normal. Collective."""
    layout, d = system.layout, surface.X.shape[1]
    moved = times_columns(system.M_ee, np.asfortranarray(np.tile(normals.T, (layout.n_local // d, 1))))
    there, loads = np.zeros(len(surface.dofs), dtype=bool), np.zeros_like(moved, order="F")
    there[(kept[:, None] * d + np.arange(d)).ravel()] = True
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
