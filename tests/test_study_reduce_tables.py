"""`softgrasp reduce`: which points its tables name, and the mesh study beside it."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from reduction.registry import PAPER_METHODS
from study.mesh_study import MeshRow, break_even, exponent, run_mesh_study
from study.reduce_sweep import BEYOND, Point, best, chosen_methods, nearest, noted
from study.reduce_tables import least_size, stability
from tests.helpers import make_scene

PAPER = Path(__file__).parent.parent / "demos" / "scenes" / "paper_forward.toml"


def test_scene_chooses_methods() -> None:
    assert chosen_methods(make_scene().reduction) == (*PAPER_METHODS, *BEYOND)
    assert chosen_methods(make_scene(reduction={"methods": ["psd_qv"]}).reduction) == ("psd_qv",)


def point(N: int, error: float, stable: bool = True, online: float = 1e-3) -> Point:
    return Point(N, N, (N,), error, *(5 * [2 * error]), 2.0, 1e-3, online, 0.0 if stable else 1.0, stable)


def test_choice_of_points() -> None:
    points = [point(4, 1e-1), point(12, 1e-3), point(14, 1e-9, stable=False), point(30, float("nan")), point(40, 1e-4)]
    assert nearest(points) == 1
    assert nearest(points, stable=False) == 2
    assert best(points) == 4
    assert noted(points) == {1, 2, 3, 4}  # nearest to 14, all and stable, nearest to 30, best
    assert least_size(points, 1e-2) == 12
    assert least_size(points, 1e-6) is None  # an unstable model does not count
    assert stability(points) == "not 14"
    assert nearest([]) is None


def test_mesh_study_of_small_meshes(mpi_tmp_path: Path, comm: MPI.Intracomm) -> None:
    console = Console(file=io.StringIO(), quiet=comm.rank != 0)
    result = run_mesh_study([300, 1200], 60, "psd_fixed", 10, mpi_tmp_path, console, comm)
    assert [row["N"] for row in result["rows"]] == [10, 10]
    assert all(row["stable"] and row["error"] < 0.02 for row in result["rows"])  # N = 10 of a coarse run
    if comm.rank == 0:
        assert json.loads((mpi_tmp_path / "mesh_study.json").read_text())["rows"] == result["rows"]
        assert (mpi_tmp_path / "mesh_study.png").stat().st_size > 5000


def test_exponent_and_break_even_mesh() -> None:
    rows = [
        MeshRow(8, n, 1.0, 1e-6 * n**1.5, 1e-5 * n, 1e-3, 1e-3, 14, 1e-3, 1e-2, True) for n in (10**3, 10**4, 10**5)
    ]
    assert exponent(rows, "time_full") == pytest.approx(1.5)
    assert exponent(rows, "time_offline") == pytest.approx(1.0)
    assert exponent(rows, "time_online") == pytest.approx(0.0, abs=1e-12)  # rounding
    assert break_even(rows) == pytest.approx(100.0)  # 1e-6 n^1.5 = 1e-3
    assert np.isnan(exponent(rows[:1], "time_full"))
