"""The mesh study: growth of times with the mesh."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from mpi4py import MPI
from rich.console import Console

from benchmarks.meshes import MeshRow, break_even, findings, run_mesh_study


def test_mesh_study_of_small_meshes(mpi_tmp_path: Path, comm: MPI.Intracomm) -> None:
    console = Console(file=io.StringIO(), quiet=comm.rank != 0)
    result = run_mesh_study([300, 1200], 60, "psd_fixed_relative", 14, mpi_tmp_path, console, comm)
    assert [row["N"] for row in result["rows"]] == [14, 14]
    assert all(row["stable"] and row["error"] < 0.02 for row in result["rows"])  # 10 tissue columns, a coarse run
    if comm.rank == 0:
        assert json.loads((mpi_tmp_path / "mesh_study.json").read_text())["rows"] == result["rows"]
        assert (mpi_tmp_path / "mesh_study.png").stat().st_size > 5000


def test_exponent_and_break_even_mesh() -> None:
    rows = [
        MeshRow(8, n, 1.0, 1e-6 * n**1.5, 1e-5 * n, 1e-3, 1e-3, 14, 1e-3, 1e-2, True) for n in (10**3, 10**4, 10**5)
    ]
    assert findings(rows)["exponent_full"] == pytest.approx(1.5)
    assert findings(rows)["exponent_offline"] == pytest.approx(1.0)
    assert findings(rows)["exponent_online"] == pytest.approx(0.0, abs=1e-12)  # rounding
    assert break_even(rows) == pytest.approx(100.0)  # 1e-6 n^1.5 = 1e-3
    assert findings(rows[:1])["exponent_full"] is None
