"""Figures of a move: the deformed body with hand, path and target.

Everything comes in as arrays; nothing here computes a simulation.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection, PolyCollection, TriMesh
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation

from softgrasp.fem import Array, PictureMesh
from softgrasp.study.pictures import shapes, style
from softgrasp.study.pictures.plate import around_bodies, hand_plate, held_facets, path_hidden
from softgrasp.study.pictures.shapes import MoveView
from softgrasp.study.pictures.style import colour_map, length_unit, paper_style, pressure_unit, save

MANY_CELLS = 300_000  # above, a picture shows the outline only
PAD, GAP, LINE = 0.1, 0.14, 0.18  # around the scene, between panels, height of a line of text [inch]
ROUNDING = 1e-12  # of the size of the body: what is smaller is no deformation
CAPTION = 0.72  # width of a caption [inch]
HALO = [withStroke(linewidth=2.5, foreground="white")]  # parts a caption from a path behind it
DOTS: Any = (0, (1, 1.2))
DASHES: Any = (0, (5, 3))


def make_view(
    picture: PictureMesh,
    states: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    tractions: Array | None = None,
) -> MoveView:
    """Prepare the views of a move; see `figure_move` for the arguments."""
    hands, given = shapes.hands_at(table, times), np.asarray([] if target is None else target, dtype=np.float64)
    aim = None if target is None else np.pad(given, (0, picture.n_s - len(given)))
    relative = [np.linalg.norm(u - picture.rigid(q), axis=1).max() for u, q in zip(states, hands, strict=True)]
    largest = float(max(relative))
    if largest <= ROUNDING * float(np.ptp(picture.points, axis=0).max()):
        largest = 0.0
    unit = length_unit(largest)
    norm = mpl.colors.Normalize(0.0, unit[0] * largest)
    polygons, grip = shapes.hand_polygons(picture) if picture.dimension == 2 else ([], shapes.contact_centre(picture))
    path = picture.path(table[:, 1:], grip)
    boxes = [_box(picture.points + u) for u in states] + [_box(path)]
    boxes += [_box(np.vstack(shapes.moved(picture, polygons, q))) for q in hands if polygons]
    if picture.dimension == 3:
        plates = [[*behind, *before] for behind, before in (hand_plate(picture, q) for q in hands)]
        boxes += [_box(np.vstack(plate)) for plate in plates if plate]
    if aim is not None:
        boxes += [_box(p) for p in shapes.moved(picture, [picture.points, *polygons], aim)]
    box, room = _box(np.vstack(boxes)), np.array([f(np.add(picture.points, states), (0, 1)) for f in (np.min, np.max)])
    if picture.obstacles:
        from softgrasp.study.pictures.obstacles import extent  # few scenes have any

        box = extent(picture.obstacles, times, room, box)
    low, high, apart = *box, np.zeros(0, dtype=int)
    pressure = 0.0 if tractions is None else float(np.linalg.norm(tractions, axis=2).max())
    if tractions is not None and pressure > 0 and picture.dimension == 3:
        from softgrasp.study.pictures.obstacles import far_apart

        apart = far_apart(picture, tractions)
    lines = [] if aim is None else outline(picture, picture.points + picture.rigid(aim))
    edges = [picture.facets, shapes.interfaces(picture)] if picture.dimension == 2 else [np.zeros((0, 2), dtype=int)]
    return MoveView(
        picture, states, times, hands, tractions if pressure > 0 else None, pressure, room, path, norm, unit, low, high,
        polygons, np.vstack(edges), lines, apart,
    )  # fmt: skip


def figure_move(
    picture: PictureMesh,
    states: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    out_png: Path,
    tractions: Array | None = None,
) -> tuple[Path, ...]:
    """The deformed body at a few instants with hand, path and target; PNG and PDF, whose names are returned.

    The instants are those of :func:`pick_instants`. Bodies that would hide each other get a panel each.

    Args:
        picture: the body.
        states: absolute vertex displacements, shape (k, n, d) [m], to choose from.
        times: instants of the states, shape (k,) [s].
        table: the whole hand motion, columns time and q_s, shape (steps, 1 + n_s) [s, m, rad].
        target: hand coordinates aimed at, d or n_s entries, or None.
        out_png: name of the picture; the PDF gets its stem.
        tractions: of contact at the vertices, shape (k, n, d) [Pa], or None.
    """
    chosen = shapes.pick_instants(picture, states, times, table)
    states, times = states[chosen].astype(np.float64), times[chosen]
    move = make_view(picture, states, times, table, target, None if tractions is None else tractions[chosen])
    with paper_style():
        meet = picture.dimension == 3 or shapes.overlap(picture, states)  # in 3D captions meet bodies
        apart = len(states) > 1 and meet
        solid = apart and picture.dimension == 3
        frames = around_bodies(picture, states, move.hands) if solid else []
        if solid:  # each body fills its panel; its place is in the title
            move = replace(move, low=frames[0][0], high=frames[0][1])
        groups = [[i] for i in range(len(states))] if apart else [list(range(len(states)))]
        figure, axes = make_axes(move, len(groups), captions=True)
        for ax, group in zip(axes, groups if apart else (), strict=False):
            ax.set_title(_time(times[group[0]]) + (place(move.hands[group[0]]) if solid else ""), pad=3)
        colour_bar(figure, axes, move)
        legend(figure, move)
        settle(figure)
        for ax, (low, high) in zip(axes, frames, strict=False):
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        for ax, group in zip(axes, groups, strict=True):
            draw_surroundings(ax, move, group)
            draw_scene(ax, move, states[group], None if apart else times[group], move.hands[group])
        name_layers(axes[-1], move, states[-1])
        return save(figure, out_png)


def draw_surroundings(ax: Any, move: MoveView, numbers: list[int]) -> None:
    """Obstacles at the instants with these numbers, and the pressure of contact on the bodies."""
    if move.picture.obstacles:
        from softgrasp.study.pictures.obstacles import draw_surroundings as draw  # few scenes have any

        draw(ax, move, numbers)


def draw_scene(ax: Any, move: MoveView, states: Array, times: Array | None, hands: Array) -> None:
    """Bodies, hand and, if given, the times beside the bodies on axes from `make_axes`."""
    picture = move.picture
    for i, (u, q) in enumerate(zip(states, hands, strict=True)):
        if picture.dimension == 2:
            _draw_2d(ax, move, u, q)
        else:
            _draw_3d(ax, move, u, q)
        if times is not None:
            whole = np.vstack([picture.points + u, *shapes.moved(picture, move.hand, q)])
            _caption(ax, move, _box(shapes.seen(whole)), _time(times[i]))


def make_axes(
    move: MoveView, panels: int, *, captions: bool, width: float | None = None, tallest: float | None = None
) -> tuple[Any, list[Any]]:
    """Figure and axes of the right shape for the scene, with path and target; call within `paper_style`.

    One panel fills a column unless it is flat, several the page; captions get room beside the bodies of one panel or
    above each of several. ``width`` is that of the figure, ``tallest`` the height of all panels together [inch].
    Matplotlib places the axes, at the latest in :func:`settle`.
    """
    solid, many = move.picture.dimension == 3, panels > 1
    span = np.maximum(move.high - move.low, 1e-3 * float((move.high - move.low).max()))
    flat = span[0] > 2.2 * span[1]
    width = width or (style.WIDTH if many or flat else style.COLUMN)
    tallest = tallest or (3.9 if many else 2.8)
    beside = np.array([0.8, 0.1]) if solid else np.array([1.3, 0.5])  # labels and colour bar
    pads = np.array([[PAD, PAD], [PAD, PAD]])  # [[left, bottom], [right, top]]
    if captions and not many:
        pads += np.array([[0.0, 0.0], [CAPTION, 0.0]]) if _upright(move) else np.array([[PAD, LINE], [PAD, 0.0]])

    def scale_of(shape: tuple[int, int]) -> float:
        """Inches per metre with that many rows and columns."""
        free = np.array([width - beside[0] - GAP * (shape[1] - 1), tallest - (GAP + LINE * captions) * (shape[0] - 1)])
        return float(((free / shape[::-1] - pads.sum(axis=0)) / span).min())

    rows, columns = max(((r, -(-panels // r)) for r in range(1, panels + 1) if panels % r == 0), key=scale_of)
    scale = scale_of((rows, columns))
    low, high = move.low - pads[0] / scale, move.high + pads[1] / scale
    w, h = (high - low) * scale
    size = beside[0] + columns * (w + GAP), beside[1] + rows * (h + GAP + LINE)
    figure, grid = plt.subplots(rows, columns, figsize=size, squeeze=False, sharex=not solid, sharey=not solid)
    figure.set_layout_engine("compressed", w_pad=GAP / 4, h_pad=GAP / 2, wspace=0.0, hspace=0.0)
    axes = list(grid.flat)
    for ax in axes:
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        ax.plot(*shapes.seen(move.path).T, ls=DASHES, color=style.OUTLINE, lw=0.9, zorder=1)
        for line in move.aim:
            ax.plot(*line.T, ls=DOTS, color=style.TARGET, lw=1.3, zorder=5)
        if solid:
            ax.set_axis_off()
            continue
        ax.xaxis.set_major_locator(MaxNLocator(int(np.clip(w / 0.5, 2, 6)), steps=style.STEPS))
        ax.yaxis.set_major_locator(MaxNLocator(int(np.clip(h / 0.4, 2, 6)), steps=style.STEPS))
        ax.label_outer()
    if solid:
        _tripod(axes[0], move)
    else:
        for ax in grid[-1]:
            ax.set_xlabel("x [m]")
        for ax in grid[:, 0]:
            ax.set_ylabel("y [m]")
    return figure, axes


def settle(figure: Any) -> None:
    """Let Matplotlib place axes, colour bar and legend, once and for all."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


