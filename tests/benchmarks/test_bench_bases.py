"""The benchmark of the engines, and the engines on its matrix of known singular values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from mpi4py import MPI
from typer.testing import CliRunner

from benchmarks import bases as bench_bases
from benchmarks import driver
from benchmarks.__main__ import app
from benchmarks.bases import known_matrix, parse_shapes, right_down_to, spectrum_of
from softgrasp.reduction.bases.engines import ENGINES, EngineName, factor, small_svd
from softgrasp.study.shell.processes import IN_MPI_JOB
from tests.helpers.models import same_everywhere


@pytest.mark.ranks
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("complex_valued", [False, True])
def test_singular_values_are_right_down_to_the_stated_limit(
    comm: MPI.Intracomm, engine: EngineName, complex_valued: bool
) -> None:
    n, m = 3000, 150
    X = known_matrix(comm, n, m, complex_valued)
    f = factor(comm, np.asfortranarray(np.hstack([X.real, X.imag])) if complex_valued else X, engine)
    s = small_svd(comm, f.R[:, :m] + 1j * f.R[:, m:] if complex_valued else f.R)[1] * f.scale
    limit = 1e-6 if engine == "gram" else 1e-9  # the 1e-10 at its 600 columns: see the next test
    assert right_down_to(s, spectrum_of(m), 1e-8) <= limit  # 8 digits
    assert same_everywhere(comm, s)


def test_default_is_right_to_1e_8_down_to_1e_10(comm: MPI.Intracomm) -> None:
    X = known_matrix(comm, 6000, 400, False)
    f = factor(comm, X)
    assert right_down_to(f.scale * small_svd(comm, f.R)[1], spectrum_of(400), 1e-8) <= 1e-10  # the numbers


def test_shapes_of_the_benchmark() -> None:
    assert parse_shapes("100x10, 200x4") == [(100, 10), (200, 4)]
    with pytest.raises(typer.BadParameter, match="is no shape"):
        parse_shapes("10x100")


@pytest.mark.ranks(2)
def test_benchmark_measures_every_engine(comm: MPI.Intracomm) -> None:
    points = bench_bases.measure(900, 200, 1, comm)
    names = {"tsqr", "svd", "svd_all", "gram", "psd_tsqr", "psd_gram"}
    assert {p.engine for p in points} == (names | {"numpy", "psd_numpy"} if comm.size == 1 else names)
    for p in points:
        assert p.orthonormality < 1e-12, p.engine  # rounding
        assert p.seconds > 0
        # Gram has half the digits; svd stops at 60 of 200 values, the last of them 1.8e-5
        assert p.rough <= p.right < (1e-6 if p.engine != "svd" else 2e-5), p.engine
    assert all(goal.ok for goal in bench_bases.goals(points))
    first = replace(points[0], right=2e-10)
    assert first.engine == "tsqr"
    assert not bench_bases.goals([first])[0].ok  # its goal is 1e-10


def test_benchmark_prints_one_table_and_fails_with_its_workers(
    mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "launch_worker", lambda name, spec, ranks: {"points": [], "error": "no"})
    for variable in IN_MPI_JOB:
        monkeypatch.delenv(variable, raising=False)
    folder = mpi_tmp_path / str(MPI.COMM_WORLD.rank)
    done = CliRunner().invoke(app, ["bases", "--sizes", "40x8", "--ranks", "1", "--out", str(folder)])
    assert done.exit_code == 1
    assert "40 x 8, 1 rank(s) failed: no" in done.stdout
    assert (folder / "bench_bases.json").is_file()
    assert (folder / "bench_bases.csv").read_text().startswith("engine,rows,columns,ranks,seconds")
