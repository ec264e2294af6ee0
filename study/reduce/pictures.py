"""Pictures of the body for ``softgrasp reduce``: first modes, and the full motion beside the reduced ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from softgrasp.fem.fields.picture import PictureMesh
from softgrasp.fem.petsc import Array
from softgrasp.study.pictures.animation import Film, write_gif
from softgrasp.study.pictures.body import Shot, colour_bar, draw_scene, make_axes, make_shot
from softgrasp.study.pictures.shapes import seen, shadow, speed_up
from softgrasp.study.pictures.style import COLUMN, HAND, ORANGE, WIDTH, paper_style, save, segments
from softgrasp.study.reduce import plots
from softgrasp.study.reduce.result import MethodSweep
from softgrasp.study.reduce.views import View, Views

INSTANTS = 3  # at most, in the still picture
ROOM = 0.25  # between two bodies there, over the size of the body
STRETCH = 0.15  # largest displacement of a drawn mode over the size of the body
FULL: dict[str, Any] = {"color": ORANGE, "linewidth": 1.1}


def draw(out: Path, sweeps: Sequence[MethodSweep], full: float, views: Views | None) -> list[Path]:
    """All figures; ``full`` are the seconds of the full model's steps. Rank 0 only."""
    files: list[Path] = []
    shown = [s for s in sweeps if s.points]
    if plots.of_paper(shown):
        files += plots.figure_errors(plots.of_paper(shown), out / "errors.png")
        files += plots.figure_further_errors(plots.of_paper(shown), out / "errors_state.png")
    if any(s not in plots.of_paper(shown) for s in shown):
        files += plots.figure_errors(plots.further_methods(shown), out / "errors_beyond.png")
    if shown:
        files += plots.figure_times(shown, full, out / "times.png")
        files += plots.figure_sigma(shown, out / "sigma.png") or ()
    if views is not None and views.modes:
        files += figure_modes(views, out / "modes.png")
    if views is not None and views.reduced:
        files += figure_compare(views, out / "compare.png")
        files.append(gif_compare(views, out / "compare.gif"))
    return files


def figure_modes(views: Views, out_png: Path) -> tuple[Path, ...]:
    """First modes of the best methods drawn on the body, scaled to one largest displacement; PNG and PDF."""
    picture = views.picture
    size = float(np.ptp(picture.points, axis=0).max())
    titles = [
        f"{title.replace(', fixed solid modes', ', fixed')}, {k + 1}"
        for title, shapes, _ in views.modes
        for k in range(len(shapes))
    ]
    shapes = np.concatenate([_scaled(shapes, STRETCH * size) for _, shapes, _ in views.modes])
    free = np.concatenate([np.full(len(shapes), absolute) for _, shapes, absolute in views.modes])
    times = np.arange(len(shapes), dtype=float)
    hands = np.zeros((len(shapes), picture.n_s))
    held = np.unique(picture.contact)
    near = np.setdiff1d(picture.cells[np.isin(picture.cells, held).any(axis=1)], held)
    if len(near):  # the hand moves by columns of its own: shown where the tissue beside it goes
        hands[free, : picture.dimension] = shapes[free][:, near].mean(axis=1)
        shapes[:, held] = np.stack([picture.rigid(q)[held] for q in hands])
    shot = make_shot(picture, shapes, times, np.column_stack([times, hands]), None)
    shot = replace(shot, path=shot.path[:1])
    with paper_style():
        figure, axes = make_axes(shot, len(shapes), captions=True, width=WIDTH, tallest=5.0)
        for ax, shape, title, hand in zip(axes, shapes, titles, shot.hands, strict=True):
            draw_scene(ax, shot, shape[None], None, hand[None])
            ax.set_title(title, pad=3, fontsize=6.5)
        return save(figure, out_png)


def _scaled(shapes: Array, largest: float) -> Array:
    """Displacements with the same largest length of a vector."""
    lengths = np.linalg.norm(shapes, axis=2).max(axis=1)
    return np.asarray(largest * shapes / lengths[:, None, None])