def colour_bar(figure: Any, axes: list[Any], move: MoveView) -> None:
    """Colour bar of the relative displacement; none for outlines and where nothing deforms."""
    if len(move.picture.cells) > MANY_CELLS or not move.norm.vmax > 0:
        return
    height = 0.8 * figure.get_figheight()  # of the axes, about
    shrink = min(1.0, 2.4 / height)
    words = "displacement relative to the hand" if shrink * height > 2.2 else "displacement relative\nto the hand"
    words = words if height > 1.2 else "displacement\nrelative to\nthe hand"
    bar = figure.colorbar(
        mpl.cm.ScalarMappable(move.norm, colour_map()), ax=axes, label=f"{words} [{move.unit[1]}]", shrink=shrink,
        aspect=18 * shrink * height / 2.4, pad=0.02,
    )  # fmt: skip
    bar.outline.set_linewidth(0.5)
    bar.ax.yaxis.set_major_locator(MaxNLocator(int(np.clip(shrink * height / 0.35, 2, 6)), steps=style.STEPS))


def legend(figure: Any, move: MoveView) -> None:
    """One row above the axes, where nothing is hidden."""
    entries: list[Any] = []
    filled = len(move.picture.cells) <= MANY_CELLS
    if move.hand or filled:
        entries.append(Patch(color=style.HAND, label="hand"))
    if filled and not move.norm.vmax > 0:
        entries.append(Patch(color=colour_map()(0.0), label="tissue, not deformed"))
    if np.ptp(move.path, axis=0).max() > 0 and not path_hidden(move):
        entries.append(Line2D([], [], ls=DASHES, color=style.OUTLINE, lw=0.9, label="path of the hand"))
    if move.tractions is not None:
        factor, unit = pressure_unit(move.pressure)
        label = f"pressure, at most {factor * move.pressure:.3g} {unit}"
        entries.append(Line2D([], [], ls="", marker=r"$\rightarrow$", ms=9, color=style.HAND, label=label))
    if move.aim:
        entries.append(Line2D([], [], ls=DOTS, color=style.TARGET, lw=1.3, label="target"))
    figure.legend(handles=entries, loc="outside upper center", ncols=4, columnspacing=1.2, handlelength=1.8)


