"""Snapshot columns [z; v] that the time loop writes into without a copy, kept in memory or streamed to HDF5."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from softgrasp.fem.errors import CheckpointError, ResourceError, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import MARGIN, check_room, free_memory, reserve_room
from softgrasp.fem.run.midpoint import TissueState, state_on
from softgrasp.fem.shown import Shown
from softgrasp.fem.system import BlockSystem

DAMAGE = (OSError, KeyError, ValueError, TypeError, RuntimeError)  # what h5py raises of files that are not whole
BUFFER_BYTES = 64 * 2**20  # per rank; large enough that HDF5 writes whole chunks


@dataclass(frozen=True, repr=False)
class Snapshots(Shown):
    """Hand and relative tissue states at some steps."""

    layout: BlockLayout  # sizes and ownership
    steps: np.ndarray  # step numbers of the columns, (m,)
    times: Array  # their times [s], (m,)
    q_s: Array  # hand, (n_s, m), on every rank
    v_s: Array  # its velocity, alike
    Z: Array  # local rows of [z; v_z] relative to the hand, (2 n_local, m), Fortran order

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


class Hdf5Store(NoStore):
    """Columns go through a buffer to one HDF5 file a rank; ``snapshots.h5`` presents them as one.

    Datasets of ``snapshots.h5``: z, v (m, n_e), nodes (n_e / d, d), times, steps (m,), q_s, v_s (m, n_s). Raises
    ResourceError: the files of all ranks would not fit on the disk.
    """

    def __init__(self, system: BlockSystem, steps: int, every: int, directory: Path, run: str | None) -> None:
        super().__init__(system)
        layout = system.layout
        self.directory, self.path = directory, directory / f"snapshots-rank{layout.comm.rank}.h5"  # of this rank
        count = steps // every + 1
        self.needed = 16 * layout.n_e * count
        with raise_on_all_ranks(layout.comm):
            if layout.comm.rank == 0:
                directory.mkdir(parents=True, exist_ok=True)
                free = shutil.disk_usage(directory).free
                if self.needed > 0.9 * free:
                    raise ResourceError(
                        f"output.snapshots: {count} columns of {2 * layout.n_e} doubles need "
                        f"{self.needed} bytes and {free} are free in {directory}; set output.every to a larger number"
                    )
        self.steps = np.arange(0, steps + 1, every)
        rows = 2 * layout.n_local
        fit = max(2, BUFFER_BYTES // max(8 * rows, 1))  # the first step reads one column and writes the next
        self.width = min(layout.comm.allreduce(fit, min), len(self.steps))
        self.buffer = np.zeros((rows, self.width), order="F")
        self.slots = [state_on(self.buffer[:, j], system) for j in range(self.width)]
        self.index = {int(s): j for j, s in enumerate(self.steps)}
        self.written = 0
        with raise_on_all_ranks(layout.comm):
            self._open(rows, run)

    def _open(self, rows: int, run: str | None) -> None:
        path, shape = self.path, (len(self.steps), rows)
        if run is not None:
            try:
                note(path)
                with h5py.File(path, "w") as file:
                    file.create_dataset("Z", shape, dtype="f8", chunks=(1, max(rows, 1)), fletcher32=True)
                    file.attrs["written"], file.attrs["run"] = 0, run
            except OSError as error:
                raise ResourceError(f"{path} cannot be written ({error}); choose another --out") from error
            return
        try:
            with h5py.File(path, "r+") as file:
                stored, self.on_file, self.owner = file["Z"].shape, int(file.attrs["written"]), file.attrs["run"]
        except DAMAGE as error:
            raise CheckpointError(f"{path} cannot be read ({error}); run again without --resume") from error
        if stored != shape:
            raise CheckpointError(
                f"{path} has {stored} numbers, this run needs {shape}; resume with the same scene and rank count, or "
                "run again without --resume"
            )

    def target(self, step: int) -> TissueState:
        """The buffer slot of the step if it is stored, else the working state."""
        j = self.index.get(step)
        return self.work if j is None else self.slots[j % self.width]

    def limit(self, step: int) -> int:
        """Last step before the buffer would overflow."""
        j = self.written + self.width
        return int(self.steps[j]) - 1 if j < len(self.steps) else 2**62

    def flush(self, step: int) -> None:
        """Append the filled slots to this rank's file. Collective."""
        end, comm = int(np.searchsorted(self.steps, step, side="right")), self.system.layout.comm
        if end > self.written:
            check_room(comm, [self.path], 8 * len(self.buffer) * (end - self.written))
            with raise_on_all_ranks(comm):
                try:
                    reserve_room(self.path, 8 * (len(self.buffer) + 1) * (end - self.written) + MARGIN)
                    with h5py.File(self.path, "r+") as file:
                        for j in range(self.written, end):
                            file["Z"][j] = self.buffer[:, j % self.width]
                        file.attrs["written"] = end
                except (OSError, RuntimeError) as error:
                    raise ResourceError(f"{self.path} cannot be written ({error}); free the disk") from error
            self.written = end

    def restore(self, columns: Array, step: int, run: str) -> None:
        """Go on behind what is already in the file, which is read once to see that it is whole.

        Raises CheckpointError: the file is of another run, is damaged or has fewer columns.
        """
        self.written, path = int(np.searchsorted(self.steps, step, side="right")), self.path
        if self.owner != run:
            raise CheckpointError(
                f"{path} belongs to another run, which was started in this folder later; run again without --resume"
            )
        if self.on_file < self.written:
            raise CheckpointError(
                f"{path} has {self.on_file} snapshots, step {step} needs {self.written}; run again without --resume"
            )
        try:
            with h5py.File(path) as file:
                if not file["Z"].fletcher32:
                    raise ValueError("its numbers have no checksums")
                for j in range(self.written):
                    file["Z"][j]  # HDF5 compares the checksum of what it reads
        except DAMAGE as error:
            raise CheckpointError(f"{path} is damaged ({error}); run again without --resume") from error

    def finish(self, times: Array, q: Array, v: Array) -> Snapshots | None:
        """Write ``snapshots.h5`` over the rank files. Collective.

        Raises ResourceError: the file cannot be written.
        """
        layout, s = self.system.layout, self.steps
        sizes = layout.comm.gather(layout.n_local)
        nodes = layout.comm.gather(layout.nodes)
        with raise_on_all_ranks(layout.comm):
            if sizes is not None and nodes is not None:  # rank 0
                self._join(sizes, nodes, times[s], q[s], v[s])
        return None

    def _join(self, sizes: list[int], nodes: list[Array], times: Array, q: Array, v: Array) -> None:
        path, count = self.directory / "snapshots.h5", len(self.steps)
        try:
            note(path)
            with h5py.File(path.name, "w", driver="core", backing_store=False) as file:  # written by Python
                for key, part in (("z", 0), ("v", 1)):
                    joined = h5py.VirtualLayout((count, sum(sizes)), dtype="f8")
                    at = 0
                    for rank, n in enumerate(sizes):
                        source = h5py.VirtualSource(f"snapshots-rank{rank}.h5", "Z", (count, 2 * n))
                        joined[:, at : at + n] = source[:, part * n : (part + 1) * n]
                        at += n
                    file.create_virtual_dataset(key, joined)
                file["nodes"] = np.vstack(nodes)
                file["times"], file["steps"] = times, self.steps
                file["q_s"], file["v_s"] = q, v
                file.flush()
                image = file.id.get_file_image()
            path.write_bytes(image)
        except OSError as error:
            raise ResourceError(f"{path} cannot be written ({error}); remove it or free the disk") from error


def spread(count: int, few: int) -> np.ndarray:
    """Numbers of at most ``few`` of so many columns, equally spaced, first and last included."""
    return np.unique(np.linspace(0, count - 1, few).round().astype(int))


def make_store(
    system: BlockSystem, kind: str, steps: int, every: int, directory: Path, run: str | None, few: int | None = None
) -> NoStore:
    """Store of a run: memory, hdf5 or none; ``run`` is the name of a new run, None resumes. Collective.

    ``few``: states that "auto" keeps; None keeps all.
    """
    if kind in ("auto", "memory"):
        return MemoryStore(system, steps, every, few if kind == "auto" else None)
    if kind == "hdf5":
        return Hdf5Store(system, steps, every, directory, run)
    return NoStore(system)
