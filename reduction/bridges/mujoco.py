"""Reduced tissue on a body of a MuJoCo model, two-way, without iteration and without lag.

In the axes of the body, with acceleration A6 = [A; Omega'] = J qacc + b, z = Phi a and e = a',

    M e' + D e + K a = -G_a A6 + G g - S : W^2 - 2 E(W) e - E(W^2) a,      W the matrix of Omega x,
    wrench on the body = -(M_a A6 + G_a'e' + v),        G_a = G + [0, E(. x) a]

where M_a is what the deformation adds to the rigid inertia, v are its centrifugal and Coriolis forces and its weight's
torque. The midpoint rule over a step h, with M_a, G_a and v at half of it by extrapolation, gives

    S e_step = h (r - G_a A6),    S = M + h/2 D + h^2/4 K,    r = G g - ... - D e - K (a + h/2 e)
    [M_mj + J'(M_a - G_a'S^-1 G_a) J] qacc = MuJoCo's forces - J'[(M_a - G_a'S^-1 G_a) b + G_a'S^-1 r + v]

so that MuJoCo solves for robot and tissue together, contact included: the bracket goes into its mass matrix, which is
factored again, the right-hand side is a generalised force, and action is reaction.

A robot that is free keeps its momenta beside that, see `flight.py`. `step.c` has the small algebra; without a compiler
NumPy does it.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.errors import ResourceError, shortened
from softgrasp.fem.frame.rotation import cross_matrix
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.reduction.bridges.compiled import CompiledStep
from softgrasp.reduction.bridges.flight import FreeFlight
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.system import ModelError
from softgrasp.reduction.turning.model import TurningModel

AXES = cross_matrix(np.eye(3))  # the matrices of e_c x, (3, 3, 3)
EYE = np.eye(3)
NOT_FINITE = "the state of the tissue in MuJoCo is not finite; use a shorter step or softer controls"
LIGHT = 1 - 1e-6  # of the mass of the tissue, which its body has at least


class MujocoTissue:
    """Tissue on a body of a MuJoCo model.

    The origin of the body is the reference point of the scene's hand, its axes are those of the scene, and its mass and
    inertia, or those of a body fixed to it, include the rigid tissue: :func:`write_mujoco` writes such a body.

    Args:
        rom: model in the frame of the hand, in space.
        mj_model: ``mujoco.MjModel`` with Euler's method and the solver Newton or CG.
        body: name of the body.
        dt: step of the model [s].
        materials: one a layer; None: those of the projection.

    Attributes:
        a: coordinates of the deformation, (k,).
        e: their rates, (k,).
        wrench: mean force and torque of the tissue on the body in the last step beside those of rigid tissue, in its
            axes about its origin, (6,) [N, N m].

    Raises:
        ModelError: MuJoCo is not installed, or model, body, method, solver or step do not fit.
    """

    def __init__(
        self,
        rom: TurningModel,
        mj_model: Any,
        *,
        body: str = "hand",
        dt: float = 1e-3,
        materials: tuple[LayerMaterial, ...] | None = None,
    ) -> None:
        if not isinstance(rom, TurningModel):
            if isinstance(rom, ReducedModel):
                raise ModelError("the model is one of small angles; reduce a scene with effects.frame = 'hand'")
            raise ModelError(f"{shortened(repr(rom))} is no model; give what sg.reduce or sg.load returns")
        if len(rom.M_hand) != 6:
            raise ModelError("the model is plane; MuJoCo needs one of three dimensions")
        self.mujoco, self.mj_model = _mujoco(), mj_model
        self.body = _checked_body(self.mujoco, mj_model, body, dt)
        system = rom.at(dt, materials)
        mass = float(mj_model.body_subtreemass[self.body])
        if not mass >= LIGHT * system.rigid[0, 0]:
            raise ModelError(
                f"body '{body}' weighs {mass:.4g} kg with what it carries, and its tissue {system.rigid[0, 0]:.4g} kg; "
                "add the body of `softgrasp export MODEL --mujoco FILE`"
            )
        if mj_model.body_simple[self.body]:
            raise ModelError(
                f"MuJoCo keeps the diagonal alone of the mass matrix of body '{body}', and the tissue needs all of it; "
                "put the tissue's mass in a body fixed to it, as `softgrasp export MODEL --mujoco FILE` does"
            )
        small, k, nv = system.small, rom.k, mj_model.nv
        self.dt, self.rom, self.small = dt, rom, small
        self.inverse = np.linalg.inv(small.M + dt / 2 * small.D + dt * dt / 4 * small.K)
        self.inverse = (self.inverse + self.inverse.T) / 2
        self.a, self.e, self._past = np.zeros(k), np.zeros(k), np.zeros(k)
        self.wrench, self._rate = np.zeros(6), np.zeros(3)
        # integrals of a and e at once: pairs with every mode, int rho z, and int rho z_k r_l
        sums = np.hstack([small.G[:, :3], small.S])
        self._integrals = np.ascontiguousarray(np.vstack([small.E.reshape(9 * k, k), sums.T]))
        self._loads, self._forces = np.ascontiguousarray(sums), np.hstack([small.K, small.D + dt / 2 * small.K])
        self._turns = np.vstack([np.zeros((2, 9)), AXES.reshape(3, 9)])
        self._J, self._Jd, self._six = np.zeros((6, nv)), np.zeros((6, nv)), np.zeros((6, 6))
        self._gravity, self._weightless = np.zeros(3), int(self.mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        self._flight = FreeFlight.of(self.mujoco, mj_model, self.body)
        self._rows = np.repeat(np.arange(nv, dtype=np.intc), mj_model.M_rownnz)  # of the lower triangle in M
        self._columns = np.array(mj_model.M_colind, dtype=np.intc)
        self._code = CompiledStep.of(self)

    @property
    def outputs(self) -> dict[str, float]:
        """Deformation at the outputs of the scene by their names, in the axes of the body [m]."""
        return dict(zip(self.rom.outputs.names, (self.rom.outputs.C_z @ self.a).tolist(), strict=True))

    def energy(self) -> float:
        """Elastic energy and kinetic energy a'K a / 2 + e'M e / 2 of the deformation against the body [J]."""
        return float(self.a @ self.small.K @ self.a + self.e @ self.small.M @ self.e) / 2

    def settle(self, data: Any) -> None:
        """Start at rest, deformed by gravity as it acts in the axes of the body."""
        self.mujoco.mj_forward(self.mj_model, data)
        fall = data.xmat[self.body].reshape(3, 3).T @ self._fall()
        self.a = np.linalg.solve(self.small.K, self.small.G[:, :3] @ fall)
        self.e, self._past[:], self._rate[:] = np.zeros_like(self.a), 0.0, 0.0

    def step(self, data: Any) -> None:
        """``mujoco.mj_step`` with the tissue; ``data`` may have controls and applied forces of the user.

        Raises ModelError: the state is no longer finite.
        """
        mujoco, model = self.mujoco, self.mj_model
        self._fall()
        mujoco.mj_step1(model, data)
        mujoco.mj_jacBody(model, data, self._J[:3], self._J[3:], self.body)
        mujoco.mj_jacDot(model, data, self._Jd[:3], self._Jd[3:], data.xpos[self.body], self.body)
        flight = self._flight
        if flight is not None:
            flight.rest(data)
        if self._code is None:
            self._in_numpy(data)
            return
        self._code.begin(data, self.a, self.e)
        mujoco.mj_factorM(model, data)
        mujoco.mj_step2(model, data)
        if not self._code.end():
            raise ModelError(NOT_FINITE)
        if flight is not None and not flight.is_held(data):
            flight.rest(data)
            self._code.keep()
        self.a, self.e, self.wrench = self._code.state()

    def _fall(self) -> Array:
        """Gravity as it acts, in space (3,) [m/s^2]: none where the flag of the model disables it."""
        option = self.mj_model.opt
        self._gravity[:] = 0.0 if option.disableflags & self._weightless else option.gravity
        return self._gravity

    def _in_numpy(self, data: Any) -> None:
        """The step after the Jacobian is known."""
        mujoco, model, six, flight = self.mujoco, self.mj_model, self._six, self._flight
        Q = data.xmat[self.body].reshape(3, 3)
        six[:3, :3] = six[3:, 3:] = Q.T
        J, before = six @ self._J, data.qvel.copy()
        b = six @ (self._Jd @ before)
        if flight is not None:
            flight.depart(data, *self._moved())
        inertia, force, right, G = self._known(J[3:] @ before, Q.T @ self._gravity)
        data.M[:] += (J.T @ inertia @ J)[self._rows, self._columns]
        mujoco.mj_factorM(model, data)
        user = data.qfrc_applied.copy()
        given = -(J.T @ (inertia @ b + force))
        data.qfrc_applied[:] += given
        mujoco.mj_step2(model, data)
        data.qfrc_applied[:] = user
        # the velocity that was reached, with damping of joints that MuJoCo treats implicitly
        acceleration = J @ ((data.qvel - before) / self.dt) + b
        self._advance(acceleration, right, G)
        self.wrench = -(inertia @ acceleration + force)
        if flight is not None and not flight.is_held(data):
            flight.rest(data)
            flight.keep(data, self.dt, self._gravity, *self._moved(), given)

    def _moved(self) -> tuple[Array, Array]:
        """M_a and G_a'e, which give the momenta of the deformation, (6, 6) and (6,)."""
        k = len(self.a)
        integrals = self._integrals @ np.stack([self.a, self.e], axis=1)
        C = np.dot(self.a, integrals[: 9 * k].reshape(9, k, 2))
        F, moving = C[:, 1].reshape(3, 3), self.small.G.T @ self.e
        moving[3:] += F[1, 2] - F[2, 1], F[2, 0] - F[0, 2], F[0, 1] - F[1, 0]
        return _added(integrals[9 * k :, 0], C[:, 0])[0], moving

    def _known(self, spin: Array, g: Array) -> tuple[Array, Array, Array, Array]:
        """M_a - G_a'S^-1 G_a, G_a'S^-1 r + v, r and G_a at the middle of the step."""
        h, a, e, k = self.dt, self.a, self.e, len(self.a)
        middle, turns, load = np.empty((k, 2)), self._turns, np.empty(12)  # a and e there
        middle[:, 1] = e + self._past / 2
        middle[:, 0] = a + h / 2 * e + h / 4 * self._past
        x, y, z = (spin + h / 2 * self._rate).tolist()
        W = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
        square = W @ W
        turns[0], turns[1] = square.ravel(), 2 * W.ravel()
        integrals = self._integrals @ middle
        pairs, sums = integrals[: 9 * k], integrals[9 * k :]
        turned = (turns @ pairs.reshape(9, 2 * k)).reshape(5, k, 2)
        C = np.dot(middle[:, 0], pairs.reshape(9, k, 2))  # int rho z_k z_l and int rho z_k e_l
        m = sums[:3, 0]
        added, whole = _added(sums[:, 0], C[:, 0])
        G = self.small.G.copy()
        G[:, 3:] += turned[2:, :, 0].T
        load[:3], load[3:] = g, -turns[0]
        right = self._loads @ load - turned[0, :, 0] - turned[1, :, 1] - self._forces @ np.concatenate((a, e))
        pulled = G.T @ self.inverse
        inertia, force = added - pulled @ G, pulled @ right
        moving = sums[3:, 1].reshape(3, 3) + C[:, 1].reshape(3, 3).T  # int rho e_k (r + z)_l
        V = square @ whole + W @ (2 * moving)
        force[:3] += square @ m + W @ (2 * sums[:3, 1])
        force[3:] -= added[3:, :3] @ g
        (_, xy, xz), (yx, _, yz), (zx, zy, _) = V.tolist()
        force[3:] += (zy - yz, xz - zx, yx - xy)
        return inertia, force, right, G

    def _advance(self, acceleration: Array, right: Array, G: Array) -> None:
        change = self.dt * (self.inverse @ (right - G @ acceleration))
        if not np.isfinite(change).all():
            raise ModelError(NOT_FINITE)
        self.a = self.a + self.dt * (self.e + change / 2)
        self.e = self.e + change
        self._past[:], self._rate[:] = change, acceleration[3:]


