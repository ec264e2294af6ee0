"""Reduced models with contact: z = V a, V = [K^-1 G, modes, K^-1 N'], orthonormal in the mass [CB68].

Modes alone miss what a force on a node does next to it: nodal forces come out wrong by their own size. With the static
response of every node that may touch beside them, the answer to slow forces there is exact. On fine meshes rows of hat
functions h_j over several nodes replace those of nodes, N_j = sum_i h_j(x_i) N_i / sum_i h_j(x_i): mean gaps are >= 0.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.model.outputs import make_outputs, output_columns
from softgrasp.fem.model.surface import Surface, make_surface, node_distance
from softgrasp.fem.obstacles import HalfSpace, Obstacle, make_obstacles
from softgrasp.fem.petsc import Array, normalising, times_columns, total
from softgrasp.fem.run.midpoint import viscosity
from softgrasp.fem.run.motion import HandTable, motion_table
from softgrasp.fem.shown import Card, Shown, amount, counted
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.reduction.contact.stepper import ContactSteps
from softgrasp.reduction.system import ModelError

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

Ints = NDArray[np.intp]
ROUNDING = 64 * float(np.finfo(float).eps)  # of a gap, over the coordinates it is computed from [1]
DEPENDENT = 1e-13  # least share of a direction of the basis in its Gram matrix, scaled [1]
CROWD = 1.5  # power of the distance from the end by which hat functions crowd there, where pressures are steep [1]
CHUNK = 256  # instants at which the nodes without a row are looked at in one product


@dataclass(frozen=True, repr=False)
class ContactRun(Shown):
    """What a run of a reduced model with contact returns."""

    times: Array
    """Instants [s], (steps + 1,)."""
    a: Array
    """Coordinates z = V a, (steps + 1, N) [kg^1/2 m]."""
    v: Array
    """Rates of the coordinates, (steps + 1, N) [kg^1/2 m/s]."""
    outputs: Array
    """Outputs y, (steps + 1, components) [m, rad]."""
    force: Array
    """Mean force of each obstacle on the tissue in each step, impulses included, (steps, obstacles, d) [N]."""
    gap: Array
    """Least gap of each obstacle to the nodes of the rows, (steps + 1, obstacles) [m]; < 0 between hat functions."""
    touching: Ints
    """Number of rows that each obstacle presses in each step, (steps, obstacles)."""

    def card(self) -> Card:
        """Steps and forces."""
        steps = len(self.times) - 1
        force = float(np.linalg.norm(self.force, axis=2).max(initial=0.0))
        least = float(self.gap.min())
        rows = (
            ("time", f"{counted(steps, 'step')} to {amount(self.times[-1], 's')}"),
            ("force", f"at most {amount(force, 'N')}"),
            ("gap", f"at least {amount(least, 'm')} at nodes"),
        )
        return Card("Run of a reduced model with contact", rows)


@dataclass(frozen=True, repr=False)
class ContactModel(Shown):
    """A block with contact in few coordinates, for any motion of a hand that does not feel the tissue.

    >>> import softgrasp as sg
    >>> model = sg.build("set_down", ["tissue.cells=[6, 4]"])
    >>> rom = sg.contact_model(model, modes=8)
    >>> run = rom.run(*rom.motion(), rom.dt)
    >>> run.gap.min() > -1e-12
    True
    """

    V: Array
    """Columns of z = V a of this rank's rows, (n_local, N) [kg^-1/2]."""
    stiffness: Array
    """V'K V, diagonal, (N,) [1/s^2]."""
    D: Array
    """V'D V, (N, N) [1/s]."""
    G: Array
    """V'G, the load by a unit acceleration of the hand, (N, n_s) [kg^1/2]."""
    C: Array
    """C'V of the outputs, (components, N)."""
    C_s: Array
    """Rigid part of the outputs, (components, n_s)."""
    surface: Surface
    """Boundary nodes."""
    on_surface: Array
    """V on the boundary, (p d, N)."""
    kept: Ints
    """Numbers of the boundary nodes that have rows, (nodes,)."""
    hats: tuple[Array, ...]
    """Shares of these nodes in the rows of each obstacle, (rows, nodes) each [1]."""
    obstacles: tuple[Obstacle, ...]
    """Half-spaces."""
    fall: Array
    """Free fall in the hand's degrees of freedom, (n_s,) [m/s^2]."""
    drag: float
    """Mass-proportional damping that also acts on the rigid motion [1/s]."""
    equilibrium: bool
    """Whether runs start in equilibrium under gravity."""
    table: HandTable
    """Motion of the hand of the scene."""
    dt: float
    """Step of the scene [s]."""
    extent: float
    """Size of the body [m]."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time that the parts took to make [s]."""

    @property
    def N(self) -> int:
        """Number of coordinates [1]."""
        return len(self.stiffness)

    def card(self) -> Card:
        """Dimension and rows."""
        rows = (
            ("dimension", f"N = {self.N}"),
            (
                "contact",
                f"{counted(len(self.hats[0]), 'row')} on {counted(len(self.kept), 'node')} before "
                f"{counted(len(self.obstacles), 'half-space')}",
            ),
        )
        return Card("ContactModel", rows)

    def motion(self) -> tuple[Array, Array]:
        """Position and velocity of the hand in the scene, (steps + 1, n_s) each [m, rad; m/s, rad/s]."""
        return self.table.q, self.table.v

    def run(self, q: Array, v: Array, dt: float, engine: str = "") -> ContactRun:
        """Midpoint steps with contact under a motion of the hand. Not collective.

        Args:
            q, v: position and velocity of the hand at the ends of the steps, (steps + 1, n_s) each.
            dt: step [s].
            engine: "C" or "NumPy"; empty takes C where there is a compiler.

        Raises:
            ModelError: a boundary node without a row enters an obstacle, or the tissue starts in one.
            SolverError: the contact problem of a step has no solution.
        """
        surface, d, steps = self.surface, self.surface.X.shape[1], len(q) - 1
        c = -(np.diff(v, axis=0) / dt - self.fall + self.drag * (v[1:] + v[:-1]) / 2)
        start = self.G @ self.fall / self.stiffness if self.equilibrium else np.zeros(self.N)
        T, t = surface.T.reshape(-1, d, q.shape[1])[self.kept], dt * np.arange(steps + 1.0)
        N, gaps, rates, normals = [], [], [], []
        for obstacle in self.obstacles:
            n, offset = _plane(obstacle)
            N.append(np.einsum("i,jik->jk", n, self.on_surface.reshape(-1, d, self.N)[self.kept]))
            lift = np.einsum("i,jis->js", n, T)
            shift, speed = (np.array([np.zeros(d) + f(x) for x in t]) @ n for f in (obstacle.shift, obstacle.rate))
            gaps.append(surface.X[self.kept] @ n - offset + q @ lift.T - shift[:, None])
            rates.append(v @ lift.T - speed[:, None])
            normals.append(n)
        hats = self.hats
        rows = np.vstack([H @ each for H, each in zip(hats, N, strict=True)])
        gap, rate = (
            np.ascontiguousarray(np.hstack([x @ H.T for H, x in zip(hats, each, strict=True)]))
            for each in (gaps, rates)
        )
        tol = ROUNDING * (float(np.abs(surface.X).max() + np.abs(q).max(initial=0.0)) + self.extent)
        stepper = ContactSteps(self.stiffness, self.D, np.ascontiguousarray(rows), dt)
        a, rate_a, x, y = stepper.march(start, np.ascontiguousarray(c @ self.G.T), gap, rate, tol, engine)
        self._check(a, q, t, tol)
        least = [(each + a @ n.T).min(axis=1) for each, n in zip(gaps, N, strict=True)]
        ends = np.cumsum([len(H) for H in hats])[:-1]
        parts = zip(np.split(x + y / dt, ends, axis=1), normals, strict=True)
        force = np.stack([part.sum(axis=1)[:, None] * n for part, n in parts], axis=1)
        touching = np.column_stack([(part > 0).sum(axis=1) for part in np.split(x, ends, axis=1)])
        return ContactRun(t, a, rate_a, a @ self.C.T + q @ self.C_s.T, force, np.column_stack(least), touching)

    def _check(self, a: Array, q: Array, t: Array, tol: float) -> None:
        """Raise ModelError where a boundary node without a row is in an obstacle, or any one at the start."""
        surface, d = self.surface, self.surface.X.shape[1]
        others = np.setdiff1d(np.arange(len(surface.X)), self.kept)
        for obstacle in self.obstacles:
            n, offset = _plane(obstacle)
            V, T = (np.einsum("i,jik->jk", n, x.reshape(len(surface.X), d, -1)) for x in (self.on_surface, surface.T))
            for first in range(0, len(t), CHUNK):
                part = slice(first, first + CHUNK)
                shift = np.array([float(n @ (np.zeros(d) + obstacle.shift(x))) for x in t[part]])
                gap = surface.X @ n - offset + a[part] @ V.T + q[part] @ T.T - shift[:, None]
                looked = gap[:, others].min(initial=np.inf)
                if first == 0 and gap[0].min() < -tol:
                    raise ModelError(f"obstacle '{obstacle.name}' is {-gap[0].min():.2g} m in the tissue at the start")
                if looked < -tol:
                    raise ModelError(
                        f"a boundary node without a row is {-looked:.2g} m in obstacle '{obstacle.name}'; give "
                        "contact_model a larger reach"
                    )