def _time(t: float) -> str:
    return f"t = {t:.3g} s"


def place(q: Array) -> str:
    """Where the hand is, under the time, in two digits; in mm below 1 m, so that captions of panels do not meet."""
    x, largest = q[:3], float(np.abs(q[:3]).max())
    factor, unit = (1e3, "mm") if largest < 1 else (1.0, "m")
    shown = np.where(np.abs(x) < max(1e-3 * largest, 1e-5), 0.0, factor * x)
    return f"\n({', '.join(f'{float(f"{v:.2g}"):g}' for v in shown)}) {unit}"


def _upright(move: MoveView) -> bool:
    """Whether the hand goes more up or down than sideways in the picture."""
    along, up = np.ptp(shapes.seen(move.path), axis=0)
    return bool(up > along)


def _caption(ax: Any, move: MoveView, box: Array, text: str) -> None:
    """A caption below the box of a body, or to its right if the bodies stand above each other."""
    if _upright(move):
        look: dict[str, Any] = {"xytext": (4, 0), "ha": "left", "va": "center", "path_effects": HALO}
        ax.annotate(text, (box[1, 0], box[:, 1].mean()), textcoords="offset points", zorder=6, **look)
        return
    left, right = ax.get_xlim()
    half = CAPTION / 2 * (right - left) / (ax.get_position().width * ax.figure.get_figwidth())
    middle, way = float(box[:, 0].mean()), shapes.seen(move.path[-1] - move.path[0])
    # The body next to it and lower lies to the left if the hand goes up to the right: keep off it.
    middle = max(middle, box[0, 0] + half) if way.prod() > 0 else middle
    middle = min(middle, box[1, 0] - half) if way.prod() < 0 else middle
    middle = min(max(middle, left + half), max(right - half, left + half))
    look = {"xytext": (0, -3), "ha": "center", "va": "top", "path_effects": HALO}
    ax.annotate(text, (middle, box[0, 1]), textcoords="offset points", zorder=6, **look)


