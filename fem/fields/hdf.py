"""Fields against time as VTKHDF, one HDF5 file for each field and all instants, by `dolfinx.io.vtkhdf`."""

from __future__ import annotations

from pathlib import Path

import dolfinx.fem
import h5py
import numpy as np
import numpy.typing as npt

from softgrasp.fem.fields.series import SeriesWriter
from softgrasp.fem.fields.vtu import Field
from softgrasp.fem.model.build import Model
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.resources import check_room

NOTE = "softgrasp_run"  # attribute with the name of the run


class HdfWriter(SeriesWriter):
    """As :class:`SeriesWriter` in ``NAME-displacement.vtkhdf``, ``NAME-velocity.vtkhdf``, and so on.

    They have values at the points of the mesh, without those of quadratic elements between them, and strain and stress
    in its cells. DOLFINx calls each field ``u`` and puts the mesh into each file, once. All ranks write together.
    """

    def __init__(self, model: Model, directory: str | Path, name: str = "fields") -> None:
        super().__init__(model, directory, name)
        V, mesh, d = model.space.V, model.space.mesh.mesh, self.d
        self.mesh, degree = mesh, mesh.geometry.cmaps[0].degree
        at_points = dolfinx.fem.functionspace(mesh, ("Lagrange", degree, (d,)))
        self.given, self.at_points = dolfinx.fem.Function(V), dolfinx.fem.Function(at_points)
        places = mesh.geometry.index_map()
        nodes = np.zeros(places.size_local + places.num_ghosts, dtype=np.int32)
        nodes[mesh.geometry.dofmaps[0].ravel()] = at_points.dofmap.list.ravel()
        self.nodes = nodes[: places.size_local]

    def close(self) -> tuple[Path, ...]:
        """The files written; none if there is none."""
        return tuple(self.files.values())

    def rename(self, name: str, run: str = "") -> None:
        """Choose another stem of the files, and the run's name, before the first write."""
        self.stem, self.run = name, run
        self.files: dict[str, Path] = {}

    def _store(self, t: float, points: list[Field], cells: list[Field], q_s: Array, reserve: int) -> None:
        import dolfinx.io.vtkhdf as io  # only these files need it

        fields = [(io.write_point_data, f) for f in points] + [(io.write_cell_data, f) for f in cells]
        fields = [(write, f) for write, f in fields if f.unit]  # zone and layer stay as they are
        needed = 8 * sum(field.values.size for _, field in fields)  # in double precision, whatever is given
        paths = [self.directory / f"{self.stem}-{field.name}.vtkhdf" for _, field in fields]
        check_room(self.comm, paths, needed, reserve)
        for write, field in fields:
            path = self.files.get(field.name) or self._begin_file(field.name)
            try:
                write(path, self.mesh, np.ascontiguousarray(field.values).ravel(), t)
            except RuntimeError as error:
                raise OSError(f"{path}: {error}") from error

    def _begin_file(self, name: str) -> Path:
        """A file with the mesh alone. Collective."""
        import dolfinx.io.vtkhdf as io

        path = self.directory / f"{self.stem}-{name}.vtkhdf"

        def clear() -> None:
            note(path)
            path.unlink(missing_ok=True)

        on_root(self.comm, clear)
        io.write_mesh(path, self.mesh)
        on_root(self.comm, lambda: _mark(path, self.run))
        self.files[name] = path
        return path

    def _points(self, values: Array) -> npt.NDArray[np.float32]:
        self.given.x.array[:] = np.ravel(values)
        self.at_points.interpolate(self.given)
        rows = np.zeros((len(self.nodes), 3), dtype=np.float32)
        rows[:, : self.d] = self.at_points.x.array.reshape(-1, self.d)[self.nodes]
        return rows


def _mark(path: Path, run: str) -> None:
    with h5py.File(path, "a") as file:
        file.attrs[NOTE] = run


def run_of(path: Path) -> str:
    """Name of the run that wrote a file; empty where it is none of ours."""
    try:
        with h5py.File(path) as file:
            return str(file.attrs.get(NOTE, ""))
    except OSError:
        return ""
