"""The full run that reduced runs are compared with, how a reduced model repeats it, and how far it is from it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.errors import SceneError
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.reduction import online
from softgrasp.reduction.bases.engines import factor
from softgrasp.reduction.errors import ModelComparison, ModelErrors, full_energy, shown_rows, state_rows, with_hand
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.origin import Origin, check_origin
from softgrasp.reduction.propagator import Propagator, propagator
from softgrasp.reduction.system import EnergySystem

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

REST = 1e-9  # of the largest displacement: a solve for an equilibrium leaves 1e-12, a motion of use far more


@dataclass(frozen=True)
class FullRun:
    """A full run with its states in memory; made by :func:`full_run`."""

    model: Model  # the scene, at the materials of the run
    trajectory: Trajectory  # hand and outputs
    snapshots: Snapshots  # states

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return float(self.trajectory.times[1] - self.trajectory.times[0])

    @property
    def hand(self) -> tuple[Array, Array]:
        """q_s and v_s at every step, (steps + 1, n_s) each [m, rad; m/s, rad/s]."""
        return self.trajectory.q_s, self.trajectory.v_s

    @cached_property
    def energy(self) -> Array:
        """Tissue energy (z' K z + v_z' M v_z) / 2 of every snapshot, (m,) [J]. Collective at the first use."""
        return full_energy(self.model.system, self.snapshots.Z)

    @property
    def force(self) -> Array:
        """Force u on the hand that gives its motion in the model, (steps, n_s) [N, N m]: one-way M_hand a - weight."""
        system, trajectory = self.model.system, self.trajectory
        if system.two_way:
            return trajectory.force
        return np.asarray(np.diff(trajectory.v_s, axis=0) / self.dt @ system.M_hand.T - system.weight)


def full_run(model: Model, trajectory: Trajectory) -> FullRun:
    """A run of ``simulate`` at the materials of ``model`` as reduced runs are compared with it. Collective.

    Raises:
        SceneError: the run kept no snapshots in memory, or the body is at rest in all of them.
    """
    snapshots = trajectory.snapshots
    if snapshots is None:
        raise SceneError("output.snapshots must be 'memory' for a reduction; bases are built from the states in memory")
    layout, n = snapshots.layout, snapshots.layout.n_local
    z, q_s = snapshots.Z[:n], snapshots.q_s
    change, size = (
        layout.comm.allreduce(max(float(np.abs(x).max(initial=0.0)) for x in parts), MPI.MAX)
        for parts in ((z - z[:, :1], q_s - q_s[:, :1]), (z, q_s))
    )
    if change <= REST * size:
        raise SceneError(
            f"hand and tissue of scene {model.scene.name} stay at rest for the whole run, so there is no motion to "
            "reduce; give a motion.target away from the start, or another time.start"
        )
    return FullRun(model, trajectory, snapshots)


def replay_linear(
    rom: ReducedModel, model: Model, run: Trajectory | FullRun, *, allow_unstable: bool = False
) -> ReducedTrajectory:
    """A linear model under the hand of a full run, see :func:`softgrasp.reduction.reduce.replay`. Collective."""
    full = as_full(model, run)
    check_scenes(rom.origin, rom.name, model, full)
    step, drive = replay_inputs(rom, rom.at(model.system.materials), full)
    return online.run(step, allow_unstable=allow_unstable, **drive)


def check_scenes(origin: Origin, name: str, model: Model, full: FullRun) -> None:
    """Refuse scenes that differ in more than materials, motion and time, see :mod:`softgrasp.reduction.origin`.

    Raises ModelError: with the first key that differs.
    """
    for each in (model,) if full.model.scene is model.scene else (model, full.model):
        check_origin(origin, each.scene_keys, name)


def errors_linear(rom: ReducedModel, reduced_run: ReducedTrajectory, full: FullRun) -> ModelErrors:
    """Errors of a linear model, see :func:`softgrasp.reduction.reduce.errors`. Collective."""
    comparison = comparison_of(rom, full)
    return comparison.errors(rom, comparison.small, reduced_run)


def as_full(model: Model, run: Trajectory | FullRun) -> FullRun:
    """A run as it is, or a trajectory at the materials of ``model`` by :func:`full_run`. Collective."""
    return run if isinstance(run, FullRun) else full_run(model, run)


def comparison_of(rom: ReducedModel, full: FullRun) -> ModelComparison:
    """What errors of this model and of smaller ones of its family are computed from, at the materials of the run."""
    system = full.model.system
    return ModelComparison(rom, rom.at(system.materials), system, full.snapshots, full.energy)


def replay_inputs(rom: ReducedModel, small: EnergySystem, full: FullRun) -> tuple[Propagator, dict[str, Any]]:
    """Propagator, and keywords of :func:`softgrasp.reduction.online.run`, that repeat a full run. Collective.

    ``small``: the same at the materials of the run that is to be made.

    Raises ModelError: E or the midpoint matrix is singular, or there is no single equilibrium to start in.
    """
    drive: dict[str, Any] = {"hand": full.hand} if small.hand_first else {"force": full.force}
    step = propagator(small, full.dt, driven=small.hand_first)
    if full.model.scene.time.start == "equilibrium":
        drive["x0"] = small.equilibrium() if small.hand_first else nearest_state(rom, small, full)
    return step, drive


def nearest_state(rom: ReducedModel, small: EnergySystem, full: FullRun) -> Array:
    """State x that approximates the first snapshot best, min_x |V x - X_0|, (N,). Collective."""
    system, snapshots, first = full.model.system, full.snapshots, slice(0, 1)
    n, Z, q_s, v_s = system.layout.n_local, snapshots.Z[:, first], snapshots.q_s[:, first], snapshots.v_s[:, first]
    V = factor(system.layout.comm, shown_rows("velocities", rom, small, system) @ with_hand(small))
    start = total(system.layout.comm, V.Q.T @ state_rows("velocities", system, Z[:n], Z[n:], q_s, v_s))
    return np.asarray(np.linalg.lstsq(V.scale * V.R, start[:, 0], rcond=None)[0])
