"""Figures and animation: files with something on them, and the geometry drawn."""

from __future__ import annotations

import fem  # noqa: F401

# isort: split
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fem.gather import PictureMesh
from study.animation import gif_move
from study.plots import figure_move, figure_traces
from study.shapes import edge_sides, hand_polygons, outer_edges, pick_instants, silhouette

pytestmark = pytest.mark.serial  # no communication here


@pytest.fixture(autouse=True)
def _coarse_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("study.style.DPI", 90)  # fast


def rectangle(n: int = 4, contact: str = "sides") -> PictureMesh:
    """Unit square of 2 n^2 triangles; layers below and above one half."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
    points = np.stack([i, j], axis=1) / n
    a, b = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    p = a * (n + 1) + b
    cells = np.vstack([np.stack([p, p + n + 1, p + n + 2], 1), np.stack([p, p + n + 2, p + 1], 1)])
    k = np.arange(n)
    left, right = np.stack([k + 1, k], 1), np.stack([n * (n + 1) + k, n * (n + 1) + k + 1], 1)
    bottom = np.stack([k * (n + 1), (k + 1) * (n + 1)], 1)
    top = bottom[:, ::-1] + n
    held = np.vstack([left[n // 2 :], right[n // 2 :]]) if contact == "sides" else bottom
    layers = (points[cells][..., 1].mean(axis=1) > 0.5).astype(int)
    facets = np.vstack([left, right, bottom, top])
    return PictureMesh(points, cells, facets, held, layers, ("low", "high"), np.array([0.5, 1.0]), 2)


def cube() -> PictureMesh:
    """Unit cube of six tetrahedra around its diagonal; the two triangles at x = 0 are held."""
    points = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float)
    steps = {"x": 4, "y": 2, "z": 1}
    cells = np.array([np.cumsum([0, *(steps[c] for c in w)]) for w in ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")])
    faces = np.vstack([np.delete(cells, i, axis=1) for i in range(4)])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    facets = faces[first[count == 1]]
    x = points[facets]
    normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    inward = (normals * (x.mean(axis=1) - 0.5)).sum(axis=1) < 0
    facets[inward] = facets[inward][:, ::-1]
    held = facets[(points[facets][..., 0] == 0).all(axis=1)]
    return PictureMesh(points, cells, facets, held, np.zeros(6, int), ("tissue",), np.zeros(3), 3)


def move(picture: PictureMesh, reach: float, k: int = 9) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Straight move along all axes with a sway of the lower part: states, times, table, target."""
    times = np.linspace(0.0, 1.0, k)
    target = np.full(picture.n_s, reach)
    hands = times[:, None] * target
    states = np.repeat(hands[:, None, :], len(picture.points), axis=1)
    sway = np.where(np.isin(np.arange(len(picture.points)), picture.contact), 0.0, 0.1)
    states[..., 0] += np.sin(3 * times)[:, None] * sway
    return states, times, np.column_stack([times, hands]), target