def _free_corner(move: MoveView) -> str:
    """The left corner that the bodies leave free: "top", "bottom" or "" for none."""
    way = shapes.seen(move.path[-1] - move.path[0])
    if (np.abs(way) > move.high - move.low).any():  # the frame is that of one body of a longer way
        return ""
    if abs(float(way[0])) < 0.5 * float((move.high - move.low)[0]):
        return ""
    return "top" if way.prod() > 0 else "bottom"


def _tripod(ax: Any, move: MoveView) -> None:
    """The directions of a 3D scene, each arm of the same length in space, in a free left corner or beside the scene."""
    length = 0.2 * float((move.high - move.low).max())  # [m], rounded down to 1, 2 or 5 times a power of ten
    power = 10.0 ** np.floor(np.log10(length))
    length = power * max(m for m in (1, 2, 5) if m * power <= length * 1.001)
    ends, corner = shapes.seen(length * np.eye(3)), _free_corner(move)
    low, high = np.minimum(ends.min(axis=0), 0.0), np.maximum(ends.max(axis=0), 0.0)
    foot = move.low - low
    foot[0] -= 0.0 if corner else high[0] - low[0] + 0.15 * (move.high - move.low)[0]
    foot[1] = move.high[1] - high[1] if corner == "top" else foot[1] + 0.5 * length
    look: dict[str, Any] = {"annotation_clip": False, "ha": "center", "va": "center"}
    for name, end in zip("xyz", ends, strict=True):
        arm = {"arrowstyle": "-", "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", foot + end, foot, arrowprops=arm, annotation_clip=False)
        ax.annotate(name, foot + end, 5 * end / np.linalg.norm(end), textcoords="offset points", **look)
    # below the arms, or beside the highest where the first body stands below
    at, shift = (ends[2], (9, 5)) if corner == "top" else (low, (0, -13))
    look |= {"ha": "left"}
    ax.annotate(f"{length:g} m each", foot + at, shift, textcoords="offset points", **look)


def name_layers(ax: Any, move: MoveView, u: Array, *, inside: bool = False) -> None:
    """Names of the layers in 2D beside the body on the side with more room; without room, or on request, in it."""
    picture, x = move.picture, move.picture.points + u
    if len(picture.names) == 1 or picture.dimension == 3:
        return
    (left, right), (low, high) = ax.get_xlim(), _box(x)
    room = (low[0] - left, right - high[0])
    inch = (right - left) / (ax.get_position().width * ax.figure.get_figwidth())
    place, align = (low[0] - 0.06 * inch, "right") if room[0] > room[1] else (high[0] + 0.06 * inch, "left")
    look: dict[str, Any] = {"color": style.OUTLINE}
    if inside or max(room) < CAPTION * inch:
        place, align = (low[0] + high[0]) / 2, "center"
        look = {"color": style.HAND, "path_effects": [withStroke(linewidth=2.0, foreground="white")]}
    heights = x[:, 1][picture.cells].mean(axis=1)
    for i, name in enumerate(picture.names):
        ax.text(place, heights[picture.layers == i].mean(), name, ha=align, va="center", zorder=6, **look)


