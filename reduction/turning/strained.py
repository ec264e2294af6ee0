"""Reduced models at finite strain in the frame of a hand that is led and turns by any angle: z = Phi a, Phi' M Phi = I.

    a'' + D a' + dW_r/da = -G [A - g; Omega'] - S : (Omega x)^2 - 2 E(Omega x) a' - [E(Omega' x) + E((Omega x)^2)] a

with W_r on sampled cells (`reduction.strain`) and the integrals S and E of `model.py`, at the densities of the
projection. A step is that of `stepper.py` with the discrete gradient of W_r instead of K (a + w): the balance of energy

    W_r + int rho |y|^2 / 2  changes by  2 w'l - 2 s w'D w + 2 int rho (O z_mid) . (s^2 u - s y_n + s^2 O u),

u = w + O z_mid, y_{n+1} = 2 s u - y_n, the last of it the work of the hand that turns the tissue, to the tolerance of
the solve.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from softgrasp.fem.frame.path import PathSteps, mean_wrench, world_outputs
from softgrasp.fem.frame.rotation import cross_matrix, rotation_matrix, spatial
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card
from softgrasp.reduction.online import checked_hand
from softgrasp.reduction.strain.cells import Cells
from softgrasp.reduction.strain.indicator import Finer, estimated_error
from softgrasp.reduction.strain.model import (
    LOAD_SLACK,
    TOLERANCE,
    ReducedStrainSystem,
    StrainModel,
    StrainRun,
    coordinates,
    refuse,
)
from softgrasp.reduction.strain.stepper import StepSolver, StrainProblem
from softgrasp.reduction.system import ModelError
from softgrasp.reduction.turning.stepper import TurningMatrices, TurningSteps


@dataclass(frozen=True)
class TurningFiner(Finer):
    """The space in which answers are checked, with its pair integrals."""

    S: Array  # integrals int rho phi_k r_l, (K, d^2)
    E: Array  # pair integrals, (d, d, K, K)


@dataclass(frozen=True, repr=False, kw_only=True)
class TurningStrainRun(StrainRun):
    """A reduced run at finite strain under a hand that turns; q_s, v_s, outputs and force in the axes of space."""

    outputs_rigid: Array
    """Outputs of tissue that moves rigidly with the hand [m, rad], (steps + 1, p)."""
    force: Array
    """Mean force and torque on the hand in each step [N, N m], (steps, n_s)."""
    rows: Array = field(repr=False)
    """Numbers of :class:`softgrasp.fem.frame.integrals.Sums` at every instant, (steps + 1, m)."""
    kinetic: Array = field(repr=False)
    """Energy int rho |y|^2 / 2 of the tissue beside its rigid motion, (steps + 1,) [J]."""
    works: Array = field(repr=False)
    """Work of load and turning hand, and loss, in each step, (steps, 2) [J]."""
    path: PathSteps = field(repr=False)
    """Motion of the hand as the tissue feels it."""

    @cached_property
    def energy(self) -> Array:
        """Energy W_r + int rho |y|^2 / 2 of every state [J], (steps + 1,)."""
        return np.asarray(self.small.problem.potential.energy(self.a) + self.kinetic)

    @cached_property
    def energy_drift(self) -> float:
        """Largest |E_n - E_0 - work + loss| over the largest of the four seen, dimensionless."""
        work, lost = np.vstack([np.zeros(2), np.cumsum(self.works, axis=0)]).T
        defect = np.abs(self.energy - self.energy[0] - work + lost).max()
        scale = max(float(np.abs(x).max()) for x in (self.energy, work, lost))
        return float(defect) / scale if scale > 0 else 0.0

    @cached_property
    def error_estimate(self) -> float:
        """Estimate, no bound, of |Z - Phi A|_F / |Z|_F against the full run, see `strain/indicator.py`."""
        problem, finer = self.small.finer, self.small.model.finer
        if problem is None or not isinstance(finer, TurningFiner):
            return float("nan")
        path, d = self.path, len(finer.E)
        load = -path.felt @ finer.G.T - path.squared.reshape(-1, d * d) @ finer.S.T
        weight = finer.G @ self.small.fall(self.q_s[0])
        s, (a, v) = 2 / problem.dt, coordinates(self)
        more = [(0, 0), (0, len(finer.G) - a.shape[1])]
        a, v = np.pad(a, more), np.pad(v, more)
        W = cross_matrix(path.turns)[:, :d, :d]
        rate = cross_matrix(np.diff(path.spins, axis=0) / problem.dt)[:, :d, :d]

        def turned(H: Array, x: Array) -> Array:
            return np.asarray(np.einsum("nkl,klij,nj->ni", H, finer.E, x, optimize=True))

        w, middle, Q = np.diff(a, axis=0) / 2, (a[1:] + a[:-1]) / 2, W / s  # Q: turns of a step, (Omega x) / s
        first = cross_matrix(path.spins[:1])[:, :d, :d]
        u, momentum = w + turned(Q, middle), np.zeros_like(a)
        momentum[0] = v[0] + turned(first, a[:1])[0]
        for n, each in enumerate(u):
            momentum[n + 1] = 2 * s * each - momentum[n]
        inertia = s * s * (u + turned(Q, w) + turned(Q @ Q, middle)) - s * momentum[:-1]

        def turning(at: np.ndarray) -> tuple[Array, Array, Array]:
            gyro, spun = (np.tensordot(H, finer.E, 2) for H in (2 * W[at], rate[at] + W[at] @ W[at]))
            return inertia[at], gyro, spun

        return estimated_error(problem, finer.gram, load, weight, coordinates(self), turning)

    def card(self) -> Card:
        """Steps, dimension, outputs, turn."""
        d = 2 if self.q_s.shape[1] == 3 else 3
        card = super().card()
        turn = float(np.linalg.norm(self.q_s[:, d:], axis=1).max())
        return replace(card, rows=(*card.rows, ("turn", f"up to {turn:.3g} rad")))


class StrainedSteps(TurningSteps):
    """Steps of one run under a known hand, with the discrete gradient of a potential instead of K (a + w)."""

    def __init__(
        self, problem: StrainProblem, small: TurningMatrices, a: Array, spin: Array, tol: float, engine: str
    ) -> None:
        super().__init__(small, problem.dt, a, np.zeros_like(a), spin)
        self.inertial = self.s * small.D + self.s**2 * small.M
        self.solver = StepSolver(problem, tol, engine)

    def known(self, turn: Array, felt: Array, squared: Array) -> Array:
        """A step under a known hand; work of load and turning hand and loss in it, (2,) [J].

        Raises SolverError: no convergence.
        """
        small, s = self.small, self.s
        load = -(small.G @ felt) - small.S @ squared.ravel()
        H = self._matrix(turn) / s
        once, twice = small.turned(H), small.turned(H @ H)
        h = s * np.trace(self.Y) + load - s * s * ((once + twice) @ self.a)
        w = self.solver.solve(self.a, self.inertial + s * s * (2 * once + twice), h)
        middle = self.a + w
        U = self._pairs(w, H, middle)
        pulled = s * s * (U + H @ U) - s * self.Y
        turning = 2 * float(np.sum(H * (pulled @ middle).T))
        self._advance(w, turn)
        return np.array([2 * float(w @ load) + turning, 2 * s * float(w @ small.D @ w)])


@dataclass(frozen=True, repr=False)
class TurningStrainSystem(ReducedStrainSystem):
    """A model at one parameter and one time step."""

    model: TurningStrainModel

    @property
    def space_gravity(self) -> Array:
        """Gravity in space, (3,) [m/s^2]."""
        g, d = np.zeros(3), len(self.model.E)
        g[:d] = self.gravity[:d]
        return g

    def fall(self, q: Array | None) -> Array:
        """Free fall in the axes of a hand at q = [p; theta] (n_s,), (n_s,)."""
        d, n_s = len(self.model.E), self.model.G.shape[1]
        turned = rotation_matrix(spatial(np.zeros(n_s) if q is None else q)[3:]).T @ self.space_gravity
        return np.concatenate([turned[:d], np.zeros(n_s - d)])

    def run(
        self,
        hand: tuple[Array, Array] | None = None,
        *,
        force: Array | None = None,
        a0: Array | None = None,
        tol: float = TOLERANCE,
        engine: str = "",
    ) -> TurningStrainRun:
        """Run under a hand that is led; online, not collective.

        Args:
            hand: q_s = [p; theta] and v_s = [p'; omega] in space, (steps + 1, n_s) each.
            force: refused: a hand that a force moves needs the linear law.
            a0: start at rest, (k,); None is the undeformed body.
            tol: residual of a step over the largest load seen.
            engine: see :func:`softgrasp.reduction.strain.stepper.march_strain`.

        Raises:
            ModelError: the hand is not led, shapes do not fit, or the hand or the run leaves the training box.
            SceneError: the hand turns by more than 0.5 rad in a step.
            SolverError: a step did not converge.
        """
        model, problem, d = self.model, self.problem, len(self.model.E)
        if hand is None or force is not None:
            raise ModelError(
                "a model at finite strain in the frame of the hand runs under a hand that is led; give hand=(q_s, v_s) "
                "and no force, or reduce the scene with effects.finite_strain = false for a free hand"
            )
        q, v = checked_hand(hand, model.G.shape[1])
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            raise ModelError("the hand's tables contain numbers that are not finite")
        path = PathSteps.of(q, v, problem.dt, self.space_gravity, d)
        untrained = model.box.refuse(self.materials) or self._refuse_motion(path)
        refuse(untrained, self.outside)
        small = TurningMatrices(np.trace(model.E), problem.K, problem.D, model.G, model.S, model.E)
        march = StrainedSteps(problem, small, np.zeros(model.k) if a0 is None else a0, path.spins[0], tol, engine)

        def state(spin: Array) -> Array:
            return np.concatenate([march.a, march.rate(spin), [march.kinetic], march.row()])

        kept, works = [state(path.spins[0])], np.zeros((len(q) - 1, 2))
        for n, turn in enumerate(path.turns):
            works[n] = march.known(turn, path.felt[n], path.squared[n])
            kept.append(state(path.spins[n + 1]))
        a, rate, kinetic, rows = np.split(np.array(kept), [model.k, 2 * model.k, 2 * model.k + 1], axis=1)
        untrained = untrained or model.box.refuse_states(a)
        refuse(untrained, self.outside)
        rigid, y = world_outputs(model.sizes, d, q, q @ model.outputs.C_s.T, a @ model.outputs.C_z.T)
        heavy = model.M_hand if model.hand_weight else np.zeros_like(model.M_hand)
        force = mean_wrench((model.M_hand, model.rigid, heavy), self.space_gravity, problem.dt, q, v, rows)
        solver, times = march.solver, problem.dt * np.arange(float(len(q)))
        return TurningStrainRun(
            times, np.hstack([q, v, a, rate]), q, v, y, model.outputs.names, self, path.felt,
            solver.evaluations / max(len(q) - 1, 1), solver.restarts, solver.engine, untrained, outputs_rigid=rigid,
            force=force, rows=rows, kinetic=kinetic[:, 0], works=works, path=path,
        )  # fmt: skip

    def _refuse_motion(self, path: PathSteps) -> str:
        """Why a motion lies outside; empty inside."""
        box, most = self.model.box, float(self.model.box.load[-1, 1])
        speed = float(np.linalg.norm(path.turns, axis=1).max(initial=0.0))
        if speed > most * (1 + LOAD_SLACK):
            return f"the hand turns at {speed:.4g} rad/s, above the {most:.4g} rad/s of the training runs"
        return replace(box, load=box.load[:-1]).refuse_load(path.felt)


@dataclass(frozen=True, repr=False, kw_only=True)
class TurningStrainModel(StrainModel):
    """Reduced model of tissue at finite strain in the frame of a hand that is led; box.load ends in its angular speed.

    >>> import softgrasp as sg
    >>> model = sg.build("turn_over", ["tissue.cells=[4, 8]", "tissue.order=1", "time.steps=100"])
    >>> rom = sg.reduce(model, run := sg.simulate(model), N=16)
    >>> sg.errors(rom, sg.replay(rom, model, run), model, run).z < 1e-2
    True
    """

    S: Array
    """Integrals int rho phi_k r_l, (k, d^2)."""
    E: Array
    """Pair integrals int rho phi_i,k phi_j,l, (d, d, k, k)."""
    M_hand: Array
    """Mass matrix of the hand, (n_s, n_s)."""
    rigid: Array
    """Inertia of the tissue that moves rigidly with the hand, (n_s, n_s)."""
    sizes: tuple[int, ...]
    """Number of components of each output."""
    hand_weight: bool = False
    """Whether gravity acts on the hand's own mass."""

    def at(
        self,
        dt: float,
        materials: tuple[LayerMaterial, ...] | None = None,
        gravity: Array | None = None,
        *,
        outside: bool = False,
    ) -> TurningStrainSystem:
        """The model at new materials and a time step, see :meth:`StrainModel.at`; gravity is that in space."""
        made = super().at(dt, materials, gravity, outside=outside)
        return TurningStrainSystem(self, made.problem, made.materials, made.gravity, outside)

    def leading(self, k: int) -> TurningStrainModel:
        """The model of the first k displacements."""
        made = super().leading(k)
        assert isinstance(made, TurningStrainModel)
        return replace(made, S=self.S[:k], E=np.ascontiguousarray(self.E[:, :, :k, :k]))

    def finer_space(self, cells: Cells, gram: Array) -> TurningFiner:
        """With its integrals."""
        return TurningFiner(cells, self.K_mu, self.K_lambda, self.G, gram, self.S, self.E)

    @staticmethod
    def of(model: StrainModel, **frame: Any) -> TurningStrainModel:
        """A model with the integrals of the frame."""
        return TurningStrainModel(**{f.name: getattr(model, f.name) for f in fields(model)}, **frame)
