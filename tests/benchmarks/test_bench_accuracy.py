"""What the tolerances of [tissue.refine] reach, against a finer mesh of P3."""

from __future__ import annotations

import pytest
from mpi4py import MPI

from benchmarks import accuracy as bench
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate


@pytest.mark.serial
def test_tolerance_keeps_what_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "STEPS", 150)
    monkeypatch.setattr(bench, "REPEATS", 1)
    exact = bench.deformation(simulate(build(bench.paper(bench.graded(3, 1e-3)), comm=MPI.COMM_SELF)))
    found = bench.reach(1e-2, exact)
    assert 0.4 <= found.estimate <= 1.1
    assert found.bound >= 1
    assert found.corrected <= 0.6
    row = bench.MeshPoint("graded, P2", found.n_e, 0.1, 0.1, found.error, 0.1, 0.1, 1.0, 1e-6, 61, 1e-11)
    missed = [goal.text for goal in bench.goals([row], [found]) if not goal.ok and "seconds" not in goal.text]
    assert missed == ["solves of a Riccati equation, graded"]  # 61 > 60
    assert found.time_run <= found.time_all