def contact_model(model: Model, modes: int = 10, reach: float | None = None, rows: int | None = None) -> ContactModel:
    """The tissue in coordinates z = V a, V = [K^-1 G, modes, K^-1 N'] orthonormal in the mass [CB68]. Collective.

    Args:
        model: with ``effects.obstacles`` and a hand that does not feel the tissue.
        modes: number of clamped modes beside the responses.
        reach: rows N are kept for boundary nodes that come nearer than this to an obstacle while the undeformed body
            follows the hand of the scene [m]; None: half the distance of boundary nodes. A run in which another node
            enters an obstacle is refused.
        rows: number of hat functions along each half-space in 2D, at least 2, whose mean gaps are >= 0, for N that does
            not grow with the mesh; None: a row for each node. Of nodes behind each other the foremost is in them.

    Raises:
        ModelError: the scene has other obstacles, no contact or a two-way hand, or no node comes within reach.

    >>> import softgrasp as sg
    >>> rom = sg.contact_model(sg.build("set_down", ["tissue.cells=[6, 4]"]), modes=8)
    >>> run = rom.run(*rom.motion(), rom.dt)
    >>> rom.N, bool(run.gap.min() > -1e-12)
    (17, True)
    """
    scene, system = model.scene, model.system
    layout = system.layout
    if not scene.effects.obstacles or scene.effects.reaction or scene.motion.drive == "force":
        raise ModelError("contact_model needs effects.obstacles, motion.drive = 'motion' and effects.reaction = false")
    if any(entry.friction for entry in scene.obstacle or []):
        raise ModelError("contact_model has no friction yet; leave out the friction of every obstacle")
    obstacles = make_obstacles(scene, layout.dimension)
    if other := [o.kind for o in obstacles if not isinstance(o.shape, HalfSpace)]:
        raise ModelError(f"contact_model keeps half-spaces, whose normals do not turn, and no {other[0]}")
    seconds, begin = {}, time.perf_counter()
    surface, table, dt = (
        make_surface(model.space, system),
        motion_table(scene, layout.n_s),
        scene.time_end / scene.time.steps,
    )
    near = node_distance(model.space) / 2 if reach is None else reach
    kept = np.flatnonzero(_nearest(surface, obstacles, table, dt) < near)
    if not len(kept):
        raise ModelError(f"no boundary node comes within reach = {near:.3g} m of an obstacle; give a larger reach")
    if rows is not None:  # a hat goes along one face: of what lies above another node none
        kept = _foremost(surface.X, kept, obstacles, near)
    hats = tuple(_hats(surface, kept, o, rows) for o in obstacles)
    loads = _responses(model, surface, kept, obstacles, hats)
    blocks = [static_columns(system, np.asfortranarray(np.hstack([system.G, loads]))), lowest_modes(system, modes)[1]]
    V, stiffness = _diagonal(model, np.hstack(blocks))
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
        V, stiffness, (D + D.T) / 2, total(layout.comm, V.T @ system.G),
        total(layout.comm, output_columns(outputs, layout.n_local).T @ V), np.vstack([o.C_s for o in outputs]), surface,
        total(layout.comm, on), kept, hats, obstacles, system.fall, system.damping.drag,
        scene.time.start == "equilibrium" and system.gravity is not None, table, dt, layout.extent, seconds,
    )  # fmt: skip


