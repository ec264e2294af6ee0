"""Reduced models of tissue in the frame of a hand that turns by any angle, at small strain: z = Phi a.

    M a'' + D a' + K a = -G [A - g; Omega'] - S : (Omega x)^2 - 2 E(Omega x) a' - [E(Omega' x) + E((Omega x)^2)] a

in the axes of the hand, with velocity [V; Omega], acceleration A = V' + Omega x V and gravity g there. The integrals S
(d^2 numbers a mode: centrifugal load) and E (d^2 numbers a pair of modes: Coriolis and Euler loads, and the centrifugal
one of what is deformed) are affine in the densities, as K and D are in lambda, mu and beta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg

from softgrasp.fem.frame.balance import HandBalance, HandPlace
from softgrasp.fem.frame.integrals import in_space
from softgrasp.fem.frame.path import LARGEST_TURN, PathSteps, mean_wrench, world_outputs
from softgrasp.fem.frame.rotation import freedoms, rotation_matrix, spatial
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial, in_words
from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Card, Shown, amount, counted, listed
from softgrasp.reduction.model import check_materials
from softgrasp.reduction.online import ReducedTrajectory, checked_hand
from softgrasp.reduction.operators import Parameters, Parts
from softgrasp.reduction.system import ModelError, Outputs
from softgrasp.reduction.turning.stepper import TurningMatrices, TurningSteps

Force = Callable[[int, float, Array, Array], Array]
"""force(n, t_mid, q_s, v_s) on the hand in the axes of space, (n_s,) [N, N m]."""


@dataclass(frozen=True, repr=False)
class TurningRun(ReducedTrajectory):
    """A run in the frame of the hand, x = [q_s, v_s, a, a'] with q_s = [p; theta] and v_s = [p'; omega] in space."""

    outputs_rigid: Array
    """Outputs of tissue that moves rigidly with the hand, in space [m, rad], (steps + 1, p)."""
    force: Array
    """Mean force and torque on the hand in each step, in the axes of space [N, N m], (steps, n_s)."""
    stored: Array = field(repr=False)
    """Energy a'K a / 2 + int rho |y|^2 / 2 of the tissue at every instant [J], (steps + 1,)."""
    rows: Array = field(repr=False)
    """Numbers of :class:`softgrasp.fem.frame.integrals.Sums` at every instant, (steps + 1, m)."""
    caution: str = ""
    """Reason why the linear law does not serve the run, a sentence; empty where it does."""

    @property
    def energy(self) -> Array:
        """Energy of the tissue [J], (steps + 1,)."""
        return self.stored

    @property
    def a(self) -> Array:
        """Coordinates of the deformation, (steps + 1, k)."""
        return np.split(self.x[:, 2 * self.q_s.shape[1] :], 2, axis=1)[0]

    @property
    def v(self) -> Array:
        """Their rates in the axes of the hand, (steps + 1, k)."""
        return np.split(self.x[:, 2 * self.q_s.shape[1] :], 2, axis=1)[1]

    def card(self) -> Card:
        """Steps, dimension, outputs, turn."""
        d = 2 if self.q_s.shape[1] == 3 else 3
        turn = float(np.linalg.norm(self.q_s[:, d:], axis=1).max())
        rows = (
            ("time", f"{counted(len(self.times) - 1, 'step')} to {amount(self.times[-1], 's')}"),
            ("dimension", f"N = {self.x.shape[1]}"), ("turn", f"up to {amount(turn, 'rad')}"),
            ("outputs", listed(self.output_names)), *([("caution", self.caution)] if self.caution else []),
        )  # fmt: skip
        return Card("Trajectory in the frame of the hand", rows)


