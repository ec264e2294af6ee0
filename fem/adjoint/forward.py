"""A full run whose states stay for the way back, in memory or in a file without a name."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from typing import Any

import numpy as np

from softgrasp.fem.errors import ResourceError, SceneError, raise_on_all_ranks
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import free_memory, size_text
from softgrasp.fem.run.midpoint import TissueState, state_on
from softgrasp.fem.run.motion import ForceDrive, HandTable, TableDrive, driven_table
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.states.snapshots import NoStore
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.run.stepping import make_ts

SHARE = 0.5  # of the free memory that all states may take; the rest is for those who come later


class AllStates(NoStore):
    """Every state of a run. Collective.

    Attributes:
        Z: [z; v] relative to the hand, a column for each step, local rows (2 n_local, steps + 1) [m; m/s].
    """

    def __init__(self, model: Model, steps: int) -> None:
        super().__init__(model.system)
        self.Z = room_for_states(model, steps)
        self.columns = [state_on(self.Z[:, j], model.system) for j in range(steps + 1)]

    def target(self, step: int) -> TissueState:
        """The column of a step."""
        return self.columns[step]


class KeptRun(Run):
    """A run with all its states.

    Args:
        hand: positions and velocities instead of the scene's motion, (steps + 1, n_s) each.
        force: at the step midpoints instead of the scene's, (steps, n_s).
    """

    def __init__(self, model: Model, hand: tuple[Array, Array] | None, force: Array | None) -> None:
        scene = model.scene
        quiet = scene.model_copy(update={"output": scene.output.model_copy(update={"snapshots": "none"})})
        self.given_hand, self.given_force = hand, force
        super().__init__(replace(model, scene=quiet), RunOptions())
        self.all_states = self.store = AllStates(model, self.steps)
        self.state = self.store.target(0)
        self.ts: Any = make_ts(self)

    def _make_drive(self, force: object) -> TableDrive | ForceDrive:
        system, n_s = self.model.system, self.model.system.layout.n_s
        if self.given_hand is not None:
            q, v = self.given_hand
            return TableDrive(system, HandTable(q, v, np.diff(v, axis=0) / self.dt))
        if self.given_force is None:
            return super()._make_drive(None)
        u, zero = self.given_force, np.zeros(n_s)
        if not system.two_way:
            return TableDrive(system, driven_table(system.M_hand, u + system.weight, self.dt, zero, zero), u)
        return ForceDrive(system, lambda n, t, q, v: u[n], self.midpoint, self.steps, zero, zero)

    def whole(self) -> Trajectory:
        """Run to the end. Collective.

        Raises SolverError: a solve failed or missed its tolerance.
        """
        self.start()
        for goal in sorted({1, self.steps} | (self.milestones - {0})):
            before = self.reached
            self.take(self.ts, goal, check=before == 0 or goal == self.steps)
            if before == 0:
                self.residual_first = self.residual_last
            if goal in self.milestones:
                self.watch_energy()
        return self.trajectory()

    def close(self) -> None:
        """Free all PETSc objects. Collective."""
        self.ts.destroy()
        self.midpoint.destroy()


def room_for_states(model: Model, steps: int) -> Array:
    """Zeros for all states, local rows (2 n_local, steps + 1), in memory where they fit, else in a file. Collective.

    The file has no name, and lies in the folder for temporary files, with all its room reserved.

    Raises ResourceError: the disk has not this room.
    """
    layout = model.system.layout
    shape, needed = (2 * layout.n_local, steps + 1), 16 * layout.n_e * (steps + 1)
    if needed <= SHARE * layout.comm.bcast(free_memory()):
        return np.zeros(shape, order="F")
    with raise_on_all_ranks(layout.comm):
        try:
            with tempfile.TemporaryFile() as file:
                os.posix_fallocate(
                    file.fileno(), 0, max(8 * shape[0] * shape[1], 1)
                )  # a full disk would end the program
                return np.asarray(
                    np.memmap(file, np.float64, "r+", shape=shape, order="F") if shape[0] else np.zeros(shape)
                )
        except OSError as error:
            raise ResourceError(
                f"the gradient of scene '{model.scene.name}' keeps {size_text(needed)} of states, and neither the "
                f"memory nor the folder of temporary files has room for them ({error.strerror}); free the disk, name "
                "another folder in TMPDIR, or use fewer steps, a coarser mesh or a reduced model"
            ) from error


def checked_tables(
    model: Model, hand: tuple[Array, Array] | None, force: Array | None
) -> tuple[tuple[Array, Array] | None, Array | None]:
    """Tables of the hand or of the force, or neither for those of the scene.

    Raises SceneError: both are given, shapes do not fit, or numbers are not finite.
    """
    n_s, steps = model.system.layout.n_s, model.scene.time.steps
    if hand is not None and force is not None:
        raise SceneError("give either the force on the hand or the motion of the hand, or neither for the scene's")
    tables = [] if hand is None else [np.asarray(table, dtype=float) for table in hand]
    tables += [] if force is None else [np.asarray(force, dtype=float)]
    rows = steps if force is not None else steps + 1
    for table in tables:
        if table.shape != (rows, n_s) or not np.isfinite(table).all():
            what = "force" if force is not None else "hand"
            raise SceneError(
                f"the {what} has a table of the shape {table.shape}; it must be {(rows, n_s)} with finite numbers"
            )
    if hand is not None:
        return (tables[0], tables[1]), None
    return None, tables[0] if tables else None
