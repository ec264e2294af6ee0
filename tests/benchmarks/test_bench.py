from __future__ import annotations

import csv
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from mpi4py import MPI
from typer.testing import CliRunner

from benchmarks import driver
from benchmarks import forward as bench_forward
from benchmarks import forward_rows as bench_worker
from benchmarks.__main__ import app
from benchmarks.driver import launch_worker
from benchmarks.forward_rows import ForwardCost, WholeRun
from benchmarks.peers import PlainCholesky, PymorLoop, ScipyLoop, TextbookLoop
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.motion import TableDrive
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.study.shell.processes import IN_MPI_JOB
from softgrasp.study.shell.timing import power_law

TINY: dict[str, Any] = {"size": 150, "repeats": 3, "repeat_seconds": 0.005}


@pytest.mark.parametrize("dimension", [2, 3])
def test_worker_returns_every_number_of_its_row(comm: MPI.Intracomm, dimension: int) -> None:
    point = bench_worker.measure(comm, dimension, **TINY)
    methods = {"ts", "solve", "own", "loop"} | ({"scipy", "pymor"} if comm.size == 1 else set())
    assert set(point.step_us) == methods
    assert all(len(samples) == 3 and min(samples) > 0 for samples in point.samples_us.values())
    assert point.step_us == {name: float(np.median(samples)) for name, samples in point.samples_us.items()}
    for name, value in (("solve", point.ratio), ("own", point.ratio_own)):
        assert value == np.median(np.divide(point.samples_us["ts"], point.samples_us[name]))
    assert set(point.seconds) == {"mesh", "assembly", "factor"}
    assert min(point.seconds.values()) > 0
    assert point.ranks == comm.size
    assert point.memory_mb >= point.memory_base_mb > 0
    assert point.drift < 1e-12  # the goal of the issue for undamped runs
    assert point.whole is None


def test_large_worker_runs_to_the_end(comm: MPI.Intracomm) -> None:
    point = bench_worker.measure_large(comm, 2, 200, 5, "tiny")
    assert point.drift_steps == 5
    assert point.residual < 1e-8  # what the solver itself accepts
    assert bench_forward.goals([point])[0].ok


def test_size_1000_is_the_paper_and_others_come_near(comm: MPI.Intracomm) -> None:
    assert bench_worker.cells_for(2, 1000) == [15, 30]
    scene = bench_worker.bench_scene(comm, 2, [15, 30], 600)
    assert scene.time_end == 3.0
    for d, size in ((2, 3000), (3, 3000)):
        n_e = build(bench_worker.bench_scene(comm, d, bench_worker.cells_for(d, size), 1), comm=comm).system.layout.n_e
        assert abs(n_e / size - 1) < 0.15  # one more cell a side adds up to 30 % in 3D at this size


@pytest.mark.serial
def test_all_methods_end_in_the_same_state(comm: MPI.Intracomm) -> None:
    model = build(bench_worker.bench_scene(comm, 2, [4, 8], 60, "memory"), comm=comm)
    system = model.system
    n = system.layout.n_e
    run = simulate(model)
    idle = Run(model, RunOptions())
    assert isinstance(idle.drive, TableDrive)
    loads = idle.drive.c
    K, M = to_scipy(system.K_ee), to_scipy(system.M_ee)
    # relative; 60 steps of rounding leave about 1e-13, a load one step off would leave 1e-2
    near = {"rtol": 0, "atol": 1e-9 * np.abs(run.final).max()}
    plain = PlainCholesky(midpoint_matrix(system, bench_worker.DT))
    loop = TextbookLoop(system, bench_worker.DT, plain.ksp.solve, loads)
    loop.advance(60)
    np.testing.assert_allclose(np.concatenate([loop.z.array_r, loop.v.array_r]), run.final, **near)
    assert run.snapshots is not None
    stored = ScipyLoop(K, M, system.G, bench_worker.DT, loads).store(60)
    np.testing.assert_allclose(stored, run.snapshots.Z, **near)
    again = ScipyLoop(K, M, system.G, bench_worker.DT, loads)
    again.advance(60)
    assert np.array_equal(np.concatenate([again.z, again.v]), stored[:, -1])
    pytest.importorskip("pymor")
    pymor = PymorLoop(K, M, system.G, bench_worker.DT, loads)
    pymor.advance(60)
    assert pymor.x.shape == (2 * n,)
    np.testing.assert_allclose(pymor.x, run.final, **near)