@dataclass(frozen=True, repr=False)
class TurningSystem(Shown):
    """A model at one set of materials and one step."""

    model: TurningModel
    """Reduced model that it was made from."""
    small: TurningMatrices
    """Small matrices at the materials."""
    rigid: Array
    """Inertia of the tissue that moves rigidly with the hand, (n_s, n_s)."""
    dt: float
    """Step [s]."""
    gravity: Array
    """Gravity in space, (3,) [m/s^2]."""

    def equilibrium(self, q: Array) -> Array:
        """Coordinates under gravity as it acts in the axes of a hand at q = [p; theta] (n_s,), (k,)."""
        d, fall = len(self.small.E), rotation_matrix(spatial(q)[3:]).T @ self.gravity
        return np.asarray(scipy.linalg.solve(self.small.K, self.small.G[:, :d] @ fall[:d], assume_a="pos"))

    def run(
        self,
        hand: tuple[Array, Array] | None = None,
        force: Force | None = None,
        steps: int = 0,
        start: str = "rest",
    ) -> TurningRun:
        """Midpoint steps [HLW06] under a known hand, or of a free one under a force. Online; not collective.

        Args:
            hand: q_s = [p; theta] and v_s = [p'; omega] in space, (steps + 1, n_s) each; or
            force: u(n, t_mid, q_s, v_s) in the axes of space, (n_s,), on a hand at rest.
            steps: number of steps under a force.
            start: "rest", or "equilibrium" under gravity.

        Raises:
            ModelError: neither or both of hand and force are given, or shapes do not fit.
            SceneError: the hand turns by more than 0.5 rad in a step.
            SolverError: a step did not converge.
        """
        if (hand is None) == (force is None):
            raise ModelError("give either the motion of the hand or the force on it")
        model, n_s, d = self.model, self.small.G.shape[1], len(self.small.E)
        if hand is not None:
            q, v = checked_hand(hand, n_s)
            steps = len(q) - 1
        else:
            if steps < 1:
                raise ModelError(f"steps = {steps}: a run under a force has at least one step")
            q, v = np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s))
        zero = np.zeros(model.k)
        a0 = self.equilibrium(q[0]) if start == "equilibrium" else zero
        first = HandPlace.of(spatial(q[0]), spatial(v[0])).xi[3:]
        march = TurningSteps(self.small, self.dt, a0, zero, first)
        if hand is not None:
            x, spins = self._led(march, q, v)
            u = None
        else:
            assert force is not None
            x, spins, u = self._free(march, q, v, force)
        k = model.k
        a, rate, stored, rows = x[:, :k], x[:, k : 2 * k], x[:, 2 * k], x[:, 2 * k + 1 :]
        rigid, y = world_outputs(model.sizes, d, q, q @ model.outputs.C_s.T, a @ model.outputs.C_z.T)
        if u is None:
            heavy = model.M_hand if model.hand_weight else np.zeros_like(model.M_hand)
            u = mean_wrench((model.M_hand, self.rigid, heavy), self.gravity, self.dt, q, v, rows)
        return TurningRun(
            self.dt * np.arange(steps + 1.0), np.hstack([q, v, a, rate]), q, v, y, model.outputs.names,
            rigid, u, stored, rows, self._caution(spins),
        )  # fmt: skip

    def _kept(self, march: TurningSteps, spin: Array) -> Array:
        return np.concatenate([march.a, march.rate(spin), [march.energy()], march.row()])

    def _led(self, march: TurningSteps, q: Array, v: Array) -> tuple[Array, Array]:
        """States of a run under a known hand, and its angular velocities."""
        path = PathSteps.of(q, v, self.dt, self.gravity, len(self.small.E))
        kept = [self._kept(march, path.spins[0])]
        for n, turn in enumerate(path.turns):
            march.known(turn, path.felt[n], path.squared[n])
            kept.append(self._kept(march, path.spins[n + 1]))
        return np.array(kept), path.spins

    def _free(self, march: TurningSteps, q: Array, v: Array, force: Force) -> tuple[Array, Array, Array]:
        """States of a run of a free hand, whose rows q and v are filled, angular velocities and forces."""
        model, steps, n_s = self.model, len(q) - 1, q.shape[1]
        if not model.two_way:
            raise ModelError("a free hand in its own frame feels the tissue; set effects.reaction = true")
        heavy = self.rigid + (model.M_hand if model.hand_weight else 0.0)
        free = freedoms(len(self.small.E))
        balance = HandBalance(in_space(model.M_hand + self.rigid), in_space(heavy), self.gravity, free, self.dt)
        u, place = np.zeros((steps, n_s)), HandPlace.of(np.zeros(6), np.zeros(6))
        kept, spins, last = [self._kept(march, place.xi[3:])], [place.xi[3:]], place.xi
        for n in range(steps):
            u[n] = force(n, (n + 0.5) * self.dt, q[n], v[n])
            if not np.isfinite(u[n]).all():
                raise ModelError(f"the force on the hand in step {n + 1} is {u[n]}; it must be finite")
            xi = march.free(balance, place, spatial(u[n]), 2 * place.xi - last if n else place.xi)
            if not np.linalg.norm(xi[3:]) * self.dt <= LARGEST_TURN:
                raise ModelError(
                    f"the hand turns by {np.linalg.norm(xi[3:]) * self.dt:.2g} rad in step {n + 1}, at most "
                    f"{LARGEST_TURN} is possible; use a shorter step"
                )
            place, last = place.moved(xi, self.dt), xi
            q[n + 1], v[n + 1] = place.q[free], place.v[free]
            kept.append(self._kept(march, place.xi[3:]))
            spins.append(place.xi[3:])
        return np.array(kept), np.array(spins), u

    def _caution(self, spins: Array) -> str:
        """A sentence where the hand spins so fast that the linear law has no stiffness left, else empty."""
        fastest = spins[int(np.argmax(np.linalg.norm(spins, axis=1)))]
        left = scipy.linalg.eigh(self.small.spun(fastest), self.small.M, eigvals_only=True, subset_by_index=[0, 0])
        if left[0] > 0:
            return ""
        return (
            f"the hand spins at {np.linalg.norm(fastest):.3g} rad/s, where the centrifugal load exceeds the linear "
            f"stiffness (lowest frequency {self.small.bending():.3g} rad/s), which knows no stiffening by tension: the "
            "tissue grows without bound; use effects.finite_strain"
        )


