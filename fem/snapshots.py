"""Snapshot columns [z; v] that the time loop writes into without a copy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import psutil

from fem.errors import ResourceError
from fem.layout import BlockLayout
from fem.petsc import Array
from fem.system import BlockSystem


@dataclass(frozen=True)
class Snapshots:
    """Hand and relative tissue states at some steps.

    Attributes:
        layout: sizes and ownership.
        steps: step numbers of the columns, shape (m,).
        times: their times [s], shape (m,).
        q_s, v_s: hand, shape (n_s, m), on every rank.
        Z: local rows of [z; v_z] relative to the hand, shape (2 n_local, m), Fortran order.
    """

    layout: BlockLayout
    steps: np.ndarray
    times: Array
    q_s: Array
    v_s: Array
    Z: Array

    def displacement(self, T: Array) -> Array:
        """Absolute displacement q_e = z + T q_s, local rows (n_local, m). Not collective."""
        return np.asarray(self.Z[: self.layout.n_local] + T @ self.q_s)

    def velocity(self, T: Array) -> Array:
        """Absolute velocity v_e = v_z + T v_s, local rows (n_local, m). Not collective."""
        return np.asarray(self.Z[self.layout.n_local :] + T @ self.v_s)


def snapshot_steps(steps: int, every: int) -> np.ndarray:
    """Step numbers that are stored: 0, every, 2 every, ... Not collective."""
    return np.arange(0, steps + 1, every)


def memory_check(system: BlockSystem, columns: int) -> None:
    """Refuse snapshots that cannot fit in the memory that is free now. Collective.

    Raises:
        ResourceError: with the number of bytes.
    """
    layout = system.layout
    needed = 16 * layout.n_e * columns
    free = layout.comm.bcast(psutil.virtual_memory().available)
    if needed > 0.8 * free:
        raise ResourceError(
            f"output.snapshots: {columns} columns of {2 * layout.n_e} doubles need {needed} bytes and {free} are free; "
            f"set output.every to {int(np.ceil(needed / (0.5 * free)))} times its value, or output.snapshots = 'hdf5'"
        )