def _added(sums: Array, C: Array) -> tuple[Array, Array]:
    """M_a (6, 6) and int rho (z r' + r z' + z z') (3, 3) from the integrals of a deformation, (12,) and (9,)."""
    x, y, z = sums[:3].tolist()
    lever, B, inertia = np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))), sums[3:].reshape(3, 3), np.zeros((6, 6))
    whole = B + B.T + C.reshape(3, 3)
    inertia[:3, 3:], inertia[3:, :3], inertia[3:, 3:] = -lever, lever, whole.trace() * EYE - whole
    return inertia, whole


def _mujoco() -> Any:
    """The package. Raises ModelError: it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise ModelError("MuJoCo is not installed; pip install 'softgrasp[mujoco]'") from None
    return mujoco


def _checked_body(mujoco: Any, model: Any, body: str, dt: float) -> int:
    """Number of the body. Raises ModelError: there is none, or method, solver or step do not fit."""
    number = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body))
    if number < 0:
        names = [model.body(i).name for i in range(1, model.nbody)]
        raise ModelError(f"the MuJoCo model has no body '{body}'; it has {', '.join(n for n in names if n) or 'none'}")
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        raise ModelError('the MuJoCo model steps by another method than Euler\'s; set <option integrator="Euler"/>')
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS or model.opt.noslip_iterations > 0:
        raise ModelError(
            "the dual solvers of MuJoCo (PGS, noslip) keep the inertia without the tissue and find wrong forces; "
            'set <option solver="Newton" noslip_iterations="0"/>'
        )
    if not abs(model.opt.timestep - dt) <= 1e-12 * dt:
        raise ModelError(f"the step of the MuJoCo model is {model.opt.timestep:g} s and dt = {dt:g} s; make them equal")
    return number


def inertial(M: Array) -> str:
    """MuJoCo's element of a rigid mass matrix about the origin (6, 6)."""
    m = M[0, 0]
    c = np.array([M[1, 5], M[2, 3], M[0, 4]]) / m  # the upper right block is -m [c]x
    about = M[3:, 3:] - m * (c @ c * np.eye(3) - np.outer(c, c))
    full = [about[0, 0], about[1, 1], about[2, 2], about[0, 1], about[0, 2], about[1, 2]]
    place, numbers = (" ".join(f"{x:.17g}" for x in v) for v in (c, full))
    return f'<inertial pos="{place}" mass="{m:.17g}" fullinertia="{numbers}"/>'


