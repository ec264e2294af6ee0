"""Figures of a closed loop: what is drawn stands where the numbers say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from softgrasp.fem.columns import OutputColumn, farthest, hand_columns
from softgrasp.study.pictures import loop as loop_plots
from softgrasp.study.pictures.loop import figure_decay, histories, settling_distance
from softgrasp.study.pictures.shapes import move_steps
from softgrasp.study.pictures.style import save

pytestmark = pytest.mark.serial


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures stay open behind ``save``, so that a test can look at what they hold."""
    figures: list[Any] = []
    keep = loop_plots.save

    def save(figure: Any, path: Path) -> Any:
        figures.append(figure)
        return keep(figure, path)

    monkeypatch.setattr(loop_plots, "save", save)
    yield figures
    plt.close("all")


TIMES = np.linspace(0.0, 30.0, 301)
Y = np.stack([2.0 * (1 - np.exp(-TIMES) * np.cos(9 * TIMES)), 1.0 - np.exp(-TIMES)], axis=1)
U = np.stack([np.exp(-TIMES[:-1]), -3.0 * np.exp(-TIMES[:-1])], axis=1)


def test_histories_show_the_numbers(tmp_path: Path) -> None:
    figure = histories(
        TIMES, Y, U, hand_columns(2, 2, "tip"), target=[2.0, 1.0], limits=2.0, settle=10.0, others={"N = 8": (Y, U)}
    )
    files = save(figure, tmp_path / "h.png")
    assert [f.suffix for f in files] == [".png"]
    assert np.asarray(Image.open(files[0])).std() > 1  # not one colour
    top, force, distance = figure.axes
    assert np.array_equal(top.lines[0].get_ydata(), Y[:, 0])
    assert top.get_xlim() == (0.0, 10.0)
    assert distance.get_xlim() == (0.0, 30.0)
    step = force.lines[0]
    assert step.get_drawstyle() == "steps-post"  # u is constant in a step, not joined by slopes
    assert np.array_equal(step.get_ydata()[:-1], U[:, 0])
    assert {line.get_ydata()[0] for line in force.lines[-2:]} == {-2.0, 2.0}
    assert distance.get_yscale() == "log"
    assert len(distance.lines) == 2
    texts = [t.get_text() for t in top.get_legend().get_texts()]
    assert texts == ["tip, x", "tip, y", "target"]


def test_torques_get_axes_of_their_own() -> None:
    loads, names = np.hstack([U, U[:, :1]]), (OutputColumn("a"), OutputColumn("b"))
    figure = histories(TIMES, Y, loads, names, dimension=2, limits=[2.0, np.inf, 0.5])
    _, force, torque = figure.axes
    assert {line.get_ydata()[0] for line in force.lines[2:]} == {-2.0, 2.0}
    assert {line.get_ydata()[0] for line in torque.lines[1:]} == {-0.5, 0.5}
    assert [ax.get_ylabel() for ax in figure.axes] == ["outputs [m]", "force [N]", "torque [N m]"]


def test_long_runs_are_thinned() -> None:
    t = np.linspace(0, 300, 300_001)
    y = np.sin(t)[:, None]
    figure = histories(t, y, y[:-1], (OutputColumn("y"),), target=[0.0])
    assert len(figure.axes[0].lines[0].get_xdata()) <= 2 * loop_plots.MANY_POINTS


def test_settling_distance_never_rises() -> None:
    y = np.array([[3.0], [0.0], [-2.0], [1.0], [0.0]])
    assert settling_distance(y, np.zeros(1)).tolist() == [3.0, 2.0, 2.0, 1.0, loop_plots.NEAREST]


def test_move_steps_end_with_the_run() -> None:
    assert move_steps(600, 0.5, 40.0, 4) == [0, 20, 40, 60, 80, 600]
    assert move_steps(10, 0.5, 1e9)[-1] == 10
    assert move_steps(10, 0.5, 0.0) == [0, 1, 10]


def test_decay_marks_every_pole(tmp_path: Path, drawn: list[Any]) -> None:
    stable = np.array([-1.0 + 5.0j, -1.0 - 5.0j, -0.3 + 0.0j])
    mixed = np.array([-2.0 + 7.0j, 0.0 + 3.0j, 0.5 + 0.0j])
    files = figure_decay({"closed": stable, "bad gain": mixed}, tmp_path / "d.png")
    assert all(f.stat().st_size > 0 for f in files)
    (ax,) = drawn[0].axes
    closed, _, bad, lost = ax.lines[:4]
    assert closed.get_ydata().tolist() == [1.0, 1.0, 0.3]
    assert closed.get_xdata()[:2].tolist() == [5.0, 5.0]
    assert bad.get_ydata().tolist() == [2.0]
    assert len(lost.get_ydata()) == 2
    assert set(lost.get_ydata()) == {ax.get_ylim()[0]}
    low, high = ax.get_xlim()
    assert all(low <= x <= high for line in ax.lines[:4] for x in line.get_xdata())
    assert "bad gain (2 without decay)" in [t.get_text() for t in ax.figure.legends[0].get_texts()]


@pytest.mark.parametrize("poles", [np.array([-1.0 + 0.0j]), np.array([-1.0 + 2.0j]), np.array([1.0 + 0.0j])])
def test_decay_of_few_poles(tmp_path: Path, poles: np.ndarray) -> None:
    assert figure_decay({"one": poles}, tmp_path / "one.png")[0].exists()


def test_rotations_get_axes_of_their_own() -> None:
    """Radians are not drawn as metres, and no two outputs of one panel share a colour."""
    names = (*hand_columns(3, 3, "tip"), *hand_columns(6, 3))
    y = np.outer(1 - np.exp(-TIMES), np.arange(1.0, 10.0))
    top, turn, force, _ = histories(TIMES, y, U, names, target=np.arange(1.0, 10.0)).axes
    assert [ax.get_ylabel() for ax in (top, turn, force)] == ["outputs [m]", "rotation [rad]", "force [N]"]
    assert len({line.get_color() for line in top.lines[:6]}) == 6
    assert np.array_equal(turn.lines[0].get_ydata(), y[:, 6])
    texts = [t.get_text() for t in turn.get_legend().get_texts()]
    assert texts == ["hand, about x", "hand, about y", "hand, about z", "target"]


def test_distance_is_that_of_the_farthest_output() -> None:
    y, names = (
        np.array([[3.0, 4.0, 6.0, 0.0, 9.0]]),
        (
            OutputColumn("tip", "x"),
            OutputColumn("tip", "y"),
            OutputColumn("hand", "x"),
            OutputColumn("hand", "y"),
            OutputColumn("hand", "rz"),
        ),
    )
    assert farthest(y, np.zeros(5), names).tolist() == [6.0]
    assert farthest(y[:, 4:], np.zeros(1), names[4:]).tolist() == [9.0]  # nothing but a rotation
    assert farthest(y[:, :2], np.zeros(2), (OutputColumn("a"), OutputColumn("b"))).tolist() == [5.0]
