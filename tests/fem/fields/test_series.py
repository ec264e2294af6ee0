"""Field files, opened by PyVista, i.e. by the readers of VTK that ParaView has too."""

from __future__ import annotations

import softgrasp.fem  # noqa: F401

# isort: split
import shutil
import subprocess
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.fields.hdf import HdfWriter, run_of
from softgrasp.fem.fields.series import SeriesWriter
from softgrasp.fem.fields.stress import CellStress
from softgrasp.fem.fields.vtu import note_of
from tests.fem.fields.test_fields import EXACT, hand_of, make_model, turned

SINGLE = 1e-6  # strains are kept as 4-byte numbers
PARAVIEW = """
from paraview.simple import PVDReader
series = PVDReader(FileName={!r})
print(list(series.TimestepValues), sorted(series.PointData.keys()), sorted(series.CellData.keys()))
"""


def series(path: Path) -> Any:
    pyvista = pytest.importorskip("pyvista")
    return pyvista.PVDReader(str(path))


def affine(d: int) -> np.ndarray:
    """A gradient whose symmetric part has no zero."""
    return np.array([[0.01, 0.02, -0.005], [0.004, -0.03, 0.01], [0.02, 0.003, 0.05]])[:d, :d]


def write(comm: MPI.Intracomm, folder: Path, d: int, order: int, **extra: Any) -> Path:
    """The files of `instants` in one list."""
    (path,) = instants(comm, folder, d, order, SeriesWriter, **extra)
    return path


def instants(
    comm: MPI.Intracomm, folder: Path, d: int, order: int, kind: type[SeriesWriter], **extra: Any
) -> tuple[Path, ...]:
    """The start, the hand's move, and u = A x on the free nodes."""
    model, q = make_model(comm, d, order, **extra), hand_of(d)
    zero = np.zeros(model.system.layout.n_local)
    writer = kind(model, folder / "new")
    writer.rename("fields", "a run")
    writer.write(0.0, zero, zero, 0 * q, 0 * q)
    writer.write(0.5, zero, zero, q, 2 * q)
    writer.write(np.float64(1.0), (model.system.layout.nodes @ affine(d).T).ravel(), zero, 0 * q, 0 * q)
    paths = writer.close()
    comm.Barrier()
    return paths


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("d", [2, 3])
def test_vtk_reads_the_hdf_files(comm: MPI.Intracomm, mpi_tmp_path: Path, d: int, order: int) -> None:
    paths = instants(comm, mpi_tmp_path, d, order, HdfWriter)
    if comm.rank == 0:
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
        from vtkmodules.vtkIOHDF import vtkHDFReader

        names = ["displacement", "velocity", "strain", "stress", "von_mises"]
        assert [path.name for path in paths] == [f"fields-{name}.vtkhdf" for name in names]
        assert {run_of(path) for path in paths} == {"a run"}
        for path in paths:
            reader = vtkHDFReader()
            reader.SetFileName(str(path))
            reader.UpdateInformation()
            when = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
            assert when == (0.0, 0.5, 1.0)
            reader.SetStep(2)
            reader.Update()
            grid = reader.GetOutput()
            x, u = vtk_to_numpy(grid.GetPoints().GetData())[:, :d], grid.GetPointData().GetArray("u")
            if path is paths[0]:
                free = np.abs(vtk_to_numpy(u)).max(axis=1) > 1e-9  # the rest is held, to rounding
                assert 0 < free.sum() < len(x)
                np.testing.assert_allclose(vtk_to_numpy(u)[free, :d], (x @ affine(d).T)[free], atol=EXACT)
            elif path is paths[1]:
                reader.SetStep(1)
                reader.Update()
                v = vtk_to_numpy(reader.GetOutput().GetPointData().GetArray("u"))
                np.testing.assert_allclose(v[:, :d], turned(x, 2 * hand_of(d)), atol=2 * EXACT)
            elif path is paths[2]:  # the body has cells without a held node
                e, A = vtk_to_numpy(grid.GetCellData().GetArray("u")), affine(d)
                assert np.abs(e[:, 3] - (A[0, 1] + A[1, 0]) / 2).min() < SINGLE
            else:
                assert grid.GetCellData().GetArray("u").GetNumberOfTuples() == grid.GetNumberOfCells() > 0
    comm.Barrier()


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_pyvista_sees_what_was_written(comm: MPI.Intracomm, mpi_tmp_path: Path, d: int, order: int) -> None:
    path = write(comm, mpi_tmp_path, d, order)
    if comm.rank == 0:
        assert note_of(path) == "a run"
        assert sorted(file.name for file in path.parent.iterdir()) == ["fields", "fields.pvd"]
        reader, q = series(path), hand_of(d)
        assert reader.time_values == [0.0, 0.5, 1.0]
        start = reader.read()[0]
        assert not start["displacement"].any()
        reader.set_active_time_value(0.5)
        moved = reader.read()[0]
        x = moved.points[:, :d]
        np.testing.assert_allclose(moved["displacement"][:, :d], turned(x, q), atol=EXACT)
        np.testing.assert_allclose(moved["velocity"][:, :d], turned(x, 2 * q), atol=2 * EXACT)
        np.testing.assert_array_equal(moved.field_data["hand"], q)
        assert np.abs(moved["strain"]).max() < SINGLE * np.abs(q).max()  # a linear rotation strains nothing
        size = np.array([1.0, 2.0] if d == 2 else [1.0, 0.5, 2.0])
        linear = moved.linear_copy() if order < 3 else moved.tessellate(max_n_subdivide=0)
        sizes = linear.compute_cell_sizes()["Area" if d == 2 else "Volume"]
        assert np.sum(sizes) == pytest.approx(np.prod(size), abs=1e-6)  # VTK may add in single precision
        on_sides = (np.isclose(x[:, 0], 0) | np.isclose(x[:, 0], 1)) & (x[:, -1] > (1.333 if d == 2 else 1.499))
        np.testing.assert_array_equal(moved["held"].astype(bool), on_sides)
    comm.Barrier()