def mujoco_body(rom: TurningModel, name: str = "hand", joint: str = "<freejoint/>", inside: str = "") -> str:
    """The hand with its rigid tissue as a ``<body>``, whose origin is the reference point of the scene's hand.

    Args:
        rom: model in the frame of the hand, in space.
        name: name of the body; that of the tissue has ``_tissue`` behind it.
        joint: elements of its joints.
        inside: further elements, such as geoms.

    Raises ModelError: the model is plane.
    """
    if len(rom.M_hand) != 6:
        raise ModelError("the model is plane; MuJoCo needs one of three dimensions")
    rigid = rom.at(1.0).rigid
    return (
        f'<body name="{name}">{joint}{inertial(rom.M_hand)}{inside}'
        f'<body name="{name}_tissue">{inertial(rigid)}</body></body>'
    )


def write_mujoco(rom: TurningModel, path: str | Path, dt: float = 1e-3) -> Path:
    """Write a MuJoCo model of the free hand with its rigid tissue, to be simulated or included. Not collective.

    Raises:
        ModelError: the model is plane.
        ResourceError: the file cannot be written.
    """
    gravity = np.zeros(3) if rom.gravity is None else rom.gravity[:3]
    body = (
        mujoco_body(rom).replace("><", ">\n      <").replace("\n      </body>\n      </body>", "</body>\n    </body>")
    )
    text = (
        '<mujoco model="softgrasp">\n'
        f'  <option timestep="{dt:.17g}" gravity="{" ".join(f"{x:.17g}" for x in gravity)}" integrator="Euler" '
        'solver="Newton"/>\n'
        "  <!-- the origin of the body is the reference point of the hand; for softgrasp.bridges.MujocoTissue -->\n"
        f"  <worldbody>\n    {body}\n  </worldbody>\n</mujoco>\n"
    )
    path = Path(path)
    unfinished = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_text(text)
        unfinished.replace(path)
    except OSError as error:
        raise ResourceError(f"{path} cannot be written ({error.strerror or error}); name another file") from error
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
    return path