def _outline(picture: PictureMesh, displacement: Array) -> Array:
    """Short lines around the body where it is seen, (m, 2, 2) [m]."""
    x = picture.points + displacement
    if picture.dimension == 2:
        return np.asarray(x[picture.facets])
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in shadow(seen(x), picture.facets)])


def _hands(views: Views) -> Array:
    return np.column_stack([np.interp(views.times, views.table[:, 0], q) for q in views.table[:, 1:].T])


def _figure(views: Views, width: float, note: str = "") -> tuple[Any, list[Any], Shot]:
    """Axes for every reduced model in the frame of the full one, so that one that grew does not shrink the picture."""
    shot = make_shot(views.picture, views.full, views.times, views.table, None)
    figure, axes = make_axes(shot, len(views.reduced), captions=True, width=width, tallest=3.6)
    for ax, view in zip(axes, views.reduced, strict=True):
        state = "" if view.stable else ", unstable"
        ax.set_title(f"{view.title}{state}\ndeformation error {view.error:.1e}{note}", pad=3, fontsize=7)
    entries: list[Any] = [Patch(color=HAND, label="hand"), Line2D([], [], label="outline of the full model", **FULL)]
    top = max(ax.get_position().y1 for ax in axes) + 0.36 / figure.get_figheight()
    figure.legend(handles=entries, loc="lower center", bbox_to_anchor=(0.5, top), ncols=2, borderaxespad=0.0)
    colour_bar(figure, axes, shot)
    return figure, axes, shot


def _draw(ax: Any, shot: Shot, views: Views, view: View, k: int) -> None:
    """One reduced model at one frame under the outline of the full one."""
    q = _hands(views)[k]
    draw_scene(ax, shot, view.states[k : k + 1], None, q[None])
    lines = segments(_outline(views.picture, views.full[k]), zorder=7, edgecolors=ORANGE, linewidths=1.1)
    ax.add_collection(lines, autolim=False)


def instants(views: Views) -> list[int]:
    """Frames of large deformation and large error whose bodies do not cover each other, the most telling first."""
    rigid = [views.picture.rigid(q) for q in _hands(views)]
    deformation = np.array([np.abs(u - r).max() for u, r in zip(views.full, rigid, strict=True)])
    error = np.max([np.abs(view.states - views.full).max(axis=(1, 2)) for view in views.reduced], axis=0)
    score = sum(value / (value.max() or 1.0) for value in (deformation, np.minimum(error, deformation.max())))
    x = views.picture.points + views.full
    low, high = x.min(axis=1), x.max(axis=1)
    room = ROOM * np.ptp(views.picture.points, axis=0)
    chosen: list[int] = []
    for k in np.argsort(-score, kind="stable").tolist():
        if all((low[k] > high[i] + room).any() or (low[i] > high[k] + room).any() for i in chosen):
            chosen.append(k)
        if len(chosen) == INSTANTS:
            break
    return sorted(chosen)


def figure_compare(views: Views, out_png: Path) -> tuple[Path, ...]:
    """Full outline over reduced bodies at some instants; PNG and PDF."""
    shown = instants(views)
    note = f"; shown: $t$ = {', '.join(f'{views.times[k]:.2g}' for k in shown)} s"
    with paper_style():
        figure, axes, shot = _figure(views, WIDTH if len(views.reduced) > 1 else COLUMN + 1, note)
        for ax, view in zip(axes, views.reduced, strict=True):
            for k in shown:
                _draw(ax, shot, views, view, k)
        return save(figure, out_png)


def gif_compare(views: Views, out_gif: Path) -> Path:
    """The same in motion."""
    images = []
    with paper_style():
        figure, axes, shot = _figure(views, WIDTH if len(views.reduced) > 1 else COLUMN + 1)
        film = Film(figure, axes)
        for k in range(len(views.times)):
            film.clear()
            for ax, view in zip(axes, views.reduced, strict=True):
                _draw(ax, shot, views, view, k)
            images.append(film.frame())
        plt.close(figure)
    span = float(views.times[-1] - views.times[0]) / speed_up(views.times)
    wait = max(20, round(100 * span / max(1, len(images) - 1)) * 10)  # [ms], GIF counts in hundredths of a second
    durations = [wait] * (len(images) - 1) + [wait + 1000]
    return write_gif(images, durations, out_gif)
