"""A full run whose states stay in memory for the way back: all of them, or those of a segment at a time.

Where all steps + 1 states fit, they are kept. Else the run keeps a restart state at the start of each of about
sqrt(steps) segments and the states of the last segment; on the way back each other segment is run once more, from its
restart state and with the factor that is there [GW00]. That is one more run, for 3 sqrt(steps) states in memory.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from softgrasp.fem.errors import ResourceError, SceneError
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import free_memory, size_text
from softgrasp.fem.run.checkpoint import RestartState
from softgrasp.fem.run.midpoint import TissueState, state_on
from softgrasp.fem.run.motion import ForceDrive, HandTable, TableDrive, driven_table
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.snapshots import NoStore
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.system import BlockSystem

SHARE = 0.5  # of the free memory that all states may take; the rest is for those who come later


class Segment(NoStore):
    """States of some steps in a row, each a column of one local array.

    Attributes:
        first: number of the step whose state is the first column.
        Z: [z; v] relative to the hand, local rows (2 n_local, length + 1) [m; m/s].
    """

    def __init__(self, system: BlockSystem, length: int) -> None:
        super().__init__(system)
        self.first = 0
        self.Z = np.zeros((2 * system.layout.n_local, length + 1), order="F")
        self.columns = [state_on(self.Z[:, j], system) for j in range(length + 1)]

    def target(self, step: int) -> TissueState:
        """The column of a step."""
        return self.columns[step - self.first]


class KeptRun(Run):
    """A run from its start, then its segments from the last to the first.

    Args:
        hand: positions and velocities instead of the scene's motion, (steps + 1, n_s) each.
        force: at the step midpoints instead of the scene's, (steps, n_s).
        length: steps of a segment.
    """

    def __init__(self, model: Model, hand: tuple[Array, Array] | None, force: Array | None, length: int | None) -> None:
        scene = model.scene
        quiet = scene.model_copy(update={"output": scene.output.model_copy(update={"snapshots": "none"})})
        self.given_hand, self.given_force = hand, force
        super().__init__(replace(model, scene=quiet), RunOptions())
        self.length = length or segment_length(model, self.steps)
        self.segment = self.store = Segment(model.system, self.length)
        self.state = self.store.target(0)
        self.ts: Any = make_ts(self)
        self.marks: list[RestartState] = []

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
        """Run to the end; the last segment's states stay. Collective.

        Raises SolverError: a solve failed or missed its tolerance.
        """
        self.start()
        marks = set(range(self.length, self.steps, self.length))
        if marks:
            self._mark(0)
        for goal in sorted({1, self.steps} | marks | (self.milestones - {0})):
            before = self.reached
            self.take(self.ts, goal, check=before == 0 or goal == self.steps)
            if before == 0:
                self.residual_first = self.residual_last
            if goal in self.milestones:
                self.watch_energy()
            if goal in marks:
                self._mark(goal)
        return self.trajectory()

    def _mark(self, step: int) -> None:
        """Begin a segment at the state just reached."""
        saved = self.restart_state()
        changing = (
            "state",
            "r",
            "pending",
            "energies",
            "solver_rows",
            "solver_numbers",
        )  # the rest grows, or is made anew
        copies: dict[str, Any] = {k: x.copy() for k in changing if (x := getattr(saved, k)) is not None}
        self.marks.append(replace(saved, legs=[0], **copies))
        self._begin(step, saved.state)

    def _begin(self, step: int, state: Array) -> None:
        self.segment.first = step
        self.state = self.segment.columns[0]
        self.state.array[:] = state
        for vector in (self.state.z, self.state.v):
            vector.stateIncrease()

    def states_from(self, number: int) -> tuple[int, Array]:
        """First step of a segment and its states (2 n_local, steps + 1), run once more if need be. Collective.

        Raises SolverError: a solve failed.
        """
        first = number * self.length
        end = min(first + self.length, self.steps)
        if self.segment.first != first:
            self.segment.first = first
            self.restore(self.marks[number])
            self.ts.setStepNumber(first)
            self.take(self.ts, end)
        return first, self.segment.Z[:, : end - first + 1]

    def close(self) -> None:
        """Free all PETSc objects. Collective."""
        self.ts.destroy()
        self.midpoint.destroy()


def segment_length(model: Model, steps: int) -> int:
    """All steps where their states fit, else about sqrt(steps). Collective.

    Raises ResourceError: not even these fit.
    """
    layout = model.system.layout
    free, state = layout.comm.bcast(free_memory()), 16 * layout.n_e
    if state * (steps + 1) <= SHARE * free:
        return steps
    length = int(np.ceil(np.sqrt(steps)))
    needed = state * (length + 1) + 2 * state * int(np.ceil(steps / length))
    if needed > SHARE * free:
        raise ResourceError(
            f"the gradient of scene '{model.scene.name}' keeps {size_text(needed)} of states and {size_text(free)} are "
            "free; use fewer steps, a coarser mesh or a reduced model"
        )
    return length


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
