"""Runs of a reduced model with the residual they leave: mode by mode where modes decouple, else by the propagator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg

from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import Profile, driven_table
from softgrasp.reduction import online
from softgrasp.reduction.certified.bounds import lengths, node_average
from softgrasp.reduction.certified.oscillators import Modes, SecondOrder, march
from softgrasp.reduction.certified.residual import ResidualNorms
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory, consistent
from softgrasp.reduction.propagator import propagator
from softgrasp.reduction.system import ModelError, Outputs

Materials = tuple[LayerMaterial, ...]
Start = Literal["rest", "equilibrium"]
FINER = 8  # steps for one, of the runs that estimate the error of the step
BLOCK = 32  # columns of a Householder block in LAPACK
SLOW = 0.25  # angle of a mode in a step below which smoothing its residual gains about 1 % of the bound


@dataclass(frozen=True)
class Drive:
    """What moves the hand: tables of its motion at the steps, or of the force on it at their midpoints."""

    dt: float  # step [s]
    hand: tuple[Array, Array] | None = None  # q_s and v_s, (steps + 1, n_s) each [m, rad; m/s, rad/s]
    force: Array | None = None  # u, (steps, n_s) [N, N m]
    start: Start = "rest"  # "rest", or "equilibrium" under gravity
    finer: Drive | None = None  # this motion at a step several times smaller, for the error of the step
    profile: Profile | None = None  # the time law behind the tables; None: not known

    @staticmethod
    def along(profile: Profile, steps: int, M_hand: Array, start: Start, finer: int = FINER) -> Drive:
        """A time law at some steps, and at ``finer`` times as many (1: not)."""

        def at(count: int) -> Drive:
            dt = profile.end / count
            if profile.drive == "force":
                return Drive(dt, force=profile.force(count, M_hand), start=start)
            table = profile.motion(count)
            return Drive(dt, hand=(table.q, table.v), start=start)

        return replace(at(steps), finer=at(finer * steps) if finer > 1 else None, profile=profile)

    @property
    def steps(self) -> int:
        """Number of steps.

        Raises:
            ModelError: there is neither a motion nor a force, or both.
        """
        if (self.hand is None) == (self.force is None):
            raise ModelError("give either the force on the hand or the motion of the hand")
        return len(self.force) if self.hand is None else len(self.hand[0]) - 1  # type: ignore[arg-type]


@dataclass(frozen=True)
class Residual:
    """Residual of a run as the static bound needs it, see :func:`softgrasp.reduction.certified.bounds.static_bound`."""

    nodes: Array  # T r^ in K^-1 at the steps, (w, steps + 1)
    rest: Array  # |r - mean r^|_{M^-1}, (steps,)


@dataclass(frozen=True)
class Motion:
    """One run of one basis."""

    q_s: Array  # displacement of the hand, (steps + 1, n_s) [m, rad]
    v_s: Array  # velocity of the hand, (steps + 1, n_s) [m/s, rad/s]
    outputs: Array  # (steps + 1, p) [m, rad]
    size: float  # largest energy norm
    residual: Residual | None  # residual of every step; None for runs without a bound
    modes: Modes | None = None  # modes of the run; None where it was not made mode by mode
    w: Array | None = None  # states in the modes, (k, 2, steps + 1); None without modes
    x: Array | None = None  # states x, (steps + 1, N); None with modes

    def states(self, dt: float) -> Array:
        """States x = [q_s, v_s, a, b], (steps + 1, N)."""
        if self.modes is None or self.w is None:
            assert self.x is not None
            return self.x
        X = self.modes.X
        tissue = [(X @ (self.w[:, 0] / self.modes.omega[:, None])).T, (X @ self.w[:, 1]).T]
        return np.hstack([consistent(self.q_s, self.v_s, dt), self.v_s, *tissue])

    def trajectory(self, dt: float, names: tuple[str, ...]) -> ReducedTrajectory:
        """As :func:`softgrasp.reduction.online.run` returns it."""
        x = self.states(dt)
        return ReducedTrajectory(dt * np.arange(float(len(x))), x, self.q_s, self.v_s, self.outputs, names)


def leading(model: ReducedModel, k: int) -> ReducedModel:
    """The second-order model of the first k modes, without its reconstruction."""
    hand = 2 * len(model.parts["M_hand"])
    half = (model.N - hand) // 2
    pick = np.r_[: hand + k, hand + half : hand + half + k]
    parts = {}
    for key, X in model.parts.items():
        for axis in range(max(X.ndim - 2, 0), X.ndim):
            if X.shape[axis] == model.N:
                X = np.asarray(X.take(pick, axis))
        parts[key] = X
    outputs = Outputs(model.outputs.C_z[:, pick], model.outputs.C_s, model.outputs.names)
    return replace(model, N=len(pick), parts=parts, outputs=outputs, split=(2 * k,), reconstruction=None)


def padded(x: Array, N: int, n_s: int) -> Array:
    """States of a leading model as those of the whole of dimension N."""
    k, half = (x.shape[1] - 2 * n_s) // 2, (N - 2 * n_s) // 2
    result = np.zeros((len(x), N))
    result[:, : 2 * n_s + k] = x[:, : 2 * n_s + k]
    result[:, 2 * n_s + half : 2 * n_s + half + k] = x[:, 2 * n_s + k :]
    return result


def known_hand(model: ReducedModel, drive: Drive, gravity: Array) -> tuple[Array, Array] | None:
    """Tables of the hand, which are known beforehand with one-way coupling; None two-way under a force.

    Raises:
        ModelError: the tables do not fit.
    """
    M_hand, steps, u = model.parts["M_hand"], drive.steps, drive.force
    for table in (u,) if u is not None else (drive.hand or ()):
        if table.shape != (steps + (u is None), len(M_hand)) or steps < 1:
            raise ModelError(
                f"a table of the hand has the shape {table.shape}; it must have {len(M_hand)} columns, and one row "
                "a step (a force) or one more (a motion)"
            )
    if drive.hand is not None:
        return drive.hand
    if model.two_way or u is None:
        return None
    zero = np.zeros(len(M_hand))
    own = driven_table(M_hand, u + (M_hand @ gravity if model.hand_weight else zero), drive.dt, zero, zero)
    return own.q, own.v


def load_rows(model: ReducedModel, v: Array, dt: float, g: Array) -> Array:
    """Load c = a_s - g [+ alpha v_s] at the midpoints, (n_s, steps)."""
    c = np.diff(v, axis=0).T / dt - g[:, None]
    if model.in_space:
        c += model.alpha * (v[1:] + v[:-1]).T / 2
    return np.asarray(c)


def modal_motions(
    model: ReducedModel,
    blocks: SecondOrder,
    norms: ResidualNorms | None,
    many: Sequence[Materials],
    drive: Drive,
    g: Array,
    hand: tuple[Array, Array],
) -> list[Motion]:
    """Runs at many parameters in one march; ``norms`` None leaves the residuals out.

    Raises:
        ModelError: materials that the model cannot represent.
    """
    q, v = hand
    c, still = load_rows(model, v, drive.dt, g), drive.start == "equilibrium"
    modes = [blocks.modes(model.parameters(m)) for m in many]
    omega, rate, G = (np.concatenate(x) for x in zip(*((m.omega, m.rate, m.g) for m in modes), strict=True))
    start = np.stack([G @ g / omega, np.zeros_like(omega)], axis=1) if still else None
    w = march(omega, rate, -(G @ c), drive.dt, start)
    rigid, n_s, k = q @ model.outputs.C_s.T, q.shape[1], blocks.M.shape[1]
    C = model.outputs.C_z[:, 2 * n_s : 2 * n_s + k]
    result = []
    for i, (m, materials) in enumerate(zip(modes, many, strict=True)):
        own = w[i * k : (i + 1) * k]
        eta = own[:, 0] / m.omega[:, None]
        residual = None
        if norms is not None:
            residual = modal_residual(norms, materials, m, eta + m.beta * own[:, 1], c, -g if still else None, drive.dt)
        size = float(lengths(own.reshape(2 * k, -1)).max())
        result.append(Motion(q, v, ((C @ m.X) @ eta).T + rigid, size, residual, m, own))
    return result


def modal_residual(
    norms: ResidualNorms, materials: Materials, m: Modes, y: Array, c: Array, c_0: Array | None, dt: float
) -> Residual:
    """Residual of a run in modes: what the modes are not modes of, (K - omega^2 M) Phi X y + (G - M Phi X g) c.

    It uses b' + alpha b = -omega^2 y - g c of the reduced equations, y = eta + beta eta', so that it has k + n_s
    coefficients a step instead of 2 k + n_s, and Phi' r = 0; the triangles are brought to that size once a parameter.

    Args:
        y: (k, steps + 1).
        c: (n_s, steps).
        c_0: at a start in equilibrium, (n_s,); else None.
        dt: step [s]; modes that turn by less than :data:`SLOW` in it are not smoothed: no remainder at the midpoints.
    """
    slow, n_s, k = int(np.searchsorted(m.omega * dt, SLOW)), len(c), len(y)
    norms = norms.galerkin
    G, M, K = norms.columns("both", materials, 3)
    hand, edge = G - M @ (m.X @ m.g), len(norms.static)

    def remainder(rows: slice, modes: slice) -> Array:
        """Residual of some modes in the rows of one triangle: (K - omega^2 M) X."""
        X = m.X[:, modes]
        own = K[rows] @ X
        own -= M[rows] @ (X * m.omega[modes] ** 2)
        return np.asarray(own)

    above, below = slice(edge), slice(edge, None)
    own, fast = remainder(above, slice(None)), remainder(below, slice(slow, None))
    static, mass = np.hstack([own[:, :slow], hand[above], own[:, slow:]]), np.hstack([hand[below], fast])
    midpoints, steps = np.empty((n_s + k - slow, c.shape[1])), np.empty((n_s + k, y.shape[1]))
    midpoints[:n_s], steps[:slow] = c, y[:slow]
    np.add(y[slow:, 1:], y[slow:, :-1], out=midpoints[n_s:])
    midpoints[n_s:] *= 0.5
    _, left = node_average(midpoints, None if c_0 is None else np.concatenate([c_0, y[slow:, 0]]), steps[slow:])
    rest = lengths(triangle_times(mass, left, norms.mass_factor(materials)))
    return Residual(triangle_times(static, steps, norms.static_factor(materials)), rest)


def triangle_times(A: Array, x: Array, factor: float) -> Array:
    """Columns factor R x of A = Q R, as long as those of factor A x, in half of the work; x is overwritten."""
    n = A.shape[1]
    R = scipy.linalg.lapack.dgeqrf(A, lwork=BLOCK * n)[0][:n]
    if len(R) < n:
        return np.asarray(factor * (np.triu(R) @ x))
    return np.asarray(scipy.linalg.blas.dtrmm(factor, R, x.T, side=1, trans_a=1, overwrite_b=1).T)


def stepped_motion(
    model: ReducedModel, norms: ResidualNorms | None, materials: Materials, drive: Drive, g: Array
) -> Motion:
    """The same by the propagator: two-way under a force, layers that differ in damping.

    Raises:
        ModelError: materials that the model cannot represent, or no single equilibrium to start in.
        UnstableModelError: the model has growing modes.
    """
    small = model.at(materials, g)
    step = propagator(small, drive.dt, driven=drive.hand is not None)
    x0 = small.equilibrium() if drive.start == "equilibrium" else None
    run = online.run(step, hand=drive.hand, force=drive.force, x0=x0)
    coupled = model.two_way and drive.hand is None
    energy = small.total_energy(run.x) if coupled else small.energy(run.x)
    residual = None
    if norms is not None:
        residual = stepped_residual(model, norms, materials, drive, g, run)
    return Motion(run.q_s, run.v_s, run.outputs, float(np.sqrt(2 * max(energy.max(), 0.0))), residual, x=run.x)


def stepped_residual(
    model: ReducedModel,
    norms: ResidualNorms,
    materials: Materials,
    drive: Drive,
    g: Array,
    run: ReducedTrajectory,
) -> Residual:
    """Residual of any run, from its amplitudes a and their rates b."""
    dt = drive.dt
    a, b = np.split(run.x[:, 2 * len(g) :].T, 2)
    middle = (b[:, 1:] + b[:, :-1]) / 2
    c = load_rows(model, run.v_s, dt, g)
    rows = np.vstack([c, np.diff(b, axis=1) / dt + model.alpha * middle, (a[:, 1:] + a[:, :-1]) / 2, middle])
    first = None
    if drive.start == "equilibrium":
        first = np.concatenate([-g, np.zeros(len(b)), a[:, 0], np.zeros(len(b))])
    nodes, left = node_average(rows, first)
    static = norms.static_factor(materials) * np.linalg.qr(np.hstack(norms.columns("static", materials)), mode="r")
    mass = norms.mass_factor(materials) * np.hstack(norms.columns("mass", materials))
    if model.two_way and drive.hand is None:
        G, root = hand_inertia(model, norms)
        pulled = root.T @ G.T @ np.hstack(norms.columns("mass", materials))
        mass = np.vstack([mass, pulled * max(1.0, norms.mass_factor(materials))])
    return Residual(static @ nodes, lengths(np.linalg.qr(mass, mode="r") @ left))


def hand_inertia(model: ReducedModel, norms: ResidualNorms) -> tuple[Array, Array]:
    """Triangle of G at the reference, and S^(-1/2) of the inertia the hand has beside it, S = M_ss - G'M^-1 G.

    The coupled mass has on (r, 0) the inverse r'M^-1 r + (G'M^-1 r)' S^-1 (G'M^-1 r), M_ss = M_hand + M_rigid.
    """
    G = norms.columns("mass", norms.reference)[0]
    rigid = np.einsum("l,lij->ij", [m.rho for m in norms.reference], model.parts["rigid"])
    S = model.parts["M_hand"] + rigid - G.T @ G
    return G, np.linalg.inv(np.linalg.cholesky((S + S.T) / 2)).T
