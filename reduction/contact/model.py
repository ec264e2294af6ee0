"""Reduced models with contact: z = V a + Phi mu, V'M V = I, Phi what V lacks of static answers [MacN71].

Columns V alone miss what a force on a node does next to it: nodal forces come out wrong by their own size. Phi is the
rest of the static answer to a force on each node that may touch, Phi = (K^-1 - V (V'K V)^-1 V') N', so that V'K Phi = 0
and strain energy splits. It has no mass and follows the forces with the time of the damping, see `stepper.py`; so V is
left to what moves, and every node within reach has a row at no cost in columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.obstacles import HalfSpace, Obstacle
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import HandTable
from softgrasp.fem.shown import Card, Shown, amount, counted
from softgrasp.reduction.contact.stepper import ContactSteps
from softgrasp.reduction.online import checked_hand
from softgrasp.reduction.origin import MOTION, check_origin
from softgrasp.reduction.system import ModelError

Ints = NDArray[np.intp]
ROUNDING = 64 * float(np.finfo(float).eps)  # of a gap, over the coordinates it is computed from [1]
CHUNK = 256  # instants at which the nodes without a row are looked at in one product


@dataclass(frozen=True, repr=False)
class ContactRun(Shown):
    """What a run of a reduced model with contact returns."""

    times: Array
    """Instants [s], (steps + 1,)."""
    a: Array
    """Coordinates of z = V a + Phi mu, (steps + 1, N) [kg^1/2 m]."""
    v: Array
    """Rates of the coordinates, (steps + 1, N) [kg^1/2 m/s]."""
    mu: Array
    """Forces that Phi answers, (steps + 1, rows) [N]."""
    outputs: Array
    """Outputs y, (steps + 1, components) [m, rad]."""
    force: Array
    """Mean force of each obstacle on the tissue in each step, impulses included, (steps, obstacles, d) [N]."""
    row_force: Array
    """The same of each row, along the normal of its obstacle, (steps, rows) [N]."""
    gap: Array
    """Least gap of each obstacle to the nodes of the rows, (steps + 1, obstacles) [m]."""
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
    >>> rom = sg.contact_model(model, N=10)
    >>> run = rom.run(*rom.motion(), rom.dt)
    >>> run.gap.min() > -1e-12
    True
    """

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
    X: Array
    """Coordinates at rest of the boundary nodes and the points between them that can touch, (p, d) [m]."""
    T: Array
    """Rigid modes of the hand there, (p d, n_s) [1, m]."""
    on_surface: Array
    """V on the boundary, (p d, N)."""
    Phi_on_surface: Array
    """Phi there, (p d, rows) [m/N]; the rows are those of each node before the first obstacle, the second, ..."""
    C_Phi: Array
    """C'Phi of the outputs, (components, rows)."""
    lag: float
    """Kelvin-Voigt time of Phi [s], tr Phi'D Phi / tr Phi'K Phi; in layers of other damping without products with V."""
    kept: Ints
    """Numbers of those points that have rows, (nodes,)."""
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
    names: tuple[str, ...] = ()
    """Columns of the outputs."""
    scene_hash: str = ""
    """Hash of the scene."""
    origin: dict[str, Any] = field(default_factory=dict)
    """Keys of the scene that decide on a run, see `reduction.origin`; {} for none."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time for making the parts [s]."""
    layout: BlockLayout | None = None
    """Of the unknowns of z on the ranks; None when loaded without a mesh."""
    V: Array | None = None
    """Columns of this rank's rows, (n_local, N) [kg^-1/2]; None when loaded without a mesh."""
    Phi: Array | None = None
    """The same of Phi, (n_local, rows) [m/N]."""

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
                f"{counted(len(self.kept), 'node')} before {counted(len(self.obstacles), 'half-space')}",
            ),
        )
        return Card("ContactModel", rows)

    def deformation(self, run: ContactRun, part: slice = slice(None)) -> Array:
        """Of this rank's rows at instants of a run, z = V a + Phi mu, (n_local, instants) [m].

        Raises ModelError: the model has no columns on the mesh.
        """
        if self.V is None or self.Phi is None:
            raise ModelError("the contact model was loaded without its columns on the mesh; load it with the layout")
        return np.asarray(self.V @ run.a[part].T + self.Phi @ run.mu[part].T)

    def rows(self) -> tuple[Array, Array]:
        """N of each node before each obstacle on V, (rows, N) [kg^-1/2], and F = N Phi, (rows, rows) [m/N]."""
        d = self.X.shape[1]
        V, Phi = (x.reshape(len(self.X), d, -1)[self.kept] for x in (self.on_surface, self.Phi_on_surface))
        normals = [plane(o)[0] for o in self.obstacles]
        N, F = (np.vstack([np.einsum("i,jik->jk", n, x) for n in normals]) for x in (V, Phi))
        return np.ascontiguousarray(N), np.ascontiguousarray((F + F.T) / 2)

    def motion(self) -> tuple[Array, Array]:
        """Position and velocity of the hand in the scene, (steps + 1, n_s) each [m, rad; m/s, rad/s]."""
        return self.table.q, self.table.v

    def check_scene(self, keys: Mapping[str, Any]) -> None:
        """Refuse the keys of a scene that differs in more than motion and time, or starts otherwise.

        Raises ModelError: names the key.
        """
        check_origin(self.origin, keys, "contact model", (MOTION,))
        own, other = (each.get("time.start") for each in (self.origin, keys))
        if self.origin and own != other:
            raise ModelError(
                f"the model was built with time.start = '{own}', and the scene has '{other}'; reduce it too"
            )

    def run(self, q: Array, v: Array, dt: float, engine: str = "") -> ContactRun:
        """Midpoint steps with contact under a motion of the hand. Not collective.

        Args:
            q, v: position and velocity of the hand at the ends of the steps, (steps + 1, n_s) each.
            dt: step [s].
            engine: "C" or "NumPy"; empty takes C where there is a compiler.

        Raises:
            ModelError: a boundary node without a row enters an obstacle, the tissue starts in one, or the hand's tables
                do not fit.
            SolverError: the contact problem of a step has no solution.
        """
        q, v = checked_hand((q, v), self.G.shape[1])
        if not (np.isfinite(dt) and dt > 0 and np.isfinite(q).all() and np.isfinite(v).all()):
            raise ModelError(f"dt = {dt:g} s must be > 0, and the hand's positions and velocities finite numbers")
        d, steps = self.X.shape[1], len(q) - 1
        c = -(np.diff(v, axis=0) / dt - self.fall + self.drag * (v[1:] + v[:-1]) / 2)
        start = self.G @ self.fall / self.stiffness if self.equilibrium else np.zeros(self.N)
        T, t = self.T.reshape(-1, d, q.shape[1])[self.kept], dt * np.arange(steps + 1.0)
        gaps, rates = [], []
        for obstacle in self.obstacles:
            n, offset = plane(obstacle)
            lift = np.einsum("i,jis->js", n, T)
            shift, speed = (_moved(obstacle, t, order) for order in (0, 1))
            gaps.append(self.X[self.kept] @ n - offset + q @ lift.T - shift[:, None])
            rates.append(v @ lift.T - speed[:, None])
        N, F = self.rows()
        gap, rate = (np.ascontiguousarray(np.hstack(each)) for each in (gaps, rates))
        tol = ROUNDING * (float(np.abs(self.X).max() + np.abs(q).max(initial=0.0)) + self.extent)
        stepper = ContactSteps(self.stiffness, self.D, N, F, self.lag, dt)
        a, rate_a, x, y, mu = stepper.march(start, np.ascontiguousarray(c @ self.G.T), gap, rate, tol, engine)
        self._check(a, mu, q, t, tol)
        shape = (-1, len(self.obstacles), len(self.kept))
        least = (gap + a @ N.T + mu @ F).reshape(shape).min(axis=2)
        pressed = x + y / dt
        normals = np.array([plane(o)[0] for o in self.obstacles])
        force = pressed.reshape(shape).sum(axis=2)[:, :, None] * normals
        touching = (x.reshape(shape) > 0).sum(axis=2)
        outputs = a @ self.C.T + mu @ self.C_Phi.T + q @ self.C_s.T
        return ContactRun(t, a, rate_a, mu, outputs, force, pressed, least, touching)

    def _check(self, a: Array, mu: Array, q: Array, t: Array, tol: float) -> None:
        """Raise ModelError where a boundary node without a row is in an obstacle, or any one at the start."""
        p, d = self.X.shape
        others = np.setdiff1d(np.arange(p), self.kept)
        for obstacle in self.obstacles:
            n, offset = plane(obstacle)
            V, Phi, T = (
                np.einsum("i,jik->jk", n, x.reshape(p, d, -1)) for x in (self.on_surface, self.Phi_on_surface, self.T)
            )
            shift = _moved(obstacle, t, 0)
            for first in range(0, len(t), CHUNK):
                part = slice(first, first + CHUNK)
                gap = self.X @ n - offset + a[part] @ V.T + mu[part] @ Phi.T + q[part] @ T.T - shift[part, None]
                looked = gap[:, others].min(initial=np.inf)
                if first == 0 and gap[0].min() < -tol:
                    raise ModelError(f"obstacle '{obstacle.name}' is {-gap[0].min():.2g} m in the tissue at the start")
                if looked < -tol:
                    raise ModelError(
                        f"a boundary node beyond the reach of the model is {-looked:.2g} m in obstacle "
                        f"'{obstacle.name}'; give contact_model a larger reach"
                    )


def _moved(obstacle: Obstacle, t: Array, order: int) -> Array:
    """Displacement of a half-space along its normal at each instant, or its rate, (instants,)."""
    n, path = plane(obstacle)[0], obstacle.path
    return np.zeros(len(t)) if path is None else np.array([float(n @ path(x, order)) for x in t])


def plane(obstacle: Obstacle) -> tuple[Array, float]:
    """Normal and offset of a half-space."""
    assert isinstance(obstacle.shape, HalfSpace)
    return obstacle.shape.normal, obstacle.shape.offset
