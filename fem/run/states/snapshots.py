"""Snapshot columns [z; v] that the time loop writes into without a copy, kept in memory or streamed to HDF5."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from softgrasp.fem.errors import CheckpointError, ResourceError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import free_memory
from softgrasp.fem.run.midpoint import TissueState, state_on
from softgrasp.fem.shown import Shown
from softgrasp.fem.system import BlockSystem

FILMED = 60  # stored states that a film of a run shows, at most [1]


@dataclass(frozen=True, repr=False)
class Snapshots(Shown):
    """Hand and relative tissue states at some steps."""

    layout: BlockLayout  # sizes and ownership
    steps: np.ndarray  # step numbers of the columns, (m,)
    times: Array  # their times [s], (m,)
    q_s: Array  # hand, (n_s, m), on every rank
    v_s: Array  # its velocity, alike
    Z: Array  # local rows of [z; v_z] relative to the hand, (2 n_local, m), Fortran order
    # what is made of these columns once for several users, by its type
    kept: dict[type, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def displacement(self, T: Array) -> Array:
        """Absolute displacement q_e = z + T q_s, local rows (n_local, m)."""
        return np.asarray(self.Z[: self.layout.n_local] + T @ self.q_s)

    def velocity(self, T: Array) -> Array:
        """Absolute velocity v_e = v_z + T v_s, local rows (n_local, m)."""
        return np.asarray(self.Z[self.layout.n_local :] + T @ self.v_s)

    def columns(self, pick: np.ndarray) -> Snapshots:
        """Those with these numbers."""
        Z = np.asfortranarray(self.Z[:, pick])
        return Snapshots(self.layout, self.steps[pick], self.times[pick], self.q_s[:, pick], self.v_s[:, pick], Z)


class NoStore:
    """Nothing is stored: one working state for the whole run."""

    def __init__(self, system: BlockSystem) -> None:
        self.system = system
        self.work = state_on(np.zeros(2 * system.layout.n_local), system)
        self.steps = np.zeros(0, dtype=int)

    def target(self, step: int) -> TissueState:
        """State that the step writes into."""
        return self.work

    def limit(self, step: int) -> int:
        """Last step that may be reached before :meth:`flush`."""
        return 2**62

    def flush(self, step: int) -> None:
        """Write out what is buffered, up to a step. Collective."""

    def kept(self, step: int) -> Array:
        """Columns in memory that a restart needs."""
        return np.zeros((0, 0))

    def restore(self, columns: Array, step: int, run: str) -> None:
        """Restore what :meth:`kept` returned in the run of that name."""

    def finish(self, times: Array, q: Array, v: Array) -> Snapshots | None:
        """The stored snapshots, or None when they are not in memory. Collective."""
        return None


class MemoryStore(NoStore):
    """Every k-th state, or ``few`` of these, is a column of one local array; the step writes straight into it.

    Raises ResourceError: the columns of all ranks would not fit in the memory that is free now.
    """

    def __init__(self, system: BlockSystem, steps: int, every: int, few: int | None = None) -> None:
        super().__init__(system)
        layout = system.layout
        self.steps = np.arange(0, steps + 1, every)
        if few is not None:
            self.steps = self.steps[spread(len(self.steps), few)]
        count = len(self.steps)
        needed = 16 * layout.n_e * count
        free = layout.comm.bcast(free_memory())
        if needed > 0.8 * free:
            raise ResourceError(
                f"output.snapshots: {count} columns of {2 * layout.n_e} doubles need {needed} bytes "
                f"and {free} are free; set output.every = {every * int(np.ceil(needed / (0.5 * free)))} "
                "or output.snapshots = 'hdf5'"
            )
        self.Z = np.empty((2 * layout.n_local, len(self.steps)), order="F")
        self.Z.fill(0.0)  # touches every page here, not in the time loop
        self.columns = {int(s): state_on(self.Z[:, j], system) for j, s in enumerate(self.steps)}

    def target(self, step: int) -> TissueState:
        """The column of the step if it is stored, else the working state."""
        return self.columns.get(step, self.work)

    def kept(self, step: int) -> Array:
        """Columns filled so far."""
        return self.Z[:, : int(np.searchsorted(self.steps, step, side="right"))]

    def restore(self, columns: Array, step: int, run: str) -> None:
        """Fill the first columns again. Raises CheckpointError: the run before kept others."""
        if columns.shape[1] != np.searchsorted(self.steps, step, side="right"):
            raise CheckpointError(
                f"the restart file contains {columns.shape[1]} states up to step {step}, this run keeps others; resume "
                "with the command that was stopped, or run again without --resume"
            )
        self.Z[:, : columns.shape[1]] = columns

    def finish(self, times: Array, q: Array, v: Array) -> Snapshots | None:
        """Snapshots with the hand's rows."""
        s = self.steps
        return Snapshots(self.system.layout, s, times[s], q[s].T.copy(), v[s].T.copy(), self.Z)


def spread(count: int, few: int) -> np.ndarray:
    """Numbers of at most ``few`` of so many columns, equally spaced, first and last included."""
    return np.unique(np.linspace(0, count - 1, few).round().astype(int))