def test_methods_take_turns_and_none_is_always_first() -> None:
    calls: list[str] = []

    def method(name: str, values: list[float]) -> Any:
        def call() -> float:
            calls.append(name)
            return values.pop(0)

        return call

    samples = bench_worker.interleave({"a": method("a", [3.0, 9.0, 1.0]), "b": method("b", [2.0, 2.0, 8.0])}, 3)
    assert calls == ["a", "b", "b", "a", "a", "b"]
    assert bench_worker.medians(samples) == {"a": 3.0, "b": 2.0}


def test_exponents_of_made_up_costs_come_back() -> None:
    n = [956, 10_198, 99_856]
    assert power_law(n, [2e-6 * m**1.37 for m in n]) == pytest.approx(1.37, rel=1e-12)  # rounding of log
    assert power_law(n[:1], [1.0]) is None
    assert power_law(n, [0.0, 0.0, 5.0]) is None
    powers = bench_forward.exponents([made_up(m) for m in n])["1"]
    # rounding of log
    assert powers == pytest.approx({"assembly": 1.0, "factor": 1.5, "step": 1.1, "memory": 1.0}, rel=1e-12)


def made_up(n: int, **changes: Any) -> ForwardCost:
    point = ForwardCost(
        problem=f"2D {n}",
        dimension=2,
        cells=[1, 2],
        n_e=n,
        states=2 * n + 4,
        ranks=1,
        large=False,
        solver="cholesky",
        seconds={"mesh": 1.0, "assembly": 1e-6 * n, "factor": 1e-8 * n**1.5},
        step_us={"ts": 0.02 * n**1.1, "solve": 0.018 * n**1.1},
        ratio=1.2,
        ratio_own=1.4,
        drift=1e-14,
        drift_steps=600,
        residual=1e-15,
        memory_mb=100 + 0.02 * n,
        memory_base_mb=100.0,
        repeats=3,
        steps_per_repeat=10,
    )
    return replace(point, **changes)


def test_goals_are_told_apart_by_size() -> None:
    whole = WholeRun(600, {"ts_none": 0.02, "ts_memory": 0.03, "scipy": 0.06}, {}, 1e-14)
    goals = bench_forward.goals([made_up(956, whole=whole), made_up(10_198)])
    assert [(goal.limit, goal.ok) for goal in goals] == [(1.5, True), (1.0, True), (1.15, False)]
    assert goals[1].value == pytest.approx(0.5)


@pytest.mark.serial
def test_command_prints_one_table_and_writes_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def launch(name: str, spec: dict[str, Any], ranks: int) -> dict[str, Any]:
        if spec["size"] == 300:
            return {"points": [], "error": "exit status 1: broken"}
        return {"points": [asdict(made_up(spec["size"], ranks=ranks, problem=spec["problem"]))]}

    monkeypatch.setattr(driver, "launch_worker", launch)
    for name in IN_MPI_JOB:
        monkeypatch.delenv(name, raising=False)
    arguments = ["forward", "--sizes", "2d:2000,40000,3d:300", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 1  # a row failed, and the rest is there
    assert "3D 3e2, 1 rank(s) failed: exit status 1: broken" in done.output
    assert "goal missed: 2D" in done.output
    report = json.loads((tmp_path / "bench.json").read_text())
    assert (len(report["rows"]), len(report["failed"])) == (4, 2)
    assert set(report["exponents"]) == {"1", "2"}
    with (tmp_path / "bench.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert float(lines[0]["ts_us"]) == report["rows"][0]["step_us"]["ts"]
    assert lines[0]["scipy_us"] == ""
    assert len((tmp_path / "bench.md").read_text().splitlines()) == 2 + 4  # heads, and the rows that did not fail
    assert (tmp_path / "bench.png").stat().st_size > 0


@pytest.mark.ranks
@pytest.mark.serial
def test_driver_gets_numbers_from_two_ranks(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in IN_MPI_JOB:
        monkeypatch.delenv(name, raising=False)
    spec = {"dimension": 2, "large": False} | TINY
    result = launch_worker("forward", spec, 2)
    assert "error" not in result, result
    assert result["points"][0]["ranks"] == 2
    assert "ts" in result["points"][0]["step_us"]
    assert "ZeroDivisionError" in launch_worker("forward", spec | {"dimension": 0}, 2)["error"]


@pytest.mark.parametrize("text", ["4d:100", "2d:many", "2d:3", ""])
def test_a_wrong_size_is_refused(text: str) -> None:
    with pytest.raises(typer.BadParameter, match="write 2d:1000"):
        bench_forward.parse_sizes(text)
