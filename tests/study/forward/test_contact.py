"""What `simulate` reports of contact, and the commands that refuse it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.lqr.design.scene import problem
from softgrasp.reduction.reduce import reduce
from softgrasp.study.forward.run import run_simulate

pytestmark = pytest.mark.serial
SCENE = ["tissue.cells=[4, 8]", "motion={profile='hold'}", "effects.gravity={g=[0, -5]}", "time.steps=100",
         "time.end=1",
         "effects.obstacles=true",
         "obstacle=[{kind='halfspace', name='table', normal=[0, 1], offset=-0.03}]"]  # fmt: skip


def test_forces_gaps_and_touching_nodes_are_in_the_files(tmp_path: Path) -> None:
    result = run_simulate(Path("paper_forward"), tmp_path, SCENE, Console(quiet=True), pictures=False)
    contact = simulate(build("paper_forward", SCENE)).contact
    assert contact is not None
    keys = result["contact"]["obstacles"]["table"]
    assert keys["force_end"] == contact.force[-1, 0].tolist()
    assert keys["nodes_max"] == contact.touching.max() > 0
    header, *rows = (tmp_path / "trajectory.csv").read_text().splitlines()
    names = header.split(",")
    table = np.array([[float(x) for x in row.split(",")] for row in rows])
    assert np.allclose(table[1:, names.index("table_force_y [N]")], contact.force[:, 0, 1], rtol=1e-9)  # digits written
    assert np.allclose(table[:, names.index("table_gap [m]")], contact.gap[:, 0], rtol=1e-9, atol=1e-15)


def test_reduction_and_control_refuse_contact() -> None:
    model = build("paper_forward", SCENE)
    with pytest.raises(SceneError, match=r"control cannot go with effects.obstacles yet"):
        problem(model)
    with pytest.raises(SceneError, match=r"a reduced model cannot go with effects.obstacles yet"):
        reduce(model, simulate(model))
