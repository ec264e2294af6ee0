"""Pictures of the body for ``softgrasp reduce``: first modes, and the full motion beside the reduced ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from softgrasp.fem.fields.picture import PictureMesh, gather_picture, vertex_displacement
from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.reduction.bases.registry import PAPER_METHODS
from softgrasp.reduction.replay import FullRun, replay_linear
from softgrasp.study.pictures.animation import Film, write_gif
from softgrasp.study.pictures.body import Shot, colour_bar, draw_scene, make_axes, make_shot
from softgrasp.study.pictures.shapes import seen, shadow, speed_up
from softgrasp.study.pictures.style import COLUMN, HAND, ORANGE, WIDTH, paper_style, save, segments
from softgrasp.study.reduce import plots
from softgrasp.study.reduce.result import MethodSweep, ReductionStudy, nearest

MODES = 4  # a method
FRAMES = 30
INSTANTS = 3  # at most, in the still picture
ROOM = 0.25  # between two bodies there, over the size of the body
STRETCH = 0.15  # largest displacement of a drawn mode over the size of the body
FULL: dict[str, Any] = {"color": ORANGE, "linewidth": 1.1}
MANY_VERTICES = 200_000  # above, no pictures of the body


@dataclass(frozen=True)
class View:
    """One reduced model for the eye."""

    title: str  # method and N
    stable: bool  # of the model
    error: float  # of its deformation
    states: Array  # vertex displacements of its run at the frames, (k, n, d) [m]


@dataclass(frozen=True)
class Views:
    """What the pictures need, on rank 0."""

    picture: PictureMesh  # the body
    times: Array  # of the frames, (k,) [s]
    table: Array  # the hand, columns time and q_s, (steps + 1, 1 + n_s) [s, m, rad]
    full: Array  # vertex displacements of the full run at the frames, (k, n, d) [m]
    reduced: tuple[View, ...]  # models to compare
    # title and vertex displacements (k, n, d) of the first modes of some methods, largest entry 1; whether they are
    # absolute displacements, that take the hand along
    modes: tuple[tuple[str, Array, bool], ...]


def draw(out: Path, study: ReductionStudy, views: Views | None) -> list[Path]:
    """All figures. Rank 0 only."""
    files: list[Path] = []
    shown = [s for s in study.sweeps if s.points]
    if plots.of_paper(shown):
        files += plots.figure_errors(plots.of_paper(shown), out / "errors.png")
        files += plots.figure_further_errors(plots.of_paper(shown), out / "errors_state.png")
    if any(s not in plots.of_paper(shown) for s in shown):
        files += plots.figure_errors(plots.further_methods(shown), out / "errors_beyond.png")
    if shown:
        files += plots.figure_times(shown, study.times.steps, out / "times.png")
        files += plots.figure_sigma(shown, out / "sigma.png") or ()
    if views is not None and views.modes:
        files += figure_modes(views, out / "modes.png")
    if views is not None and views.reduced:
        files += figure_compare(views, out / "compare.png")
        files.append(gif_compare(views, out / "compare.gif"))
    return files


def compared(sweeps: Sequence[MethodSweep]) -> list[tuple[MethodSweep, int]]:
    """First of the paper's methods and best of all at the N compared."""
    first = [s for s in sweeps if s.method.key in PAPER_METHODS and s.points][:1]
    chosen = [(s, i) for s in first if (i := nearest(s.points, stable=False)) is not None]
    stable = [(s, i) for s in sweeps if (i := nearest(s.points)) is not None]
    stable.sort(key=_error)
    return chosen + [f for f in stable[:1] if f[0] not in first]


def _error(chosen: tuple[MethodSweep, int]) -> float:
    return chosen[0].points[chosen[1]].error_deformation


def gather_views(model: Model, run: FullRun, sweeps: Sequence[MethodSweep]) -> Views | None:
    """Bring to rank 0 what the pictures need; None on other ranks and for very large bodies. Collective."""
    if model.space.mesh.mesh.geometry.index_map().size_global > MANY_VERTICES:
        return None
    picture = gather_picture(model)
    snapshots, n = run.snapshots, model.system.layout.n_local
    chosen = np.unique(np.linspace(0, len(snapshots.steps) - 1, FRAMES + 1).round().astype(int))
    steps = snapshots.steps[chosen]
    full = vertex_displacement(model, snapshots.Z[:n, chosen], snapshots.q_s[:, chosen])
    views = []
    for s, i in compared(sweeps):
        point, reduced = s.points[i], s.models[i]
        with np.errstate(all="ignore"):  # an unstable model may overflow
            motion = replay_linear(reduced, model, run, allow_unstable=True)
            z, _ = reduced.reconstruct(reduced.at(), motion.x[steps].T, motion.v_s[steps].T)
        states = vertex_displacement(model, np.nan_to_num(z), motion.q_s[steps].T)
        if states is not None:
            views.append(View(f"{s.method.title}, $N$ = {point.N}", point.stable, point.error_deformation, states))
    modes = [(s.method.title, _modes(model, s, i), s.method.frame == "absolute") for s, i in modes_of(sweeps)]
    if picture is None or full is None:
        return None
    table = np.column_stack([run.trajectory.times, run.trajectory.q_s])
    shown = tuple((title, shapes, free) for title, shapes, free in modes if shapes is not None and len(shapes))
    return Views(picture, snapshots.times[chosen], table, full, tuple(views), shown)


def modes_of(sweeps: Sequence[MethodSweep]) -> list[tuple[MethodSweep, int]]:
    """The best method of the paper that keeps the hand apart, and Craig-Bampton or else the best beyond the paper."""
    fixed = sorted(((s, i) for s in sweeps if s.method.fixed and (i := nearest(s.points)) is not None), key=_error)
    old = [f for f in fixed if f[0].method.key in PAPER_METHODS][:1]
    new = [f for f in fixed if f[0].method.key not in PAPER_METHODS]
    new = ([f for f in new if not f[0].method.snapshots] or new)[:1]
    return old + new


def _modes(model: Model, s: MethodSweep, i: int) -> Array | None:
    """First displacement columns of a basis at the vertices, each with largest entry 1. Collective."""
    layout = model.system.layout
    lift = s.models[i].lift
    if lift is None:
        return None
    Q = lift.L_q[:, 2 * layout.n_s :]
    largest = layout.comm.allreduce(np.abs(Q).max(axis=0, initial=0.0), np.maximum)
    kept = np.flatnonzero(largest > 1e-12 * largest.max(initial=0.0))[:MODES]
    shapes = vertex_displacement(model, Q[:, kept] / largest[kept], np.zeros((layout.n_s, len(kept))))
    return None if shapes is None else np.asarray(shapes)


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