def _box(x: Array) -> Array:
    """Lower and upper corner of points in the plane of the picture, shape (2, 2)."""
    flat = shapes.seen(x)
    return np.stack([flat.min(axis=0), flat.max(axis=0)])


def outline(picture: PictureMesh, x: Array) -> list[Array]:
    """Closed lines around a body with its vertices at x, each (k, 2) [m]."""
    if picture.dimension == 2:
        return [x[line] for line in shapes.chained(picture.facets)]
    return shapes.shadow(shapes.seen(x), picture.facets)


def _draw_2d(ax: Any, move: MoveView, u: Array, q: Array) -> None:
    picture = move.picture
    x = picture.points + u
    if len(picture.cells) <= MANY_CELLS:
        look: dict[str, Any] = {"cmap": colour_map(), "norm": move.norm, "rasterized": True, "zorder": 2}
        body = TriMesh(Triangulation(x[:, 0], x[:, 1], picture.cells), array=move.values(u, q), **look)
        ax.add_collection(body, autolim=False)
    ax.add_collection(LineCollection(x[move.edges], colors=style.OUTLINE, linewidths=0.5, zorder=3), autolim=False)
    hand = PolyCollection(shapes.moved(picture, move.hand, q), color=style.HAND, linewidths=0.3, zorder=4)
    ax.add_collection(hand, autolim=False)


def _draw_3d(ax: Any, move: MoveView, u: Array, q: Array) -> None:
    picture = move.picture
    x = picture.points + u
    if len(picture.cells) > MANY_CELLS:
        lines = LineCollection(outline(picture, x), colors=style.OUTLINE, linewidths=0.6, zorder=3)
        ax.add_collection(lines, autolim=False)
        return
    for z, plate in zip((1.5, 2.5), hand_plate(picture, q), strict=True):
        flat = [shapes.seen(polygon) for polygon in plate]
        ax.add_collection(PolyCollection(flat, color=style.HAND, linewidths=0.3, zorder=z), autolim=False)
    faces, colours = _paint(move, u, q)
    look: dict[str, Any] = {"facecolors": colours, "edgecolors": colours, "linewidths": 0.5, "joinstyle": "round"}
    ax.add_collection(PolyCollection(list(shapes.seen(faces)), zorder=2, rasterized=True, **look), autolim=False)


def _paint(move: MoveView, u: Array, q: Array) -> tuple[Array, Array]:
    """Visible boundary of one instant from back to front, (m, 3, 3) [m], and its shaded colours (m, 3)."""
    picture, view = move.picture, shapes.view_direction()
    held = held_facets(picture)
    corners = (picture.points + u)[picture.facets]
    normals = shapes.facet_normals(corners)
    front = normals @ view > 0
    weights = shapes.subdivision(int(np.clip(np.sqrt(4000 / len(corners)), 1, 4)))
    faces = np.einsum("sck,fkd->fscd", weights, corners[front])
    values = move.values(u, q)[picture.facets[front]] @ weights.mean(axis=1).T
    rgb = colour_map()(move.norm(values))[..., :3]
    turn = np.radians(shapes.AZIMUTH - 35.0)
    light = np.array([0.6 * np.cos(turn), 0.6 * np.sin(turn), 0.8])
    lit = np.clip(normals[front] @ light, 0.0, 1.0)[:, None, None]
    dark = np.array(mpl.colors.to_rgb(style.HAND)) + 0.14 * lit
    rgb = np.where(held[front][:, None, None], dark, rgb * (0.75 + 0.25 * lit))
    faces, rgb = faces.reshape(-1, 3, 3), rgb.reshape(-1, 3)
    order = np.argsort(faces.mean(axis=1) @ view)
    return faces[order], rgb[order]
