"""The benchmark behind the size switches: its rows, its constants and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mpi4py import MPI
from typer.testing import CliRunner

import softgrasp.lqr.lowrank.modal_start
import softgrasp.reduction.online
from benchmarks import driver
from benchmarks import switches as bench_switches
from benchmarks.__main__ import app
from benchmarks.switches import COLUMNS, Setup, SwitchPoint, product, start
from softgrasp.study.shell.processes import IN_MPI_JOB


@pytest.mark.serial
def test_rows_compare_two_methods_and_leave_the_constants_alone(comm: MPI.Intracomm) -> None:
    before = softgrasp.lqr.lowrank.modal_start.FEW_MODES, softgrasp.reduction.online.TOGETHER
    rows = list(start(Setup(comm, 1, False)))
    assert [row.setting for row in rows] == [f"2D, {k} modes" for k in (15, 16, 30, 60)]
    assert all(row.first > 0 and row.second > 0 and row.ranks == 1 for row in rows)
    assert rows[0].limit == f"FEW_MODES = {before[0]}"
    assert before == (softgrasp.lqr.lowrank.modal_start.FEW_MODES, softgrasp.reduction.online.TOGETHER)
    assert len(driver.table_of(rows, COLUMNS).rows) == 4


@pytest.mark.serial
def test_products_are_measured_beside_scipy_and_petsc_by_rows_and_by_columns(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = iter(([2, 4], [3, 6]))
    monkeypatch.setattr(bench_switches, "cells_for", lambda d, size: next(sizes))
    rows = list(product(Setup(comm, 1, False)))
    assert len(rows) == 2 * 3 * 2 * 2
    assert {row.switch for row in rows} == {"product, SciPy", "product, PETSc"}
    assert all(row.first > 0 and row.second > 0 for row in rows)


@pytest.mark.serial
def test_command_writes_what_the_workers_measured(
    comm: MPI.Intracomm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = SwitchPoint("batch", "TOGETHER = 1 MB", "3 models", 1, 2.0, 3.0)
    answers = {1: {"points": [vars(point)]}, 2: {"points": [], "error": "exit status 1: no more"}}
    monkeypatch.setattr(driver, "launch_worker", lambda name, spec, ranks: answers[ranks])
    for name in IN_MPI_JOB:
        monkeypatch.delenv(name, raising=False)
    runner = CliRunner()
    good = runner.invoke(app, ["switches", "--switches", "batch", "--ranks", "1", "--out", str(tmp_path)])
    assert good.exit_code == 0, good.output
    assert "1.50" in good.output
    assert json.loads((tmp_path / "bench_switches.json").read_text())["rows"] == [vars(point)]
    assert (tmp_path / "bench_switches.csv").read_text().splitlines()[1].endswith("3 models,1,2.0,3.0")
    bad = runner.invoke(app, ["switches", "--switches", "batch,shift", "--out", str(tmp_path)])
    assert bad.exit_code == 1
    assert "shift, 2 rank(s) failed: exit status 1: no more" in bad.output
    assert "batch, 2 rank(s)" not in bad.output  # on one rank only
    wrong = runner.invoke(app, ["switches", "--switches", "btach", "--out", str(tmp_path)])
    assert wrong.exit_code == 2
    assert "'btach' is no switch" in wrong.output