def _plane(obstacle: Obstacle) -> tuple[Array, float]:
    """Normal and offset of a half-space."""
    assert isinstance(obstacle.shape, HalfSpace)
    return obstacle.shape.normal, obstacle.shape.offset


def _nearest(surface: Surface, obstacles: tuple[Obstacle, ...], table: HandTable, dt: float) -> Array:
    """Least gap of each boundary node while the undeformed body follows the hand, (p,) [m]."""
    least = np.full(len(surface.X), np.inf)
    for n, q in enumerate(table.q):
        x = surface.places(q)
        for obstacle in obstacles:
            least = np.minimum(least, obstacle.gap(x, n * dt))
    return least


def _foremost(X: Array, kept: Ints, obstacles: tuple[Obstacle, ...], distance: float) -> Ints:
    """The kept nodes with no other one straight before them at rest, towards the obstacle that is nearest to them."""
    gaps = np.array([o.gap(X[kept]) for o in obstacles])
    first = np.ones(len(kept), dtype=bool)
    for j, o in enumerate(obstacles):
        n, mine = _plane(o)[0], gaps.argmin(axis=0) == j
        beside = X[kept] - gaps[j][:, None] * n
        before = gaps[j][None, :] < gaps[j][:, None] - distance
        close = np.linalg.norm(beside[:, None] - beside[None], axis=2) < distance
        first &= ~(mine & (before & close).any(axis=1))
    return kept[first]


