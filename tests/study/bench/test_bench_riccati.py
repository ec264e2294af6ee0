"""The Riccati benchmark keeps what it has measured: rows as they come, methods of a failed row, resumed runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from softgrasp.study.bench import riccati as bench_riccati
from softgrasp.study.bench.riccati import Record, collect, collect_peers, launch

pytestmark = pytest.mark.serial
METHOD = {
    "seconds": 1.0, "split": {}, "solves": 50, "newton_steps": 1, "rank": 100, "residual": 9e-11, "memory_mb": 90.0,
    "memory_base_mb": 80.0,
}  # fmt: skip


def fake(calls: list[dict[str, Any]], fail: tuple[int, ...] = ()) -> Any:
    def worker(module: str, spec: dict[str, Any], ranks: int) -> dict[str, Any]:
        calls.append(spec | {"ranks": ranks})
        if "peer" in spec:
            return {"seconds": 1.0, "rank": 1, "residual": 1e-3, "gain_difference": 1.0, "states": 880}
        done = {"states": spec["nx"] ** 2, "n_e": 1, "ranks": ranks, "methods": {"newton_adi": METHOD}}
        if spec["nx"] in fail:
            Path(spec["partial"]).write_text(json.dumps(done))
            return {"error": "no result after 3600 s"}
        return done | {"methods": dict.fromkeys(spec["methods"], METHOD)}

    return worker


def test_methods_that_were_through_survive_a_failed_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_riccati, "launch_worker", fake([], fail=(20,)))
    row = launch({"nx": 20, "beta": 0.002, "methods": ["newton_adi", "radi"], "repeats": 1}, 2)
    assert "error" not in row
    assert row["methods"]["newton_adi"] == METHOD
    assert row["methods"]["radi"] == {"error": "no result after 3600 s"}


def test_rows_are_written_as_they_come_and_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, console, calls = tmp_path / "bench_riccati.json", Console(quiet=True), []
    monkeypatch.setattr(bench_riccati, "launch_worker", fake(calls, fail=(20,)))
    collect(console, [10, 20], [1, 2], 3, False, Record(file, 0.002))
    saved = json.loads(file.read_text())
    assert [(row["nx"], row["ranks"]) for row in saved["rows"]] == [(10, 1), (10, 2), (20, 1), (20, 2)]
    calls.clear()
    monkeypatch.setattr(bench_riccati, "launch_worker", fake(calls))
    record = Record(file, 0.002)
    record.resume()
    rows = collect(console, [10, 20], [1, 2], 3, False, record)
    assert [(spec["nx"], spec["ranks"]) for spec in calls] == [(20, 1), (20, 2)]  # the good ones are kept
    assert not any("error" in method for row in rows for method in row["methods"].values())
    other = Record(file, 0.02)
    other.resume()
    assert not other.rows  # another damping is another table


def test_peers_beyond_their_size_say_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr(bench_riccati, "launch_worker", fake(calls))
    peers = collect_peers(Console(quiet=True), [10, 80], Record(tmp_path / "b.json", 0.002))
    assert {(spec["peer"], spec["nx"]) for spec in calls} == {("scipy", 10), ("slycot", 10), ("pymor", 10)}
    left_out = [bench_riccati.peer_line(peer) for peer in peers if peer["nx"] == 80]
    assert len(left_out) == 3
    assert all("left out" in line and "beyond nx" in line for line in left_out)
