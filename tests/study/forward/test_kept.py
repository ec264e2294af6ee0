"""What `simulate` keeps of a run grows with what it looks at, not with the steps, and its files say so."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.errors import CheckpointError, Interrupted
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.states.frames import frame_count, frame_steps
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.forward import run as forward
from softgrasp.study.forward.cautions import looked_at, run_warnings
from tests.helpers.models import make_scene


@pytest.mark.ranks(2)
@pytest.mark.parametrize("steps", [60, 61, 10])
def test_few_states_are_those_that_the_warnings_take_of_all(comm: MPI.Intracomm, steps: int) -> None:
    model = build(make_scene(time={"steps": steps}), comm=comm)
    whole = simulate(model)
    few = simulate(model, RunOptions(few=looked_at(model.system.layout.n_e)))
    assert len(whole.snapshots.steps) == steps + 1
    assert len(few.snapshots.steps) == min(25, steps + 1)
    np.testing.assert_array_equal(few.snapshots.Z, whole.snapshots.columns(few.snapshots.steps).Z)
    assert run_warnings(model, few) == run_warnings(model, whole) != []


@pytest.mark.parametrize(("snapshots", "kept"), [("memory", 41), ("auto", 25)])
def test_simulate_keeps_all_states_only_where_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, snapshots: str, kept: int
) -> None:
    runs: list[Any] = []
    monkeypatch.setattr(forward, "simulate", lambda *given: runs.append(simulate(*given)) or runs[-1])
    changes = ["tissue.cells=[3,6]", "time.steps=40", f"output.snapshots={snapshots}", "output.fields=none"]
    console = Console(file=io.StringIO())
    forward.run_simulate(shipped_scenes()["paper_forward"], tmp_path, changes, console, quiet=True, pictures=False)
    assert len(runs[0].snapshots.steps) == kept


def test_a_run_that_kept_other_states_is_not_resumed(tmp_path: Path) -> None:
    model = build(make_scene())
    with pytest.raises(Interrupted):
        simulate(model, RunOptions(tmp_path, until=30, few=7))
    with pytest.raises(CheckpointError, match="resume with the command that was stopped"):
        simulate(model, RunOptions(tmp_path, resume=True))
    again = simulate(model, RunOptions(tmp_path, resume=True, few=7))
    np.testing.assert_array_equal(again.snapshots.Z, simulate(model, RunOptions(few=7)).snapshots.Z)


@pytest.mark.ranks(2)
def test_a_system_steps_on_without_its_components(comm: MPI.Intracomm) -> None:
    model = build(make_scene(), comm=comm)
    before = simulate(model)
    model.system.release()
    np.testing.assert_array_equal(simulate(model).final, before.final)
    assert run_warnings(model, before) != []


def test_frames_by_size() -> None:
    scene = make_scene(time={"steps": 600})
    counts = [frame_count(scene, n) for n in (1_000, 100_000, 410_878, 600_000, 10**8)]
    assert counts == [60, 60, 14, 10, 10]
    assert len(frame_steps(scene, 410_878)) == 15
    asked = make_scene(time={"steps": 600}, output={"frames": 70})
    assert frame_count(asked, 10**8) == 70