def _hats(surface: Surface, kept: Ints, obstacle: Obstacle, rows: int | None) -> Array:
    """Shares of the kept nodes in the rows of a half-space, (rows, nodes) [1].

    Raises ModelError: rows is less than 2, or the tissue is 3D.
    """
    if rows is None:
        return np.eye(len(kept))
    if surface.X.shape[1] == 3 or rows < 2:
        raise ModelError(f"rows = {rows}; it must be at least 2, and in 3D every node has a row: leave it out")
    n = _plane(obstacle)[0]
    x = surface.X[kept] @ np.array([-n[1], n[0]])
    s = np.linspace(-1.0, 1.0, rows)
    even = (1 + np.sign(s) * (1 - (1 - np.abs(s)) ** CROWD)) / 2
    at = np.unique(x[np.abs(x[:, None] - (x.min() + np.ptp(x) * even)).argmin(axis=0)])  # where nodes are
    H = np.array([np.interp(x, at, unit) for unit in np.eye(len(at))])
    return np.asarray(H / H.sum(axis=1, keepdims=True))


def _responses(
    model: Model, surface: Surface, kept: Ints, obstacles: tuple[Obstacle, ...], hats: tuple[Array, ...]
) -> Array:
    """N' of the rows, those of equal half-spaces once, local rows (n_local, columns)."""
    d = surface.X.shape[1]
    normals = [_plane(o)[0] for o in obstacles]
    each = [j for j, n in enumerate(normals) if not any(np.array_equal(n, other) for other in normals[:j])]
    whole = np.zeros((len(surface.dofs), sum(len(hats[j]) for j in each)))
    loads = np.hstack([np.einsum("ri,d->idr", hats[j], normals[j]).reshape(len(kept) * d, -1) for j in each])
    whole[(kept[:, None] * d + np.arange(d)).ravel()] = loads
    result = np.zeros((model.system.layout.n_local, whole.shape[1]), order="F")
    result[surface.rows] = whole[surface.mine]
    return result


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