@pytest.mark.parametrize(("d", "order"), [(2, 1), (2, 2), (3, 1), (3, 3)])
def test_stress_of_a_known_gradient(comm: MPI.Intracomm, mpi_tmp_path: Path, d: int, order: int) -> None:
    """In cells that touch no contact node; sigma is written down with E and nu, von Mises with principal stresses."""
    path = write(comm, mpi_tmp_path, d, order)
    if comm.rank == 0:
        reader = series(path)
        reader.set_active_time_value(1.0)
        grid = reader.read()[0]
        held = grid["held"].astype(bool)
        free = np.array([not held[grid.get_cell(i).point_ids].any() for i in range(grid.n_cells)])
        assert free.sum() >= 6
        eps = np.zeros((3, 3))
        eps[:d, :d] = (affine(d) + affine(d).T) / 2
        young, nu = 10.0, 0.3
        sigma = young / (1 + nu) * (eps + nu / (1 - 2 * nu) * np.trace(eps) * np.eye(3))
        principal = np.linalg.eigvalsh(sigma)
        mises = np.sqrt(sum((principal[i] - principal[i - 1]) ** 2 for i in range(3)) / 2)
        for name, tensor in (("strain", eps), ("stress", sigma)):
            expected = tensor[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]
            np.testing.assert_allclose(grid[name][free], np.tile(expected, (free.sum(), 1)), atol=SINGLE)
        np.testing.assert_allclose(grid["von_mises"][free], mises, atol=SINGLE)
        stress = grid.cell_data.GetArray("stress")  # the names that ParaView shows
        assert [stress.GetComponentName(i) for i in range(6)] == ["xx", "yy", "zz", "xy", "yz", "xz"]
    comm.Barrier()


@pytest.mark.parametrize("law", ["neo-hooke", "stvk"])
def test_cauchy_stress_of_finite_strain(comm: MPI.Intracomm, law: str) -> None:
    """Uniaxial stretch by a finite amount, and the same turned: the stress turns with it. By hand in 3D."""
    model = make_model(comm, 3, 1, rotation=False, finite_strain={"law": law})
    stretch, (c, s) = np.diag([1.2, 0.95, 0.9]), (np.cos(0.7), np.sin(0.7))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    lam, mu = model.system.materials[0].lam, model.system.materials[0].mu
    J, b = np.prod(np.diag(stretch)), stretch**2
    if law == "neo-hooke":
        expected = (mu * (b - np.eye(3)) + lam * np.log(J) * np.eye(3)) / J
    else:
        E = (b - np.eye(3)) / 2
        expected = stretch @ (2 * mu * E + lam * np.trace(E) * np.eye(3)) @ stretch / J
    at = model.space.V.tabulate_dof_coordinates()
    cells = CellStress(model)
    for R in (np.eye(3), turn):
        strain, stress, _ = cells(at @ (R @ stretch - np.eye(3)).T)
        sigma = (R @ expected @ R.T)[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]
        np.testing.assert_allclose(stress, np.tile(sigma, (len(stress), 1)), atol=1e-12)  # rounding of order 10
        green = ((b - np.eye(3)) / 2)[[0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]]
        np.testing.assert_allclose(strain, np.tile(green, (len(strain), 1)), atol=1e-14)


@pytest.mark.ranks
def test_meshio_reads_the_same(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """A reader that is not VTK's; layers count in the order of the scene."""
    stiff = {"box": [[0.0, 0.0], [1.0, 0.8]], "material": {"young": 100.0, "poisson": 0.3, "rho": 1.0}}
    path = write(comm, mpi_tmp_path, 2, 2, layers={"low": stiff})
    if comm.rank == 0:
        mesh = meshio.read(path.parent / "fields" / "000001.vtu")
        np.testing.assert_allclose(
            mesh.point_data["displacement"][:, :2], turned(mesh.points[:, :2], hand_of(2)), atol=EXACT
        )
        cells = np.concatenate([block.data for block in mesh.cells if block.type == "triangle6"])
        middle = mesh.points[cells[:, :3]].mean(axis=1)
        np.testing.assert_array_equal(np.concatenate(mesh.cell_data["layer"]), (middle[:, 1] > 0.8).astype(int))
    comm.Barrier()


@pytest.mark.skipif(shutil.which("pvpython") is None, reason="no ParaView here")
def test_paraview_opens_it(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    path = write(comm, mpi_tmp_path, 3, 2)
    if comm.rank == 0:
        said = subprocess.run(
            ["pvpython", "-c", PARAVIEW.format(str(path))], capture_output=True, text=True, timeout=120, check=True
        ).stdout
        assert "[0.0, 0.5, 1.0] ['displacement', 'held', 'velocity']" in said
        assert "['layer', 'strain', 'stress', 'von_mises']" in said
    comm.Barrier()
