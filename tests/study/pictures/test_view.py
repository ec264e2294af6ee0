"""`softgrasp view` shows what a run left, or says in one sentence why not."""

from __future__ import annotations

import base64
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from softgrasp.fem.errors import ResourceError, SceneError
from softgrasp.fem.scene.file import shipped_scenes
from softgrasp.study.forward.run import run_simulate
from softgrasp.study.pictures.style import colour_map
from softgrasp.study.pictures.turning import Scene3D, colours
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
    assert move.label(6) == "3 s, hand at\n(5, 3) m"
    assert move.label(0) == "0 s, hand at\n(0, 0) m"
    end = move.body(6)
    assert end.center[:2] == pytest.approx([5.5, 4.0], abs=0.1)  # the body's middle and the target


@needs_pyvista
def test_a_title_leaves_out_what_rounding_moves(two_legs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four titles of three long numbers each would not be seen whole."""
    move = Move(two_legs, "von_mises")
    move.flat = False
    monkeypatch.setattr(Move, "_read", lambda *_: SimpleNamespace(field_data={"hand": [-7.25e-7, 2e-5, -0.0115]}))
    assert move.label(6) == "3 s, hand at\n(0, 2e-05, -0.0115) m"


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


def page_data(page: str) -> dict[str, Any]:
    """What a page draws: places (k, n, 3) [m] and the rest, as the browser reads it."""
    assert re.findall(r"(?:src|href|url)\s*[=(]", page.split("<script>")[0]) == []  # nothing is loaded
    assert re.findall(r"https?:|fetch|import", page) == []
    data = json.loads(re.findall(r'type="application/json" id="data">(.*?)</script>', page, re.DOTALL)[0])
    kinds = {"triangles": "<u4", "points": "<u2", "values": np.uint8, "colours": np.uint8}
    data |= {key: np.frombuffer(base64.b64decode(data[key]), kind) for key, kind in kinds.items()}
    data["points"] = data["low"] + data["step"] * data["points"].reshape(len(data["times"]), -1, 3)
    data["obstacles"] = [np.frombuffer(base64.b64decode(x), "<f4").reshape(-1, 3, 3) for x in data["obstacles"]]
    return data


@needs_pyvista
def test_a_page_has_every_place_value_and_instant(two_legs: Path, tmp_path: Path) -> None:
    """Against the field files: places to half a step of 16 bits, values to half a colour."""
    view(two_legs, "von_mises", tmp_path / "move.html")
    data = page_data((tmp_path / "move.html").read_text())
    move = Move(two_legs, "von_mises")
    assert data["times"] == pytest.approx(move.times)
    assert data["labels"][-1] == "3 s, hand at (5, 3) m"
    assert (data["stride"], data["by_cell"], data["obstacles"]) == (36, True, [])
    for i in (0, 3, 6):
        body = move.body(i)
        np.testing.assert_allclose(data["points"][i], body.points, atol=0.51 * data["step"])
        low, high = move.range
        share = np.clip((body.cell_data["value"] - low) / (high - low), 0, 1)
        np.testing.assert_allclose(data["values"].reshape(7, 36)[i] / 255, share, atol=0.51 / 255)
    corners = data["points"][0][data["triangles"].reshape(-1, 3)]
    sides = corners[:, 1:, :2] - corners[:, :1, :2]
    assert abs(np.linalg.det(sides)).sum() / 2 == pytest.approx(2.0, rel=1e-3)  # area of the strip; rounding of places


def test_pages_have_the_colours_of_pictures() -> None:
    exact = 255 * colour_map()(np.linspace(0.0, 1.0, 256))[:, :3]
    assert np.abs(colours() - exact).max() <= 4  # of 255, straight between twenty of them; nobody sees it


def test_a_page_thins_out_instants_and_keeps_what_moves_beside_the_body(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.study.pictures.turning.MOST_BYTES", 6 * 4 * 3)  # room for three instants
    triangle, times = np.array([[0, 1, 2], [0, 2, 3]]), np.arange(5.0)
    points = times[:, None, None] + np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    walls = [np.full((1, 3, 3), t) for t in times]
    scene = Scene3D(triangle, points, points[..., 0], list(times), ["</script>"] * 5, "x [m]", (0.0, 5.0), walls)
    data = page_data(scene.html())
    assert (data["times"], data["by_cell"], data["slower"]) == ([0.0, 2.0, 4.0], False, 1.0)
    assert [float(x.max()) for x in data["obstacles"]] == [0.0, 2.0, 4.0]
    np.testing.assert_allclose(data["points"], points[::2], atol=0.51 * data["step"])
    assert data["labels"] == ["</script>"] * 3  # no tag ends the data


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
    with pytest.raises(SceneError, match=r"move\.jpg: .*end the name in \.png or \.html"):
        view(two_legs, "von_mises", Path("move.jpg"))
    with pytest.raises(SceneError, match="--field heat: the files contain displacement, held, layer"):
        Move(two_legs, "heat")
    with pytest.raises(SceneError, match="has no field files"):
        Move(tmp_path, "von_mises")


def test_without_pyvista(two_legs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(ResourceError, match=r"pip install 'softgrasp\[view\]', or open .*fields.pvd in ParaView"):
        view(two_legs, "von_mises", Path("move.png"))
