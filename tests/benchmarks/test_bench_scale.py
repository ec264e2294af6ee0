"""The bench of growth: its rows, exponents, errors of the model, lines and picture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from mpi4py import MPI

from benchmarks.scale import STAGES, draw, exponents, goals, lines, table_of, total, wrong
from benchmarks.scale_rows import ScaleCost, measure_row

ROW = ScaleCost(
    "3D P2", 1000, 250, 1, "stars", 4.0, dict.fromkeys(STAGES, 1.0), dict.fromkeys(STAGES, 2.0), 300.0, 200.0, 100.0,
    dict.fromkeys(STAGES, 1.0), dict.fromkeys(STAGES, 1e9),
)  # fmt: skip


def grown(ranks: int = 1, factor: int = 4) -> ScaleCost:
    """Ten times the unknowns for ``factor`` times the seconds."""
    return replace(ROW, n_e=10_000, ranks=ranks, seconds=dict.fromkeys(STAGES, float(factor)), memory_mb=2100.0)


@pytest.mark.ranks(2)
def test_a_row_is_a_run_of_its_size(comm: MPI.Intracomm) -> None:
    (row,) = measure_row(kind="3D P2", size=600, solver="stars")
    assert (row.kind, row.ranks, row.solver) == ("3D P2", comm.size, "stars")
    assert 300 < row.n_e < 1200
    assert set(row.seconds) == set(row.modelled) == set(STAGES)
    assert min(row.seconds.values()) > 0
    assert min(row.modelled.values()) > 0
    assert row.iterations > 1
    assert all(1 <= share <= comm.size for share in row.balance.values())
    assert row.memory_mb >= row.memory_base_mb > 0
    json.dumps(row.balance)


def test_growth_of_what_was_measured() -> None:
    assert exponents([ROW]) == {}
    (powers,) = exponents([ROW, grown(factor=10)]).values()
    assert powers["run"] == pytest.approx(1.0)
    assert powers["memory"] == pytest.approx(1.0)  # 200 and 2000 MiB above the libraries
    assert all(goal.ok for goal in goals([ROW, grown(factor=10)]))
    assert not any(goal.ok for goal in goals([ROW, grown(factor=100)]) if "memory" not in goal.text)
    assert total(ROW.seconds) == 3 + 200 + 60


def test_errors_of_the_model() -> None:
    found = wrong([ROW, grown()])
    assert found["run"] == (pytest.approx(2.0), pytest.approx(2.0))  # half and twice
    assert found["memory"][1] == pytest.approx(10.5)


def test_shared_cores_tell_no_times() -> None:
    table = table_of([ROW, grown(ranks=10_000)])
    times = [i for i, name in enumerate(table.header) if name.endswith("s]")]
    assert [table.rows[1][i] for i in times] == ["-"] * len(times)
    assert "-" not in [table.rows[0][i] for i in times]


def test_lines_reach_what_the_figure_promises(tmp_path: Path) -> None:
    found = lines("3D P2")
    assert found[1024][-1][0] == pytest.approx(1e8)
    assert found[1][-1][0] < 1e7, "the memory of one rank ends its line"
    by_ranks = [dict(points)[1e6] if 1e6 in dict(points) else points[-1][1] for points in found.values()]
    assert by_ranks[0] > by_ranks[-1]
    assert all(file.stat().st_size > 5000 for file in draw(tmp_path / "scale.png", [ROW, grown()], "3D P2"))
