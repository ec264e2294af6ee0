"""Snapshot columns [z; v] that go to HDF5 files as they come, one file a rank."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np

from softgrasp.fem.errors import CheckpointError, ResourceError, raise_on_all_ranks
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array
from softgrasp.fem.resources import MARGIN, check_room, reserve_room
from softgrasp.fem.run.midpoint import TissueState, state_on
from softgrasp.fem.run.states.snapshots import NoStore, Snapshots
from softgrasp.fem.system import BlockSystem

DAMAGE = (OSError, KeyError, ValueError, TypeError, RuntimeError)  # what h5py raises of files that are not whole
BUFFER_BYTES = 64 * 2**20  # per rank; large enough that HDF5 writes whole chunks


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
