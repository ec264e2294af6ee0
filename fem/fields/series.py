"""From the tissue unknowns back to fields on the whole body, and series of them for ParaView."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import dolfinx
import dolfinx.fem
import dolfinx.io
import numpy as np

from softgrasp.fem.disk import check_room
from softgrasp.fem.errors import ResourceError, agree
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array

FORMATS = ("auto", "vtx", "xdmf")


class FullField:
    """Absolute displacement of hand and tissue as one function, u = R q_s + (z + T q_s).

    The first term lives on the contact nodes, the second on the free ones. With velocities v_z and v_s in place of
    z and q_s the same map gives the absolute velocity.

    Attributes:
        u: the function on the model's space.

    Args:
        model: the model.
        name: name of the function in field files.
    """

    def __init__(self, model: Model, name: str = "displacement") -> None:
        space = model.space
        d = space.layout.dimension
        self.u = dolfinx.fem.Function(space.V, name=name)
        self.T, self.R = model.system.T, space.R
        self.free = (space.free[:, None] * d + np.arange(d)).ravel()

    def fill(self, z: Array, q_s: Array) -> Any:
        """Set the function and return it. Collective; ghosts are updated.

        Args:
            z: relative displacement on the owned free dofs, shape (n_local,) [m].
            q_s: hand, shape (n_s,) [m, rad].
        """
        values = self.u.x.array
        values[: len(self.R)] = self.R @ q_s
        values[self.free] = z + self.T @ q_s
        self.u.x.scatter_forward()
        return self.u


def owner_file(series: Path) -> Path:
    """The small file beside a field series that names its run."""
    return series.with_suffix(".run")


class SeriesWriter:
    """Displacement, and velocity if given, against time in files that ParaView opens.

    VTX keeps the order of the elements, XDMF holds vertex values only.

    Args:
        model: the model.
        directory: made if missing.
        format: "vtx" (``fields.bp``), "xdmf" (``fields.xdmf`` and ``fields.h5``) or "auto", the first of these that
            DOLFINx can write here.
        name: stem of the files.

    Collective.

    Raises:
        ResourceError: the format is unknown, or VTX is asked for and DOLFINx has no ADIOS2.
        OSError: the directory cannot be made.
    """

    def __init__(self, model: Model, directory: Path, format: str = "auto", name: str = "fields") -> None:
        if format not in FORMATS:
            raise ResourceError(f"output.fields = {format!r} is not one of {', '.join(FORMATS)}")
        if format == "vtx" and not dolfinx.has_adios2:
            raise ResourceError("output.fields = 'vtx' needs a DOLFINx with ADIOS2; take 'xdmf' or 'auto'")
        self.format = ("vtx" if dolfinx.has_adios2 else "xdmf") if format == "auto" else format
        self.comm, self.directory = model.space.layout.comm, directory
        with agree(self.comm):
            if self.comm.rank == 0:
                directory.mkdir(parents=True, exist_ok=True)
        self.rename(name)
        self.full = (FullField(model), FullField(model, "velocity"))
        self.written = tuple(f.u if self.format == "vtx" else _at_vertices(f.u) for f in self.full)
        self.fields = 0  # known at the first write
        self.file: Any = None

    def rename(self, name: str, run: str = "") -> None:
        """Choose another stem of the files, and the run's name, before the first write."""
        suffixes = (".bp",) if self.format == "vtx" else (".xdmf", ".h5")
        self.files = tuple(self.directory / f"{name}{suffix}" for suffix in suffixes)
        self.run = run

    def write(self, t: float, z: Array, v: Array, q_s: Array, v_s: Array | None = None, *, reserve: int = 0) -> None:
        """Append one instant. Collective.

        Args:
            t: time [s], larger than the one before.
            z, v: relative displacement [m] and velocity [m/s] on the owned free dofs, shape (n_local,).
            q_s: hand, shape (n_s,) [m, rad].
            v_s: its velocity, shape (n_s,) [m/s, rad/s]; without it in the first call no velocity is written.
            reserve: bytes that must stay free on the disk.

        Raises:
            ResourceError: the disk is full, or soon will be; what was written before is whole.
        """
        fields = self.fields or (1 if v_s is None else 2)
        check_room(self.comm, self.files, self._bytes(fields), reserve)
        if self.file is None:
            self._open(fields)
        states = ((z, q_s), (v, v_s))
        for full, written, (tissue, hand) in zip(self.full[: self.fields], self.written, states, strict=False):
            full.fill(tissue, np.zeros(self.full[0].R.shape[1]) if hand is None else hand)
            if written is not full.u:
                written.interpolate(full.u)
        if self.format == "vtx":
            self.file.write(t)
            return
        for written in self.written[: self.fields]:
            self.file.write_function(written, t)

    def close(self) -> tuple[Path, ...]:
        """Finish the files and return their names; none if nothing was written. Collective."""
        if self.file is None:
            return ()
        self.file.close()
        self.file = None
        return self.files

    def _bytes(self, fields: int) -> int:
        """About what one instant takes of all ranks, with the mesh if it is the first; on rank 0."""
        if self.comm.rank > 0:
            return 0
        space = self.written[0].function_space
        topology = space.mesh.topology
        nodes, cells = space.dofmap.index_map.size_global, topology.index_map(topology.dim).size_global
        mesh = 24 * nodes + 8 * cells * (space.dofmap.list.shape[1] + 1) if self.file is None else 0
        return int(1.5 * mesh + 36 * fields * nodes)  # three numbers a node, half as much for what goes with them

    def _open(self, fields: int) -> None:
        self.fields = fields
        with agree(self.comm):
            if self.comm.rank == 0:
                owner_file(self.files[0]).write_text(self.run)
        written = list(self.written[:fields])
        if self.format == "vtx":
            policy = dolfinx.io.VTXMeshPolicy.reuse  # the mesh does not change: write it once
            self.file = dolfinx.io.VTXWriter(self.comm, self.files[0], written, mesh_policy=policy)
        else:
            self.file = dolfinx.io.XDMFFile(self.comm, self.files[0], "w")
            self.file.write_mesh(written[0].function_space.mesh)


def _at_vertices(u: Any) -> Any:
    """The function itself if it is P1, else an empty P1 function of its name."""
    V = u.function_space
    if V.ufl_element().degree == 1:
        return u
    mesh = V.mesh
    V1 = dolfinx.fem.functionspace(mesh, ("Lagrange", 1, (mesh.geometry.dim,)))
    return dolfinx.fem.Function(V1, name=u.name)
