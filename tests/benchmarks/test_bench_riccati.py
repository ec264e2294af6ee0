"""The Riccati benchmark keeps what it has measured: rows as they come, methods of a failed row, resumed runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from benchmarks import driver
from benchmarks.driver import Failure, failures, of
from benchmarks.riccati import Record, SolverPoint, collect, collect_peers, peer_line
from softgrasp.fem.errors import CheckpointError

pytestmark = pytest.mark.serial


def point(spec: dict[str, Any], ranks: int, method: str) -> dict[str, Any]:
    return vars(SolverPoint(spec["nx"], ranks, method, spec["nx"] ** 2, 1.0, 100, 9e-11, 1e-8, 1e-5, solves=50))


def fake(calls: list[dict[str, Any]], fail: tuple[int, ...] = ()) -> Any:
    def worker(name: str, spec: dict[str, Any], ranks: int) -> dict[str, Any]:
        calls.append(spec | {"ranks": ranks})
        if spec["nx"] in fail:
            return {"points": [point(spec, ranks, "newton_adi")], "error": "no result after 3600 s"}
        return {"points": [point(spec, ranks, method) for method in spec.get("methods", [spec.get("peer")])]}

    return worker


def test_methods_that_were_through_survive_a_failed_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "launch_worker", fake([], fail=(20,)))
    spec = {"nx": 20, "beta": 0.002, "methods": ["newton_adi", "radi"], "repeats": 1}
    rows = driver.measure(Console(quiet=True), SolverPoint, "riccati", spec, 2, "nx = 20")
    assert [p.method for p in of(SolverPoint, rows)] == ["newton_adi"]
    assert failures(rows) == [Failure("nx = 20", 2, "no result after 3600 s")]


def test_rows_are_written_as_they_come_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, console, calls = tmp_path / "bench_riccati.json", Console(quiet=True), []
    monkeypatch.setattr(driver, "launch_worker", fake(calls, fail=(20,)))
    collect(console, [10, 20], [1, 2], 3, False, Record(file, 0.002))
    saved = json.loads(file.read_text())
    each = [(10, 1)] * 3 + [(10, 2)] * 3 + [(20, 1), (20, 2)]
    assert [(row["nx"], row["ranks"]) for row in saved["rows"]] == each
    assert len(saved["failed"]) == 2
    calls.clear()
    monkeypatch.setattr(driver, "launch_worker", fake(calls))
    record = Record(file, 0.002)
    record.resume()
    collect(console, [10, 20], [1, 2], 3, False, record)
    assert [(spec["nx"], spec["ranks"]) for spec in calls] == [(20, 1), (20, 2)]  # the good ones are kept
    assert len(record.points) == len(record.rows) == 12
    other = Record(file, 0.02)
    other.resume()
    assert not other.rows  # another damping is another table
    file.write_text('{"beta": 0.02, "rows": [{"nx": 10}], "peers": []}')
    with pytest.raises(CheckpointError, match="has no rows of this version"):
        other.resume()


def test_peers_beyond_their_size_say_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(driver, "launch_worker", fake(calls))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    record = Record(tmp_path / "b.json", 0.002)
    collect_peers(Console(quiet=True), [10, 80], record)
    assert {(spec["peer"], spec["nx"]) for spec in calls} == {("scipy", 10), ("slycot", 10), ("pymor", 10)}
    left_out = [peer_line(peer) for peer in record.peers if isinstance(peer, Failure)]
    assert len(left_out) == 3
    assert all("left out" in line and "beyond nx" in line for line in left_out)