def colours(path: Path) -> np.ndarray:
    """Distinct colours of a picture, counted on a coarse grid of values."""
    pixels = np.asarray(Image.open(path).convert("RGB"))
    assert pixels.shape[0] > 200
    assert pixels.shape[1] > 200
    return np.unique(pixels.reshape(-1, 3) // 16, axis=0)


@pytest.mark.parametrize(
    ("picture", "reach"),
    [(rectangle(), 3.0), (rectangle(), 0.1), (rectangle(contact="bottom"), 3.0), (cube(), 3.0), (cube(), 0.2)],
)
def test_figure_of_a_move_shows_colours_hand_and_target(tmp_path: Path, picture: PictureMesh, reach: float) -> None:
    states, times, table, target = move(picture, reach)
    chosen = pick_instants(picture, states, times, table)
    png, pdf = figure_move(picture, states[chosen], times[chosen], table, target, tmp_path / "move.png")
    found = colours(png)
    assert len(found) > 30  # a colour map, not lines only
    for wanted in ("2b2b2b", "d55e00"):  # hand and target
        rgb = np.array([int(wanted[i : i + 2], 16) for i in (0, 2, 4)]) // 16
        assert (np.abs(found.astype(int) - rgb).max(axis=1) <= 1).any(), wanted  # neighbours: rounding of the grid
    assert pdf.read_bytes().startswith(b"%PDF")


def test_a_big_mesh_is_drawn_as_outline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("study.plots.MANY_CELLS", 3)
    for picture in (rectangle(), cube()):
        states, times, table, target = move(picture, 3.0, 3)
        png, _ = figure_move(picture, states, times, table, target, tmp_path / "move.png")
        assert len(colours(png)) > 10


def test_figure_without_target_and_without_motion(tmp_path: Path) -> None:
    picture = rectangle()
    states, times, table, _ = move(picture, 0.0, 3)
    png, _ = figure_move(picture, 0 * states, times, table, None, tmp_path / "still.png")
    assert len(colours(png)) > 10


def test_traces_draw_hand_and_output(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 50)
    q = np.stack([t, t**2, 0.1 * t], axis=1)
    y = q[:, :2] + 0.01 * np.sin(9 * t)[:, None]
    names = ("tip_x", "tip_y")
    png, pdf = figure_traces(t, y, names, q[:, :2], tmp_path / "a.png")
    turned, _ = figure_traces(t, y, names, q, tmp_path / "b.png", rigid=q[:, :2], dimension=2)
    assert len(colours(png)) > 30
    assert pdf.stat().st_size > 1000
    assert Image.open(turned).height > Image.open(png).height  # a panel for the angle


@pytest.mark.parametrize("picture", [rectangle(), cube()])
def test_gif_moves_in_real_time(tmp_path: Path, picture: PictureMesh) -> None:
    states, times, table, target = move(picture, 3.0, 8)
    path = gif_move(picture, states, times, table, target, tmp_path / "move.gif")
    image = Image.open(path)
    assert image.n_frames == 8
    shown, frames = [], []
    for i in range(image.n_frames):
        image.seek(i)
        shown.append(image.info["duration"])
        frames.append(np.asarray(image.convert("RGB")))
    assert sum(shown[:-1]) == pytest.approx(1000, abs=10)  # [ms], one tick of GIF
    assert (frames[0] != frames[-1]).any(axis=2).mean() > 0.005  # the body has moved
    assert (frames[0][0, 0] == 255).all()
    assert path.stat().st_size <= 3_000_000


def test_pads_lie_outside_and_touch_the_contact() -> None:
    for contact, (axis, grip_side) in {"sides": (1, 1.0), "bottom": (1, -1.0)}.items():
        picture = rectangle(contact=contact)
        polygons, grip = hand_polygons(picture)
        inside = np.vstack(polygons)
        strictly = ((inside > 1e-9) & (inside < 1 - 1e-9)).all(axis=1)  # rounding
        assert not strictly.any()
        pads = np.stack(polygons[: len(picture.contact)])
        np.testing.assert_array_equal(pads[:, :2], picture.points[picture.contact])
        assert (grip[axis] - 0.5) * grip_side > 0.5  # beyond the end that is held


def test_silhouette_of_a_cube_is_a_hexagon() -> None:
    picture = cube()
    view = np.array([1.0, 0.7, 0.5]) / np.linalg.norm([1.0, 0.7, 0.5])
    edges = silhouette(picture.points, picture.facets, edge_sides(picture.facets), view)
    assert len(edges) == 6
    assert len(outer_edges(picture.points, picture.facets, edges, view)) == 6


def test_instants_do_not_overlap_when_they_need_not() -> None:
    picture = rectangle()
    assert len(pick_instants(picture, *move(picture, 4.0, 31)[:3])) == 4
    assert len(pick_instants(picture, *move(picture, 0.1, 31)[:3])) == 3
    assert pick_instants(picture, *move(picture, 0.0, 31)[:3]) == [0, 15, 30]
