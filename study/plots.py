"""Figures of a move: the deformed body with hand and target, and the traces against time.

Everything comes in as arrays; nothing here computes a simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform

from study.shapes import (
    chained,
    contact_centre,
    edge_sides,
    facet_normals,
    hand_polygons,
    interfaces,
    outer_edges,
    overlap,
    silhouette,
    subdivision,
)
from study.style import CYCLE, HAND, OUTLINE, TARGET, WIDTH, colour_map, length_unit, paper_style, save

if TYPE_CHECKING:
    from fem.gather import PictureMesh

Array = npt.NDArray[np.float64]

MANY_CELLS = 300_000  # above, a picture shows the outline only
STEPS = [1, 2, 5, 10]  # of the axes
ELEVATION, AZIMUTH = 18.0, -58.0  # view of 3D scenes [degree]


@dataclass(frozen=True)
class Shot:
    """What every view of one move shares.

    Attributes:
        picture: the body.
        hands: hand coordinates at the instants, shape (k, n_s).
        path: where the grip of the hand passes, shape (steps, d) [m].
        target: hand coordinates aimed at, shape (n_s,), or None.
        norm: scale of the colours [unit].
        unit: factor and name of the unit of the colours.
        low, high: corners of the scene, shape (d,) [m].
        hand: polygons of the hand where it starts, each (corners, d); empty in 3D.
    """

    picture: PictureMesh
    hands: Array
    path: Array
    target: Array | None
    norm: Any
    unit: tuple[float, str]
    low: Array
    high: Array
    hand: list[Array]

    def values(self, displacement: Array, q_s: Array) -> Array:
        """|u - R q_s| at the vertices in the unit of the colour bar, shape (n,)."""
        return np.asarray(self.unit[0] * np.linalg.norm(displacement - self.picture.rigid(q_s), axis=1))


def make_shot(picture: PictureMesh, states: Array, times: Array, table: Array, target: npt.ArrayLike | None) -> Shot:
    """Prepare the views of a move; see `figure_move` for the arguments. Not collective."""
    hands = np.stack([np.interp(times, table[:, 0], column) for column in table[:, 1:].T], axis=1)
    aim = None
    if target is not None:
        aim = np.zeros(picture.n_s)
        given = np.asarray(target, dtype=np.float64)
        aim[: len(given)] = given
    relative = [np.linalg.norm(u - picture.rigid(q), axis=1).max() for u, q in zip(states, hands, strict=True)]
    unit = length_unit(max(relative))
    norm = mpl.colors.Normalize(0.0, unit[0] * max(relative) or 1.0)
    polygons, grip = hand_polygons(picture) if picture.dimension == 2 else ([], contact_centre(picture))
    path = np.vstack([grip + picture.rigid(q, grip[None, :]) for q in table[:, 1:]])
    seen = [_box(picture.points + u) for u in states] + [_box(path)]
    seen += [_box(p + picture.rigid(q, p)) for p in polygons for q in hands]
    if aim is not None:
        seen += [_box(p + picture.rigid(aim, p)) for p in (picture.points, *polygons)]
    low, high = _box(np.vstack(seen))
    return Shot(picture, hands, path, aim, norm, unit, low, high, polygons)


def figure_move(
    picture: PictureMesh,
    states: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    out_png: Path,
) -> tuple[Path, Path]:
    """The deformed body at a few instants with hand, path and target; PNG and PDF.

    Bodies that would hide each other get a panel each.

    Args:
        picture: the body.
        states: absolute vertex displacements, shape (k, n, d) [m].
        times: instants of the states, shape (k,) [s].
        table: the whole hand motion, columns time and q_s, shape (steps, 1 + n_s) [s, m, rad].
        target: hand coordinates aimed at, d or n_s entries, or None.
        out_png: name of the picture; the PDF gets its stem.

    Returns:
        Names of PNG and PDF.
    """
    states, times = np.asarray(states, dtype=np.float64), np.asarray(times, dtype=np.float64)
    shot = make_shot(picture, states, times, np.asarray(table, dtype=np.float64), target)
    with paper_style():
        apart = len(states) > 1 and overlap(picture, states)
        groups = [[i] for i in range(len(states))] if apart else [list(range(len(states)))]
        figure, axes = make_axes(shot, len(groups))
        for ax, group in zip(axes, groups, strict=True):
            draw_scene(ax, shot, states[group], times[group], shot.hands[group])
        if apart and picture.dimension == 2:
            _name_layers(axes[-1], shot, states[-1])
        colour_bar(figure, axes, shot)
        legend(figure, axes, shot)
        return save(figure, out_png)


def figure_traces(
    times: Array,
    outputs: Array,
    names: tuple[str, ...],
    q_s: Array,
    out_png: Path,
    *,
    rigid: Array | None = None,
    dimension: int | None = None,
) -> tuple[Path, Path]:
    """Hand and outputs against time, and below what the outputs move relative to the hand; PNG and PDF.

    Args:
        times: shape (m,) [s].
        outputs: absolute displacements, shape (m, c) [m].
        names: one per output, ending in _x, _y or _z.
        q_s: hand, shape (m, n_s) [m, rad].
        out_png: name of the picture; the PDF gets its stem.
        rigid: share of the outputs that moves with the hand, shape (m, c); by default the hand's translation.
        dimension: 2 or 3; needed when a 2D hand turns.

    Returns:
        Names of PNG and PDF.
    """
    d = dimension or min(q_s.shape[1], 3)
    axes_of = ["xyz".find(name.rsplit("_", 1)[-1][-1:]) for name in names]
    shown = [i for i, axis in enumerate(axes_of) if 0 <= axis < d]
    moving = np.stack([q_s[:, axes_of[i]] for i in shown], axis=1) if rigid is None else rigid[:, shown]
    relative = outputs[:, shown] - moving
    bodies = list(dict.fromkeys(names[i].rsplit("_", 1)[0] for i in shown))
    angles = q_s.shape[1] > d
    with paper_style():
        figure, axes = plt.subplots(
            2 + angles, 1, figsize=(WIDTH * 0.8, 3.6 + 1.3 * angles), sharex=True, layout="constrained"
        )
        factors = [
            length_unit(float(np.abs(a).max(initial=0.0)))
            for a in (np.hstack([outputs[:, shown], q_s[:, :d]]), relative)
        ]
        for j in np.flatnonzero(np.abs(q_s[:, :d]).max(axis=0) > 0).tolist():
            axes[0].plot(times, factors[0][0] * q_s[:, j], "--", color=CYCLE[j], lw=1.1, label=f"hand, ${'xyz'[j]}$")
        for k, i in enumerate(shown):
            body = names[i].rsplit("_", 1)[0]
            look = {"color": CYCLE[axes_of[i]], "ls": ("-", "-.", ":")[bodies.index(body) % 3]}
            label = f"{body}, ${'xyz'[axes_of[i]]}$"
            axes[0].plot(times, factors[0][0] * outputs[:, i], label=label, **look)
            axes[1].plot(times, factors[1][0] * relative[:, k], label=label, **look)
        axes[0].set_ylabel(f"displacement [{factors[0][1]}]")
        axes[1].set_ylabel(f"relative to the hand [{factors[1][1]}]")
        if angles:
            for j in range(d, q_s.shape[1]):
                axes[2].plot(times, q_s[:, j], "--", color=CYCLE[(j - d) % len(CYCLE)], label=f"angle {j - d + 1}")
            axes[2].set_ylabel("hand angle [rad]")
        for ax in axes:
            ax.axhline(0.0, color="#bbbbbb", lw=0.6, zorder=0)
            if ax is not axes[1]:  # same lines as above
                ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), handlelength=2.4)
            ax.yaxis.set_major_locator(MaxNLocator(5, steps=STEPS))
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(times[0]), float(times[-1]))
        figure.align_ylabels(axes)
        return save(figure, out_png)


def draw_scene(ax: Any, shot: Shot, states: Array, times: Array | None, hands: Array) -> None:
    """Bodies, hand, path, target and, if given, the times beside the bodies on axes from `make_axes`."""
    if shot.picture.dimension == 3:
        _draw_3d(ax, shot, states, times, hands)
        return
    picture = shot.picture
    lines = np.vstack([picture.facets, interfaces(picture)])
    reach = float((shot.high - shot.low).max())
    ax.plot(*shot.path.T, ls=(0, (5, 3)), color=OUTLINE, lw=0.9, zorder=1)
    for i, (u, q) in enumerate(zip(states, hands, strict=True)):
        x = picture.points + u
        if len(picture.cells) <= MANY_CELLS:
            ax.tripcolor(
                x[:, 0], x[:, 1], picture.cells, shot.values(u, q), shading="gouraud", cmap=colour_map(),
                norm=shot.norm, rasterized=True, zorder=2,
            )  # fmt: skip
        ax.add_collection(LineCollection(list(x[lines]), colors=OUTLINE, linewidths=0.6, zorder=3), autolim=False)
        hand = [p + picture.rigid(q, p) for p in shot.hand]
        ax.add_collection(
            PolyCollection(hand, facecolors=HAND, edgecolors=HAND, linewidths=0.3, zorder=4), autolim=False
        )
        if times is not None:
            middle, foot = (x[:, 0].min() + x[:, 0].max()) / 2, min(x[:, 1].min(), *(h[:, 1].min() for h in hand))
            ax.text(middle, foot - 0.02 * reach, f"$t$ = {times[i]:.3g} s", ha="center", va="top", zorder=6)
    if shot.target is not None:
        x = picture.points + picture.rigid(shot.target)
        for edge in chained(picture.facets):
            ax.plot(*x[edge].T, ls=(0, (1, 1.2)), color=TARGET, lw=1.5, zorder=5)


def make_axes(shot: Shot, panels: int) -> tuple[Any, list[Any]]:
    """Figure and axes of the right shape for the scene; call within `paper_style`."""
    span = shot.high - shot.low
    if shot.picture.dimension == 3:
        figure = plt.figure(figsize=(WIDTH if panels > 1 else 0.8 * WIDTH, 4.2))
        axes = [figure.add_subplot(1, panels, i + 1, projection="3d") for i in range(panels)]
        for ax in axes:
            _frame_3d(ax, shot)
        return figure, axes
    pad = 0.06 * float(span.max())
    low, high = shot.low - [pad, 1.6 * pad], shot.high + pad
    width, height = high - low
    stacked = panels > 1 and width > height
    rows, columns = (panels, 1) if stacked else (1, panels)
    scale = min((WIDTH - 1.6) / (columns * width), 5.4 / (rows * height))  # [inch/m]
    size = (columns * width * scale + 0.25 * (columns - 1), rows * height * scale + 0.12 * (rows - 1))
    figure, grid = plt.subplots(rows, columns, figsize=size, sharex=True, sharey=True, squeeze=False)
    figure.subplots_adjust(0, 0, 1, 1, hspace=0.06, wspace=0.06)
    axes = list(grid.ravel())
    for i, ax in enumerate(axes):
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=STEPS))
        ax.yaxis.set_major_locator(MaxNLocator(6, steps=STEPS))
        if i // columns == rows - 1:
            ax.set_xlabel("$x$ [m]")
        if i % columns == 0:
            ax.set_ylabel("$y$ [m]")
    return figure, axes


def colour_bar(figure: Any, axes: list[Any], shot: Shot) -> None:
    """Colour bar of the relative displacement, as high as the axes."""
    colours = mpl.cm.ScalarMappable(shot.norm, colour_map())
    label = f"displacement relative to the hand [{shot.unit[1]}]"
    if shot.picture.dimension == 3:
        figure.subplots_adjust(0.0, 0.0, 0.9, 0.94, wspace=0.0)
        place = figure.add_axes((0.91, 0.2, 0.022, 0.55))
    else:
        figure.canvas.draw()  # equal axes know their place only now
        boxes = [ax.get_position() for ax in axes]
        low, high = min(b.y0 for b in boxes), max(b.y1 for b in boxes)
        gap = 0.12 / figure.get_figwidth()
        place = figure.add_axes((max(b.x1 for b in boxes) + gap, low, 1.1 * gap, high - low))
    bar = figure.colorbar(colours, cax=place, label=label)
    bar.outline.set_linewidth(0.5)
    bar.ax.yaxis.set_major_locator(MaxNLocator(6, steps=STEPS))


def legend(figure: Any, axes: list[Any], shot: Shot) -> None:
    """One row above the axes, where nothing is hidden."""
    entries: list[Any] = [
        Patch(color=HAND, label="hand" if shot.hand else "held by the hand"),
        Line2D([], [], ls=(0, (5, 3)), color=OUTLINE, lw=0.9, label="path of the hand"),
    ]
    if shot.target is not None:
        entries.append(Line2D([], [], ls=(0, (1, 1.2)), color=TARGET, lw=1.5, label="target"))
    row: dict[str, Any] = {"handles": entries, "ncols": 3, "borderaxespad": 0.0, "columnspacing": 1.4}
    if shot.picture.dimension == 3:
        figure.legend(loc="upper center", bbox_to_anchor=(0.46, 0.97), **row)
    else:
        axes[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.02), **row)


def _frame_3d(ax: Any, shot: Shot) -> None:
    span = np.maximum(shot.high - shot.low, 0.02 * float((shot.high - shot.low).max()))
    low, high = shot.low - 0.04 * span.max(), shot.high + 0.04 * span.max()
    ax.set_proj_type("ortho")
    ax.computed_zorder = False
    ax.view_init(ELEVATION, AZIMUTH)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    ax.set_box_aspect(high - low, zoom=1.0)
    for axis, name, extent in zip((ax.xaxis, ax.yaxis, ax.zaxis), "xyz", high - low, strict=True):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set_linewidth(0.6)
        axis._axinfo["grid"].update(color="#dddddd", linewidth=0.4)
        axis.set_major_locator(MaxNLocator(max(2, round(5 * extent / (high - low).max())), steps=STEPS))
        axis.set_label_text(f"${name}$ [m]")
    ax.tick_params(labelsize=8, pad=1)


def _name_layers(ax: Any, shot: Shot, u: Array) -> None:
    """Names of the layers beside the body, on the side with more room."""
    picture, x = shot.picture, shot.picture.points + u
    if len(picture.names) == 1:
        return
    low, high = _box(x)
    room = (low[0] - ax.get_xlim()[0], ax.get_xlim()[1] - high[0])
    gap = 0.02 * float((shot.high - shot.low).max())
    place, align = (low[0] - gap, "right") if room[0] > room[1] else (high[0] + gap, "left")
    heights = x[:, 1][picture.cells].mean(axis=1)
    for i, name in enumerate(picture.names):
        ax.text(place, heights[picture.layers == i].mean(), name, ha=align, va="center", color=OUTLINE)


def _box(x: Array) -> Array:
    """Lower and upper corner of points, shape (2, d)."""
    return np.stack([x.min(axis=0), x.max(axis=0)])


def _draw_3d(ax: Any, shot: Shot, states: Array, times: Array | None, hands: Array) -> None:
    picture = shot.picture
    elevation, azimuth = np.radians([ELEVATION, AZIMUTH])
    view = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    left = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    up = np.cross(view, -left)
    # The bodies lie along the path: beside it is room for their times.
    slope = float((shot.path[-1] - shot.path[0]) @ up * ((shot.path[-1] - shot.path[0]) @ left))
    beside = left if len(states) == 1 else left + (up if slope < 0 else -up)
    project = ax.get_proj()
    sides = edge_sides(picture.facets)
    many = len(picture.cells) > MANY_CELLS
    if not many:
        # One collection for all instants: it sorts its faces from back to front.
        painted = [_paint(shot, u, q, view) for u, q in zip(states, hands, strict=True)]
        faces, colours = (np.vstack(part) for part in zip(*painted, strict=True))
        body = Poly3DCollection(faces, facecolors=colours, edgecolors=colours, linewidths=0.2, zorder=2)
        body.set_rasterized(True)
        ax.add_collection3d(body)
    for i, u in enumerate(states):
        x = picture.points + u
        if many:
            edges = silhouette(x, picture.facets, sides, view)
            ax.add_collection3d(Line3DCollection(x[edges], colors=OUTLINE, linewidths=0.6, zorder=3))
        if times is not None:
            a, b, _ = proj_transform(*x[np.argmax(x @ beside)], project)
            beside_it: dict[str, Any] = {
                "xytext": (-5, 0),
                "textcoords": "offset points",
                "ha": "right",
                "va": "center",
            }
            ax.annotate(f"$t$ = {times[i]:.3g} s", (a, b), **beside_it, zorder=6)
    ax.plot(*shot.path.T, ls=(0, (5, 3)), color=OUTLINE, lw=0.9, zorder=4)
    if shot.target is not None:
        x = picture.points + picture.rigid(shot.target)
        edges = outer_edges(x, picture.facets, silhouette(x, picture.facets, sides, view), view)
        look: dict[str, Any] = {"colors": TARGET, "linewidths": 1.4, "linestyles": (0, (1, 1.2)), "zorder": 5}
        ax.add_collection3d(Line3DCollection(x[edges], **look))


def _paint(shot: Shot, u: Array, q: Array, view: Array) -> tuple[Array, Array]:
    """Visible boundary of one instant, (m, 3, 3) [m], in small triangles with shaded colours (m, 3)."""
    picture = shot.picture
    code = np.array([1, len(picture.points), len(picture.points) ** 2])
    held = np.isin(np.sort(picture.facets, axis=1) @ code, np.sort(picture.contact, axis=1) @ code)
    corners = (picture.points + u)[picture.facets]
    normals = facet_normals(corners)
    front = normals @ view > 0
    weights = subdivision(int(np.clip(np.sqrt(4000 / len(corners)), 1, 4)))
    faces = np.einsum("sck,fkd->fscd", weights, corners[front])
    values = shot.values(u, q)[picture.facets[front]] @ weights.mean(axis=1).T
    rgb = colour_map()(shot.norm(values))[..., :3]
    turn = np.radians(AZIMUTH - 35.0)
    light = np.array([0.6 * np.cos(turn), 0.6 * np.sin(turn), 0.8])
    lit = np.clip(normals[front] @ light, 0.0, 1.0)[:, None, None]
    dark = np.array(mpl.colors.to_rgb(HAND)) + 0.14 * lit
    rgb = np.where(held[front][:, None, None], dark, rgb * (0.75 + 0.25 * lit))
    return faces.reshape(-1, 3, 3), rgb.reshape(-1, 3)
