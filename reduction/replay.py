"""The full run that reduced runs are compared with, and how reduced runs repeat it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.snapshots import Snapshots
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.system import BlockSystem
from softgrasp.reduction.engines import factor
from softgrasp.reduction.errors import full_energy, shown_rows, state_rows, with_hand
from softgrasp.reduction.model import ReducedModel, SmallModel
from softgrasp.reduction.propagator import Propagator, propagator

REST = 1e-9  # of the largest displacement: a solve for an equilibrium leaves 1e-12, a motion of use far more


@dataclass(frozen=True)
class Reference:
    """The full run that reduced runs are compared with.

    Attributes:
        model: the scene.
        trajectory: the full run.
        snapshots: its states.
        energy: tissue energy of every snapshot [J].
        force: u on the hand that gives its motion, (steps, n_s) [N, N m].
        hand: q_s and v_s at every step, (steps + 1, n_s).
    """

    model: Model
    trajectory: Trajectory
    snapshots: Snapshots
    energy: Array
    force: Array
    hand: tuple[Array, Array]

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return float(self.trajectory.times[1] - self.trajectory.times[0])


def reference(model: Model, trajectory: Trajectory) -> Reference:
    """Bundle a full run with what the comparison needs. Collective.

    Raises:
        SceneError: the run kept no snapshots in memory, or the body is at rest in all of them.
    """
    snapshots = trajectory.snapshots
    if snapshots is None:
        raise SceneError("output.snapshots must be 'memory' for a reduction; bases are built from the states in memory")
    if at_rest(snapshots):
        raise SceneError(
            f"hand and tissue of scene {model.scene.name} stay at rest for the whole run, so there is no motion to "
            "reduce; give a motion.target away from the start, or another time.start"
        )
    force = hand_force(model.system, trajectory, snapshots)
    hand = (trajectory.q_s, trajectory.v_s)
    return Reference(model, trajectory, snapshots, full_energy(model.system, snapshots), force, hand)


def at_rest(snapshots: Snapshots) -> bool:
    """Whether no displacement changes by more than rounding from the first snapshot on. Collective."""
    layout = snapshots.layout
    z = snapshots.Z[: layout.n_local]
    change, size = (
        layout.comm.allreduce(max(float(np.abs(x).max(initial=0.0)) for x in parts), MPI.MAX)
        for parts in ((z - z[:, :1], snapshots.q_s - snapshots.q_s[:, :1]), (z, snapshots.q_s))
    )
    return bool(change <= REST * size)


def hand_force(system: BlockSystem, trajectory: Trajectory, snapshots: Snapshots) -> Array:
    """Force on the hand that gives the motion of the full run under the midpoint rule, (steps, n_s). Collective.

    u = M_hand a [+ M_rigid (a + alpha v - g) + G'(v_z' + alpha v_z)] - M_hand g when the hand weighs, at the midpoints;
    [...] two-way only, alpha only when damping drags in space.

    Raises:
        SceneError: two-way coupling needs every state of the run.
    """
    v, dt = trajectory.v_s, trajectory.times[1] - trajectory.times[0]
    a = np.diff(v, axis=0) / dt
    u = a @ system.M_hand.T
    g = np.zeros(len(system.M_hand)) if system.gravity is None else system.gravity
    if system.hand_weight:
        u -= system.M_hand @ g
    if system.two_way:
        if len(snapshots.steps) != len(trajectory.times):
            raise SceneError("output.every must be 1 with effects.reaction; the force on the hand needs every state")
        alpha = system.damping.alpha if system.damping.in_space else 0.0
        momentum = total(system.layout.comm, system.G.T @ snapshots.Z[system.layout.n_local :]).T
        u += (a + alpha * (v[1:] + v[:-1]) / 2 - g) @ system.M_rigid.T
        u += np.diff(momentum, axis=0) / dt + alpha * (momentum[1:] + momentum[:-1]) / 2
    return np.asarray(u)


def prepare(
    model: ReducedModel, small: SmallModel, against: Reference, system: BlockSystem
) -> tuple[Propagator, dict[str, Any]]:
    """Propagator and keywords of :func:`reduction.online.run` that repeat the full run. Collective.

    The hand moves as it did where the basis keeps it apart, else it feels the force that gave its motion.
    """
    drive: dict[str, Any]
    if small.fixed_solid:
        step, drive = propagator(small, against.dt, driven=True), {"hand": against.hand}
    else:
        step, drive = propagator(small, against.dt), {"force": against.force}
    if against.model.scene.time.start == "equilibrium":
        drive["x0"] = small.equilibrium() if small.fixed_solid else nearest_state(model, small, against, system)
    return step, drive


def nearest_state(model: ReducedModel, small: SmallModel, against: Reference, system: BlockSystem) -> Array:
    """State x that shows the first snapshot best, min_x |V x - X_0|, (N,). Collective."""
    n, snapshots, first = system.layout.n_local, against.snapshots, slice(0, 1)
    Z, q_s, v_s = snapshots.Z[:, first], snapshots.q_s[:, first], snapshots.v_s[:, first]
    found = factor(system.layout.comm, shown_rows("velocities", model, small, system) @ with_hand(small))
    start = total(system.layout.comm, found.Q.T @ state_rows("velocities", system, Z[:n], Z[n:], q_s, v_s))
    return np.asarray(np.linalg.lstsq(found.scale * found.R, start[:, 0], rcond=None)[0])
