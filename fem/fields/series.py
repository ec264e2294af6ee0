"""From the tissue unknowns back to fields on the whole body, and series of them for ParaView and PyVista."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import dolfinx.la
import dolfinx.plot
import numpy as np
import numpy.typing as npt

from softgrasp.fem.fields.stress import CellStress
from softgrasp.fem.fields.vtu import Collection, Field, Grid, write_vtu
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.resources import check_room

KINDS = {(2, 1): 5, (2, 2): 22, (2, 3): 69, (3, 1): 10, (3, 2): 24, (3, 3): 71}  # (d, order): VTK's kind of cell


class SeriesWriter:
    """Fields against time in ``NAME.pvd``, with a file an instant in the folder ``NAME``.

    Each has at the nodes ``displacement`` [m], ``velocity`` [m/s], ``held`` (1 on the contact zone), with obstacles
    ``contact_traction`` [Pa], their force over area in the last step; in the cells ``strain`` [1], ``stress``
    and ``von_mises`` [Pa] and ``layer``; and ``hand`` [m, rad], the hand's displacement. Cells keep the order of the
    elements.

    Collective. Raises OSError: the directory cannot be made.
    """

    def __init__(self, model: Model, directory: str | Path, name: str = "fields") -> None:
        space, d = model.space, model.space.layout.dimension
        self.comm, self.directory, self.d = space.layout.comm, Path(directory), d
        on_root(self.comm, lambda: self.directory.mkdir(parents=True, exist_ok=True))
        self.rename(name)
        self.model, self.stress = model, CellStress(model)
        rows, _, points = dolfinx.plot.vtk_mesh(space.V)
        nodes = space.V.dofmap.list.shape[1]
        self.used, cells = np.unique(rows.reshape(-1, nodes + 1)[:, 1:], return_inverse=True)  # no node of a ghost cell
        self.grid = Grid(
            points[self.used], cells.reshape(-1, nodes).astype(np.int32), KINDS[d, space.V.ufl_element().degree]
        )
        held = dolfinx.la.vector(space.V.dofmap.index_map, dtype=np.float64)
        held.array[:] = 0.0
        held.array[space.contact] = 1.0
        held.scatter_forward()
        self.held = Field("held", "", held.array[self.used].astype(np.uint8))
        self.layer = Field("layer", "", self.stress.layer)
        self.written = 0

    def close(self) -> tuple[Path, ...]:
        """The list of the files written; none if there is none."""
        return (self.file,) if self.written else ()

    def rename(self, name: str, run: str = "") -> None:
        """Choose another stem of the files, and the run's name, before the first write."""
        self.file, self.folder, self.run = self.directory / f"{name}.pvd", self.directory / name, run

    def write(
        self,
        t: float,
        z: Array,
        v: Array,
        q_s: Array,
        v_s: Array | None = None,
        *,
        traction: Array | None = None,
        reserve: int = 0,
    ) -> None:
        """Append one instant. Collective.

        Args:
            t: time [s], larger than the one before.
            z, v: relative displacement [m] and velocity [m/s] on the owned free dofs, shape (n_local,).
            q_s: hand, shape (n_s,) [m, rad].
            v_s: its velocity, shape (n_s,) [m/s, rad/s]; without it no velocity is written.
            traction: of contact at the local nodes, shape (nodes, d) [Pa]; without it none is written.
            reserve: bytes that must stay free on the disk.

        Raises:
            ResourceError: the disk is full, or soon will be; what was written before is whole.
            OSError: the files cannot be written.
        """
        points, cells = self._fields(z, v, q_s, v_s)
        if traction is not None:
            points.append(Field("contact_traction", "Pa", self._points(traction)))
        self._store(t, points, cells, q_s, reserve)
        self.written += 1

    def _store(self, t: float, points: list[Field], cells: list[Field], q_s: Array, reserve: int) -> None:
        """Write the fields of an instant. Collective."""
        whole = [Field("TimeValue", "s", np.array([t])), Field("hand", "m", np.asarray(q_s, dtype=np.float64))]
        fields = [*points, *cells, *(field for part in self.grid.fields().values() for field in part)]
        needed = self.comm.reduce(sum(field.values.nbytes for field in fields)) or 0  # one file, by rank 0
        if self.written == 0:
            on_root(self.comm, self._begin)
        path = self.folder / f"{self.written:06}.vtu"
        check_room(self.comm, [path], needed, reserve)
        checks = write_vtu(self.comm, path, self.grid, points, cells, whole)
        on_root(self.comm, lambda: self.list.add(t, path, checks))

    def _begin(self) -> None:
        """Make the folder and the list; rank 0 only."""
        self.folder.mkdir(exist_ok=True)
        self.list = Collection(self.file, self.run)

    def _fields(self, z: Array, v: Array, q_s: Array, v_s: Array | None) -> tuple[list[Field], list[Field]]:
        def of_nodes(function: Any) -> Array:
            return np.asarray(function.x.array.reshape(-1, self.d))

        u = of_nodes(self.model.displacement(z, q_s))
        # in the frame of a turning hand strain and stress are those of z, in the axes of the hand
        strained = u if self.model.system.frame is None else of_nodes(self.model.space.nodal(z))
        strain, stress, mises = (values.astype(np.float32, order="C") for values in self.stress(strained))
        cells = [Field("strain", "1", strain), Field("stress", "Pa", stress), Field("von_mises", "Pa", mises)]
        points = [Field("displacement", "m", self._points(u))]
        if v_s is not None:
            points.append(Field("velocity", "m/s", self._points(of_nodes(self.model.velocity(z, v, q_s, v_s)))))
        return [*points, self.held], [*cells, self.layer]

    def _points(self, values: Array) -> npt.NDArray[np.float32]:
        """Rows of the points of the grid, with three components, in single precision as the fields of the cells."""
        rows = np.zeros((len(self.used), 3), dtype=np.float32)
        rows[:, : self.d] = values[self.used]
        return rows