@dataclass(frozen=True, repr=False)
class TurningModel(Shown):
    """Tissue in the frame of a hand that turns by any angle, in few coordinates, for all materials.

    >>> import softgrasp as sg
    >>> model = sg.build("turn_over", ["tissue.cells=[4, 8]", "effects.finite_strain=false", "time.steps=100"])
    >>> rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=26)
    >>> rom.k, type(rom).__name__
    (10, 'TurningModel')
    """

    name: str
    """Name of the basis."""
    parts: Parts
    """Integrals by name at unit material, with a leading axis of the layers: K_mu, K_lambda, G, S, E, rigid."""
    M_hand: Array
    """Mass matrix of the hand, (n_s, n_s)."""
    materials: tuple[LayerMaterial, ...]
    """Materials of the projection, one a layer."""
    outputs: Outputs
    """Outputs of the scene against the hand, z = C_z a, and C_s of small rotations."""
    sizes: tuple[int, ...]
    """Number of components of each output."""
    alpha: float = 0.0
    """Mass-proportional damping [1/s]."""
    damped: bool = False
    """Whether damping terms exist."""
    hand_weight: bool = False
    """Whether gravity acts on the hand's own mass."""
    two_way: bool = False
    """Whether the hand feels the tissue."""
    gravity: Array | None = None
    """Acceleration of free fall in space in the hand's degrees of freedom, (n_s,) [m/s^2], or None."""
    layout: BlockLayout | None = None
    """Distribution of the mesh's rows in Phi, or None."""
    Phi: Array | None = None
    """Reconstruction z = Phi a, local rows (n_local, k), or None."""
    scene_hash: str = ""
    """Hash of the scene it was made for."""
    origin: dict[str, Any] = field(default_factory=dict)
    """Keys of the scene that decide on a run, see `reduction.origin`; {} for none."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Offline time by stage [s]."""

    @property
    def k(self) -> int:
        """Coordinates of the deformation."""
        return int(self.parts["G"].shape[1])

    @property
    def N(self) -> int:
        """Dimension of the first-order model, the hand's 2 n_s included."""
        return 2 * (self.k + len(self.M_hand))

    def card(self) -> Card:
        """Dimension, materials, outputs."""
        rows = (
            ("dimension", f"N = {self.N}, {counted(self.k, 'mode')}"), ("material", in_words(self.materials)),
            ("outputs", listed(self.outputs.names)),
        )  # fmt: skip
        return Card(f"TurningModel {self.name}", rows)

    def at(
        self, dt: float, materials: tuple[LayerMaterial, ...] | None = None, gravity: Array | None = None
    ) -> TurningSystem:
        """The model at materials, gravity and a step. Online; not collective.

        Args:
            dt: step [s].
            materials: one a layer; None: those of the projection.
            gravity: acceleration of free fall in space (n_s,) [m/s^2]; None: that of the scene.

        Raises ModelError: dt is no positive number, or the materials are none of such tissue.
        """
        if not (np.isfinite(dt) and dt > 0):
            raise ModelError(f"dt = {dt:g} s must be a positive number")
        materials = self.materials if materials is None else materials
        check_materials(materials, self.materials, self.damped)
        p, parts = Parameters(materials), self.parts
        E = p.density(parts["E"])
        M = np.trace(E)
        D = p.viscosity(parts["K_mu"], parts["K_lambda"]) + self.alpha * M
        K = p.stiffness(parts["K_mu"], parts["K_lambda"])
        g, own = np.zeros(3), self.gravity if gravity is None else np.asarray(gravity, dtype=float)
        if own is not None:
            g[: len(E)] = own[: len(E)]
        small = TurningMatrices(M, K, D, p.density(parts["G"]), p.density(parts["S"]), E)
        return TurningSystem(self, small, p.density(parts["rigid"]), dt, g)

    def reconstruct(self, a: Array) -> Array:
        """Displacements z = Phi a against the hand, in its axes, of coordinates (m, k), local rows (n_local, m) [m].

        Raises ModelError: the model was loaded without its basis.
        """
        if self.Phi is None:
            raise ModelError("the model has no basis on the mesh; load it with the layout of its mesh", self.name)
        return np.asarray(self.Phi @ a.T)
