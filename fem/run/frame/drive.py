"""The hand that turns by any angle: on a path that is known, or free under forces and what the tissue does to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.frame.balance import HandBalance, HandPlace, no_travel, still
from softgrasp.fem.frame.integrals import in_space
from softgrasp.fem.frame.path import LARGEST_TURN, PathSteps, mean_wrench, world_outputs
from softgrasp.fem.frame.rotation import cross_matrix, freedoms, left_jacobian, spatial
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.frame.midpoint import FreeTurn, GivenTurn, TurningStep
from softgrasp.fem.run.midpoint import Feedback, TissueMidpoint, TissueState
from softgrasp.fem.run.motion import Force, force_values, motion_table
from softgrasp.fem.system import BlockSystem

if TYPE_CHECKING:
    from softgrasp.fem.model.outputs import Output
    from softgrasp.fem.scene.scene import Scene


class TurningDrive(ABC):
    """A hand that turns, whatever moves it.

    Attributes:
        q: [p; theta] of the hand, displacement and rotation vector, (steps + 1, n_s) [m, rad].
        v: [p'; omega], both in the axes of space, (steps + 1, n_s) [m/s, rad/s].
        c: mean velocity of each step in the hand's axes, (steps, n_s) [m/s, rad/s].
        u: force and torque of each step in the axes of space, (steps, n_s) [N, N m]; None where the path is prescribed.
    """

    u: Array | None

    def __init__(self, system: BlockSystem, dt: float, q: Array, v: Array) -> None:
        self.system, self.dt, self.q, self.v = system, dt, q, v
        self.free = freedoms(system.layout.dimension)
        self.c = np.zeros((len(q) - 1, q.shape[1]))
        self.g = np.zeros(3)
        self.g[: system.layout.dimension] = system.fall[: system.layout.dimension]

    def place(self, n: int) -> HandPlace:
        """The hand at a step."""
        return HandPlace.of(spatial(self.q[n]), spatial(self.v[n]))

    @abstractmethod
    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One step of tissue and hand. Collective."""

    @abstractmethod
    def check(self, begin: int, end: int) -> None:
        """Check the forces of these steps. Raises SolverError: one is not finite."""

    def adopt(self, n: int, midpoint: TissueMidpoint) -> None:
        """Give the tissue's step the angular velocity of the hand where a run starts."""
        assert isinstance(midpoint, TurningStep)
        midpoint.spin = self.place(n).xi[3:]

    def as_it_hangs(self) -> BlockSystem:
        """The system under gravity as it acts in the axes of the hand where the motion begins."""
        fall = np.concatenate([self.place(0).Q.T @ self.g, np.zeros(3)])[self.free]
        return self.system if self.system.gravity is None else replace(self.system, gravity=fall)

    def world(self, outputs: Sequence[Output], linear: Array, z: Array) -> tuple[Array, Array]:
        """Outputs of tissue that moves rigidly with the hand, and of the tissue, in space, (steps + 1, p) [m, rad].

        Args:
            linear: C_s q_s, the former for small rotations, (steps + 1, p).
            z: displacement against the hand, in its axes, (steps + 1, p).
        """
        sizes = [output.size for output in outputs]
        return world_outputs(sizes, self.system.layout.dimension, self.q, linear, z)

    def wrench(self, rows: Array) -> Array:
        """Mean wrench that each step requires, see :func:`softgrasp.fem.frame.path.mean_wrench`, (steps, n_s)."""
        system = self.system
        heavy = system.M_hand if system.hand_weight else np.zeros_like(system.M_hand)
        masses = system.M_hand, system.M_rigid, heavy
        return mean_wrench(masses, self.g, self.dt, self.q, self.v, rows)


class PathDrive(TurningDrive):
    """A prescribed path; the turn of a step is that between its ends, its accelerations are mean ones.

    Raises SceneError: the hand turns too far in a step.
    """

    u: Array | None = None

    def __init__(self, system: BlockSystem, dt: float, q: Array, v: Array, midpoint: TurningStep) -> None:
        super().__init__(system, dt, q, v)
        self.steps = PathSteps.of(q, v, dt, self.g, system.layout.dimension)
        self.c = self.steps.mean
        midpoint.spin = self.steps.spins[0]

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One step of the tissue. Collective."""
        assert isinstance(midpoint, TurningStep)
        steps = self.steps
        midpoint.go(GivenTurn(steps.turns[n], midpoint.frame_load(steps.felt[n], steps.squared[n])))
        midpoint.spin = steps.spins[n + 1]

    def check(self, begin: int, end: int) -> None:
        """Nothing to look at: tables are checked when they are read."""


class FreeDrive(TurningDrive):
    """A hand under forces: force in the axes of space, torque about the reference point. Making one is collective."""

    u: Array

    def __init__(
        self, system: BlockSystem, force: Force, midpoint: TurningStep, steps: int, q0: Array, v0: Array
    ) -> None:
        n_s = system.layout.n_s
        super().__init__(system, midpoint.dt, np.zeros((steps + 1, n_s)), np.zeros((steps + 1, n_s)))
        self.q[0], self.v[0], self.force, self.u = q0, v0, force, np.zeros((steps, n_s))
        heavy = (system.M_hand if system.hand_weight else np.zeros((n_s, n_s))) + system.M_rigid * system.two_way
        M = system.M_hand + system.M_rigid * system.two_way
        self.balance = HandBalance(in_space(M), in_space(heavy), self.g, self.free, self.dt)
        self.feedback: Feedback | None = None
        if system.two_way:
            midpoint.make_responses()
            self.feedback = Feedback(midpoint.s**2 * np.linalg.inv(M), midpoint.G, np.zeros(n_s))
        midpoint.spin = self.place(0).xi[3:]

    def solve(self, n: int, midpoint: TissueMidpoint, state: TissueState) -> None:
        """One step of tissue and hand. Collective."""
        assert isinstance(midpoint, TurningStep)
        hand = self.place(n)
        u = np.asarray(self.force(n, (n + 0.5) * self.dt, self.q[n], self.v[n]), dtype=float)
        if u.shape != self.u[n].shape:
            raise SceneError(
                f"the force has shape {u.shape}; return {len(self.u[n])} numbers, one per hand degree of freedom"
            )
        self.u[n] = u
        guess = hand.xi if n == 0 else np.where(hand.xi != 0, 2 * hand.xi - self._mean(n - 1), 0.0)
        if self.system.two_way:
            turn: FreeTurn | GivenTurn = FreeTurn(self.balance, hand, midpoint.sums(), spatial(u), hand.xi)
            midpoint.go(turn, self.feedback)
            assert isinstance(turn, FreeTurn)
            xi = turn.xi
        else:
            xi = self.balance.velocity(hand, still(), no_travel(), spatial(u), guess)
            fall = (np.eye(3) - self.dt / 2 * cross_matrix(xi[3:])) @ hand.Q.T @ self.g
            load = midpoint.inertia_load(xi, 2 / self.dt * (xi - hand.xi), fall)
            midpoint.go(GivenTurn(xi[3:], load))
        if not np.linalg.norm(xi[3:]) * self.dt <= LARGEST_TURN:
            raise SolverError(
                f"the hand turns by {np.linalg.norm(xi[3:]) * self.dt:.2g} rad in step {n + 1}, at most {LARGEST_TURN} "
                "is possible; use more time.steps"
            )
        moved = hand.moved(xi, self.dt)
        self.c[n] = xi[self.free]
        self.q[n + 1], self.v[n + 1] = moved.q[self.free], moved.v[self.free]
        midpoint.spin = self.place(n + 1).xi[3:]  # as after a restart, bit by bit

    def _mean(self, n: int) -> Array:
        full = np.zeros(6)
        full[self.free] = self.c[n]
        return full

    def check(self, begin: int, end: int) -> None:
        """Raises SolverError: a force in these steps is not finite; the message names the first."""
        for i, j in np.argwhere(~np.isfinite(self.u[begin:end]))[:1]:
            raise SolverError(
                f"the force on the hand is {self.u[begin + i, j]} in step {begin + i + 1}; it must be finite"
            )


def make_turning_drive(
    system: BlockSystem, scene: Scene, midpoint: TissueMidpoint, force: Force | None
) -> TurningDrive:
    """The hand of a scene, or one under a force u = force(n, t_mid, q_s, v_s) in the axes of space. Collective.

    Raises SceneError: a CSV file does not fit, or the hand turns too far in a step.
    """
    assert isinstance(midpoint, TurningStep)
    n_s, d, dt, steps = system.layout.n_s, system.layout.dimension, midpoint.dt, scene.time.steps
    zero = np.zeros(n_s)
    if force is not None:
        return FreeDrive(system, force, midpoint, steps, zero, zero)
    if scene.motion.drive == "force":
        u = force_values(scene, n_s, system.M_hand)
        return FreeDrive(system, lambda n, t, q, v: u[n], midpoint, steps, zero, zero)
    return PathDrive(system, dt, *turning_path(motion_table(scene, n_s).q, motion_table(scene, n_s).v, d), midpoint)


def turning_path(q: Array, rate: Array, d: int) -> tuple[Array, Array]:
    """Q_s and v_s = [p'; omega] from a table of q_s = [p; theta] and its rate [p'; theta'], (steps + 1, n_s) each."""
    if d == 2:
        return q, rate
    v = rate.copy()
    v[:, 3:] = np.einsum("nij,nj->ni", left_jacobian(q[:, 3:]), rate[:, 3:])
    return q, v
