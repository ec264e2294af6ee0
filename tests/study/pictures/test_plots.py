"""Figures and animation: files with something on them, and the geometry drawn."""

from __future__ import annotations

import softgrasp.fem  # noqa: F401

# isort: split
import re
from contextvars import ContextVar
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageChops

from softgrasp.fem.columns import OutputColumn
from softgrasp.fem.fields.picture import PictureMesh
from softgrasp.study.pictures.animation import gif_move
from softgrasp.study.pictures.body import figure_move
from softgrasp.study.pictures.shapes import (
    hand_polygons,
    overlap,
    pick_instants,
    seen,
    shadow,
    speed_up,
    view_direction,
)
from softgrasp.study.pictures.style import save
from softgrasp.study.pictures.traces import traces
from softgrasp.study.report.document import Page as Document
from softgrasp.study.report.document import Section
from softgrasp.study.report.page import write_report
from tests.helpers.models import make_scene

pytestmark = pytest.mark.serial  # no communication here


@pytest.fixture(autouse=True)
def _coarse_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.study.pictures.style.DPI", 90)  # fast


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
    assert pixels.shape[0] > 100  # 150 dots an inch
    assert pixels.shape[1] > 100
    return np.unique(pixels.reshape(-1, 3) // 16, axis=0)


@pytest.mark.parametrize(
    ("picture", "reach"),
    [(rectangle(), 3.0), (rectangle(), 0.1), (rectangle(contact="bottom"), 3.0), (cube(), 3.0), (cube(), 0.2)],
)
def test_figure_of_a_move_shows_colours_hand_and_target(
    tmp_path: Path, picture: PictureMesh, reach: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    states, times, table, target = move(picture, reach)
    chosen = pick_instants(picture, states, times, table)
    monkeypatch.setattr("softgrasp.study.pictures.style.PDF", ContextVar("PDF", default=True))
    png, pdf = figure_move(picture, states[chosen], times[chosen], table, target, tmp_path / "move.png")
    found = colours(png)
    assert len(found) > 30  # a colour map, not lines only
    for wanted in ("2b2b2b", "d55e00"):  # hand and target
        rgb = np.array([int(wanted[i : i + 2], 16) for i in (0, 2, 4)]) // 16
        assert (np.abs(found.astype(int) - rgb).max(axis=1) <= 1).any(), wanted  # neighbours: rounding of the grid
    assert pdf.read_bytes().startswith(b"%PDF")


def test_a_big_mesh_is_drawn_as_outline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softgrasp.study.pictures.body.MANY_CELLS", 3)
    for picture in (rectangle(), cube()):
        states, times, table, target = move(picture, 3.0, 3)
        (png,) = figure_move(picture, states, times, table, target, tmp_path / "move.png")
        assert len(colours(png)) > 10


def test_figure_without_target_and_without_motion(tmp_path: Path) -> None:
    picture = rectangle()
    states, times, table, _ = move(picture, 0.0, 3)
    (png,) = figure_move(picture, 0 * states, times, table, None, tmp_path / "still.png")
    assert len(colours(png)) > 10
    (moved,) = figure_move(picture, 1e-3 * states, times, table, None, tmp_path / "swayed.png")
    assert Image.open(png).width < Image.open(moved).width  # no deformation, no colour bar


def test_traces_draw_hand_and_output(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 50)
    q = np.stack([t, t**2, 0.1 * t], axis=1)
    y = q[:, :2] + 0.01 * np.sin(9 * t)[:, None]
    names = (OutputColumn("tip", "x"), OutputColumn("tip", "y"))
    (png,) = save(traces(t, y, names, q[:, :2]), tmp_path / "a.png")
    (turned,) = save(traces(t, y, names, q, rigid=q[:, :2], dimension=2), tmp_path / "b.png")
    assert len(colours(png)) > 30
    assert Image.open(turned).height > Image.open(png).height  # a panel for the angle
    both = np.hstack([y, q[:, :2]])  # the hand as an output too: drawn once, so the picture is the same
    hand = (OutputColumn("hand", "x"), OutputColumn("hand", "y"))
    (again,) = save(traces(t, both, (*names, *hand), q[:, :2]), tmp_path / "c.png")
    assert ImageChops.difference(Image.open(again).convert("RGB"), Image.open(png).convert("RGB")).getbbox() is None
    (alone,) = save(traces(t, q[:, :2], hand, q[:, :2]), tmp_path / "d.png")
    assert Image.open(alone).height < Image.open(png).height  # nothing moves relative to the hand


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


def test_parallel_projection_keeps_what_is_across_the_view() -> None:
    view = view_direction()
    assert np.linalg.norm(view) == pytest.approx(1.0, abs=1e-15)  # rounding
    x = np.random.default_rng(3).normal(size=(5, 3))
    across = x - np.outer(x @ view, view)
    np.testing.assert_allclose(np.linalg.norm(seen(x), axis=1), np.linalg.norm(across, axis=1), rtol=1e-14)  # rounding
    assert seen(np.array([0.0, 0.0, 1.0]))[0] == pytest.approx(0.0, abs=1e-15)  # up stays up; rounding


def test_shadow_of_a_cube_is_a_hexagon_of_known_area() -> None:
    picture = cube()
    (line,) = shadow(seen(picture.points), picture.facets)
    x, y = line.T
    area = abs(float(x[:-1] @ y[1:] - x[1:] @ y[:-1])) / 2
    # A unit cube's shadow has the area |v_x| + |v_y| + |v_z|; the outline is half a pixel of 1/700 off all round.
    assert area == pytest.approx(float(np.abs(view_direction()).sum()), rel=5e-3)
    assert overlap(picture, np.zeros((2, 8, 3)))


def test_instants_do_not_overlap_when_they_need_not() -> None:
    picture = rectangle()
    far, near, still = (move(picture, reach, 31)[:3] for reach in (4.0, 0.1, 0.0))
    chosen = pick_instants(picture, *far)
    assert (len(chosen), chosen[0], chosen[-1]) == (4, 0, 30)
    assert not overlap(picture, far[0][chosen])
    between = pick_instants(picture, *move(picture, 2.5, 31)[:3])
    assert len(between) == 3  # four would touch
    for states, times, table in (near, still):
        panels = pick_instants(picture, states, times, table)
        assert len(panels) == 4
        assert 0 < panels[1] <= 15 < panels[2] < 30  # one in each half


def test_instants_differ_when_the_hand_rests_after_its_move() -> None:
    picture = rectangle()
    states, times, table, _ = move(picture, 4.0, 31)
    # As long again at rest: equal steps of time would show the same body twice.
    states, times = np.vstack([states, np.repeat(states[-1:], 30, axis=0)]), np.append(times, times[1:] + 1.0)
    table = np.vstack([table, np.column_stack([times[31:], np.repeat(table[-1:, 1:], 30, axis=0)])])
    chosen = pick_instants(picture, states, times, table)
    ways = np.linalg.norm(np.diff(table[chosen, 1:], axis=0), axis=1)
    assert len(chosen) == 4
    assert ways.min() > 0.15 * ways.sum()  # a third each if equal; 0 at rest


def test_many_frames_still_take_their_time(tmp_path: Path) -> None:
    picture = rectangle(2)
    states, times, table, target = move(picture, 3.0, 61)
    image = Image.open(gif_move(picture, states, times, table, target, tmp_path / "move.gif"))
    shown = []
    for i in range(image.n_frames):
        image.seek(i)
        shown.append(image.info["duration"])
    assert sum(shown[:-1]) == 1000  # [ms], 1/60 s is no whole number of ticks
    assert min(shown) >= 20  # shorter ones are slowed down by viewers


def test_long_moves_are_shown_faster_and_short_ones_slower() -> None:
    assert speed_up(np.array([0.0, 3.0])) == 1.0
    assert speed_up(np.array([0.0, 300.0])) == 10.0
    assert speed_up(np.array([0.0, 301.0])) == 20.0
    assert speed_up(np.array([0.0, 0.03])) == pytest.approx(0.02, rel=1e-12)  # rounding


class Page(HTMLParser):
    """Checks that tags are balanced and collects texts and addresses."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.cells: list[tuple[str, str]] = []
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)
        addresses = [value or "" for key, value in attrs if key in ("src", "href")]
        self.sources += [a for a in addresses if not a.startswith("#")]  # the contents link within the page

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and data.strip():
            self.cells.append((self.open[-1], data.strip()))


def test_report_is_one_balanced_page(tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 9)
    (png,) = save(traces(t, t[:, None], (OutputColumn("tip", "x"),), t[:, None] * [1.0, 0.0]), tmp_path / "a.png")
    table = Section(
        "Errors", "First.\n\nSecond <b>.", header=("N", "error", "ok"), rows=[(4, 1.25e-7, True), (6, None, False)]
    )
    sections = [Section("", figures=[(png, "caption")]), Section("Short", rows=[("a", 1)]), table]
    document = Document("A & B", ["One."], sections, subtitle="s", command="softgrasp reduce x.toml")
    path = write_report(tmp_path / "r.html", document, scene=make_scene())
    page = Page(path.read_text())
    assert not page.open
    assert len(page.sources) == 1  # the figure only
    assert page.sources[0].startswith("data:image/png;base64,")
    for cell in (
        ("h1", "A & B"),
        ("p", "Second <b>."),
        ("th", "error"),
        ("td", "1.25e-07"),
        ("td", "yes"),
        ("td", "a"),
        ("h2", "Equation"),
        ("h2", "Made with"),
    ):
        assert cell in page.cells
    with pytest.raises(ValueError, match="'Bad' has 2 columns"):
        write_report(tmp_path / "x.html", Document("t", (), [Section("Bad", rows=[(1, 2), (1, 2, 3)])]))


def test_figures_are_cut_like_matplotlibs_own_tight_ones(tmp_path: Path) -> None:
    """Legend outside, colour bar and logarithmic axis: nothing is lost, and no text goes through the formula parser."""
    import matplotlib.pyplot as plt

    from softgrasp.study.pictures import style

    def figure() -> Any:
        figure, axes = plt.subplots(2, 1, figsize=(4, 4), layout="constrained")
        places = axes[0].scatter([1, 2], [1e-3, 2.0], c=[0.1, 3.0], label="runs")
        axes[0].set(yscale="log", ylabel="error")
        axes[1].annotate("beside", (1.3, 0.5), xycoords="axes fraction", annotation_clip=False)
        figure.colorbar(places, ax=axes.tolist(), label="colour")
        figure.legend(loc="outside upper center", bbox_to_anchor=(0.5, 1.2))
        return figure

    with style.paper_style():
        own = figure()
        style.save(own, tmp_path / "own.png")
        figure().savefig(tmp_path / "tight.png", bbox_inches="tight", pad_inches=style.MARGIN)
    assert own.axes[0].yaxis.get_major_formatter()(1e-3) == "10⁻³"
    images = [Image.open(tmp_path / name).convert("L") for name in ("own.png", "tight.png")]
    # plain powers are a little narrower than formulas
    assert np.allclose(images[0].size, images[1].size, rtol=0.03)
    for image in images:
        ink = ImageChops.invert(image).getbbox()
        assert ink is not None
        assert min(ink[0], ink[1], image.width - ink[2], image.height - ink[3]) >= 1


def test_no_figure_places_its_axes_by_inches() -> None:
    """Matplotlib does, by its constrained layout."""
    sources = [
        path
        for room in ("study", "benchmarks", "demos", "tools")
        for path in (Path(__file__).parents[3] / room).rglob("*.py")
    ]
    assert len(sources) > 150
    found = [path.name for path in sources if re.search(r"add_axes|subplots_adjust|tight_layout", path.read_text())]
    assert found == []
