"""`softgrasp view` shows what a run left, or says in one sentence why not."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from softgrasp.fem.errors import ResourceError, SceneError
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.pictures.view import Move, view

needs_pyvista = pytest.mark.skipif(importlib.util.find_spec("pyvista") is None, reason="no PyVista here")


@pytest.fixture(scope="module")
def two_legs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped and resumed: two field series."""
    out = tmp_path_factory.mktemp("run")
    changes = ["tissue.cells=[3,6]", "time.steps=30", "output.frames=6"]
    call = (shipped_scenes()["paper_forward"], out, changes, Console(quiet=True))
    run_simulate(*call, quiet=True, pictures=False, until=12)
    run_simulate(*call, quiet=True, pictures=False, resume=True)
    return out


@needs_pyvista
def test_parts_of_a_run_join_in_time(two_legs: Path) -> None:
    move = Move(two_legs, "von_mises")
    assert sorted(path.name for path in two_legs.glob("*.pvd")) == ["fields-from12.pvd", "fields.pvd"]
    assert move.times == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    assert move.title == "von_mises [Pa]"
    assert move.label(6) == "3 s\nhand at (5, 3) m"
    end = move.body(6)
    assert end.center[:2] == pytest.approx([5.5, 4.0], abs=0.1)  # the body's middle and the target


@needs_pyvista
def test_picture_shows_four_bodies(two_legs: Path, tmp_path: Path) -> None:
    """In a process of its own: without OpenGL the library ends it."""
    picture = tmp_path / "move.png"
    words = [sys.executable, "-m", "softgrasp.study.cli", "view", str(two_legs), "--save", str(picture)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=200, check=False)
    if done.returncode < 0:
        pytest.skip("no OpenGL here, not even in memory")
    assert done.returncode == 0, done.stderr
    assert str(picture) in done.stdout
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    coloured = np.ptp(pixels, axis=2)[100:500] > 30  # without titles and colour bar
    quarters = [part.sum() for part in np.array_split(coloured, 4, axis=1)]
    assert min(quarters) > 5000  # of 128,000 pixels
    assert not np.array_equal(pixels[:, :320], pixels[:, 320:640])


@needs_pyvista
def test_obstacles_are_shown_where_they_are() -> None:
    """Beside a body from 0 to 1: a table half a unit below, a disc that moves, and a ball too far away to be shown."""
    from softgrasp.fem import Ball, HalfSpace, Obstacle, Polytope
    from softgrasp.study.pictures.solids import solids

    table = Obstacle("table", "halfspace", HalfSpace(np.array([0.0, 1.0]), -0.2), None)
    disc = Obstacle("disc", "disc", Ball(np.array([1.1, 0.5]), 0.05), lambda t, order: np.array([t, 0.0]))
    box = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
    seen = solids((table, disc), 0.1, box, flat=True)
    low, high = np.array(seen.bounds).reshape(3, 2).T
    assert low[1] == pytest.approx(-0.25)  # cut off a quarter of the body beside it
    assert (low[0], high[0]) == pytest.approx((-0.25, 1.25))
    assert -0.01 < high[2] < 0  # behind the body
    only = solids((disc,), 0.1, box, flat=True)
    assert np.array(only.bounds)[:4] == pytest.approx([1.15, 1.25, 0.45, 0.55], abs=1e-3)  # 96 corners
    ball = Obstacle("ball", "ball", Ball(np.array([0.0, 0.0, -9.0]), 0.5), None)
    cube = Obstacle("cube", "box", Polytope.box(np.array([0.2, 0.2, -0.5]), np.array([0.4, 0.4, -0.1])), None)
    solid = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert solids((ball,), 0.0, solid, flat=False) is None
    assert np.array(solids((ball, cube), 0.0, solid, flat=False).bounds) == pytest.approx(
        [0.2, 0.4, 0.2, 0.4, -0.25, -0.1]
    )


@needs_pyvista
def test_refusals(two_legs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(SceneError, match="no display here"):
        view(two_legs, "von_mises", None)
    with pytest.raises(SceneError, match=r"ends in \.png"):
        view(two_legs, "von_mises", Path("move.jpg"))
    with pytest.raises(SceneError, match="--field heat: the files contain displacement, held, layer"):
        Move(two_legs, "heat")
    with pytest.raises(SceneError, match="has no field files"):
        Move(tmp_path, "von_mises")


def test_without_pyvista(two_legs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ResourceError, match=r"pip install 'softgrasp\[view\]', or open .*fields.pvd in ParaView"):
        view(two_legs, "von_mises", Path("move.png"))
