"""What `simulate` reports of contact, and the commands that refuse it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.lqr.design.scene import problem
from softgrasp.reduction.reduce import reduce
from softgrasp.study.forward.cautions import small_obstacles
from softgrasp.study.forward.explain import explain_model
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


@pytest.mark.parametrize(
    ("obstacle", "order", "size"),
    [  # of a body of 1 m by 2 m: boundary edges of 0.25 m
        ("kind='disc', center=[0.5, -0.5], radius=0.24", 1, "0.24 m in radius"),
        ("kind='disc', center=[0.5, -0.5], radius=0.26", 1, ""),
        ("kind='disc', center=[0.5, -0.5], radius=0.24", 2, ""),
        ("kind='disc', center=[0.5, -0.5], radius=0.12", 2, "0.12 m in radius"),
        ("kind='box', lo=[-2, -0.5], hi=[2, -0.3]", 1, "0.2 m thick"),
        ("kind='box', lo=[-2, -0.5], hi=[2, -0.25]", 1, ""),  # as thick as an edge is long
        ("kind='polygon', points=[[0, -0.1], [-1, -1], [1, -1]]", 1, ""),
        ("kind='halfspace', normal=[0, 1], offset=-0.1", 1, ""),
    ],
)
def test_an_obstacle_that_is_small_against_an_edge_is_warned_of(obstacle: str, order: int, size: str) -> None:
    model = build("paper_forward", [*SCENE[:-1], f"tissue.order={order}", f"obstacle=[{{name='pin', {obstacle}}}]"])
    expected = f"Obstacle 'pin' is {size}, less than the {0.25 / order:.2g} m between boundary nodes"
    texts = small_obstacles(model)
    assert [text.partition(":")[0] for text in texts] == ([expected] if size else [])
    if "0.24" in size:  # one is enough
        assert texts[0] in explain_model(model).warnings


@pytest.mark.parametrize("offset", [-5.0, -0.34, -0.25])
def test_explain_advises_to_drop_obstacles_that_the_path_stays_clear_of(offset: float) -> None:
    move = "motion={target=[0.1, -0.3], duration=1.0}"
    table = f"obstacle=[{{kind='halfspace', normal=[0, 1], offset={offset}}}]"
    model = build("paper_forward", [*SCENE[:1], move, *SCENE[2:-1], table])
    texts = [text for text in explain_model(model).warnings if "stays" in text]
    touched = simulate(model).contact
    assert touched is not None
    assert len(texts) == (offset == -5)
    assert (touched.columns > 0) == (offset > -1)  # at -0.34 by its deformation alone
    if texts:  # the lowest nodes end 0.3 m below y = 0
        assert "stays 4.7 m from every obstacle" in texts[0]
        assert "estimated at" in texts[0]
        margin = float(texts[0].partition("estimated at ")[2].split()[0])
        assert touched.gap.min() > 4.7 - margin


def test_a_run_begins_with_the_warning_of_a_small_obstacle(tmp_path: Path) -> None:
    pin = "obstacle=[{name='pin', kind='disc', center=[0.5, -0.5], radius=0.1}]"
    console = Console(record=True, quiet=False, file=io.StringIO())
    result = run_simulate(Path("paper_forward"), tmp_path, [*SCENE[:-1], pin], console, pictures=False)
    assert sum("Obstacle 'pin' is 0.1 m in radius" in text for text in result["warnings"]) == 1
    text = console.export_text()
    assert 0 < text.index("Obstacle 'pin' is 0.1 m") < text.index("energy")
