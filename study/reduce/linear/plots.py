"""Figures of ``softgrasp reduce``: errors against N and time, singular values, modes and moves on the body."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from softgrasp.reduction import PAPER_METHODS
from softgrasp.study.pictures import film, gif_bytes, hands_at, style, timing, write_gif
from softgrasp.study.pictures.body import MoveView, colour_bar, draw_scene, make_axes, make_view, outline, settle
from softgrasp.study.reduce.linear.result import MethodSweep, Point, by_error, unbeaten
from softgrasp.study.reduce.linear.views import Views

TOP = 1.0  # errors above are drawn at the upper edge
LOWEST = 1e-17  # of a singular value over the first
SHOWN_VALUES = 100
OLIVE, BROWN = "#8a8a00", "#8c510a"
LOOKS: dict[str, tuple[str, str, str]] = {  # colour by decomposition, dashes for global bases
    "global_pod": (style.BLUE, "--", "o"),
    "pod_fixed": (style.BLUE, "-", "o"),
    "componentwise_pod": (style.ORANGE, "--", "s"),
    "componentwise_pod_fixed": (style.ORANGE, "-", "s"),
    "psd": (style.GREEN, "--", "^"),
    "psd_fixed": (style.GREEN, "-", "^"),
    "psd_svd_like": (style.PURPLE, "--", "D"),
    "psd_svd_like_fixed": (style.PURPLE, "-", "D"),
    "psd_cotangent_lift_fixed": (style.SKY, "-", "v"),
    "psd_fixed_relative": (OLIVE, "-", "<"),
    "craig_bampton": (style.HAND, "-", "P"),
}
SPARE = ((BROWN, "-", ">"), (BROWN, "--", "h"), (BROWN, ":", "X"), (BROWN, "-.", "p"))
CROSS: dict[str, Any] = {"ls": "", "marker": "x", "ms": 4.0, "mew": 0.8, "alpha": 0.6}
OTHERS: dict[str, Any] = {"ls": "", "marker": ".", "ms": 4, "color": "#c4c4c4"}
FRONT: dict[str, Any] = {"color": style.OUTLINE, "lw": 1.6, "zorder": 2}
QUANTITIES = (
    ("error_deformation", "error of the deformation"),
    ("error", "error of positions and velocities"),
    ("error_canonical", "error of positions and momenta"),
    ("error_energy", "error of the energy"),
)
INSTANTS = 3  # at most, in the still picture
ROOM = 0.25  # between two bodies there, over the size of the body
STRETCH = 0.15  # largest displacement of a drawn mode over the size of the body
OUTLINE: dict[str, Any] = {"color": style.ORANGE, "linewidth": 1.1}


def draw_errors(out: Path, sweeps: Sequence[MethodSweep], full: float) -> list[Path]:
    """Figures of errors, times and singular values; ``full`` are the seconds of the full model's steps. Rank 0 only."""
    files: list[Path] = []
    shown = [s for s in sweeps if s.points]
    if paper := of_paper(shown):
        files += figure_errors([*paper, *best_beyond(shown)], QUANTITIES[:1], out / "errors.png")
        files += figure_errors(paper, QUANTITIES[1:], out / "errors_state.png")
    if len(paper) < len(shown):
        files += figure_errors(further_methods(shown), QUANTITIES[:1], out / "errors_beyond.png")
    if shown:
        files += figure_times(shown, full, out / "times.png")
        files += figure_sigma(shown, out / "sigma.png")
    return files


def draw_bodies(out: Path, views: Views | None) -> list[Path]:
    """Figures of modes and moves on the body. Rank 0 only."""
    files: list[Path] = []
    if views is not None and views.modes:
        files += figure_modes(views, out / "modes.png")
    if views is not None and views.reduced:
        files += figure_compare(views, out / "compare.png")
        files.append(gif_compare(views, out / "compare.gif"))
    return files


def looks(methods: Iterable[str]) -> dict[str, tuple[str, str, str]]:
    """Colour, dashes and marker of every method; those without a place of their own share one colour."""
    others = [key for key in methods if key not in LOOKS]
    return {**LOOKS, **{key: SPARE[i % len(SPARE)] for i, key in enumerate(others)}}


def of_paper(sweeps: Sequence[MethodSweep]) -> list[MethodSweep]:
    """The paper's six, as far as they ran."""
    return [s for s in sweeps if s.method.key in PAPER_METHODS and s.points]


def best_beyond(sweeps: Sequence[MethodSweep]) -> list[MethodSweep]:
    """Craig-Bampton and the SVD-like basis, as far as they ran: shown beside the paper's six."""
    return [s for s in sweeps if s.method.key in ("psd_svd_like", "craig_bampton")]


def further_methods(sweeps: Sequence[MethodSweep]) -> list[MethodSweep]:
    """The others, after the best of the paper's at the N compared."""
    best = [s for s, _ in by_error(of_paper(sweeps))[:1]]
    return best + [s for s in sweeps if s.method.key not in PAPER_METHODS and s.points]


def figure_errors(
    sweeps: Sequence[MethodSweep], quantities: Sequence[tuple[str, str]], out_png: Path
) -> tuple[Path, ...]:
    """The picture of :func:`errors_figure` as a file."""
    return style.save(errors_figure(sweeps, quantities), out_png)


def errors_figure(sweeps: Sequence[MethodSweep], quantities: Sequence[tuple[str, str]]) -> Any:
    """Errors against N, one below the other; a curve is dotted where its model is unstable, its name is at its end."""
    single, look = len(quantities) == 1, looks(s.method.key for s in sweeps)
    with style.paper_style():
        size = (style.COLUMN + 1.6, 3.4 if single else 6.4)
        figure, axes = plt.subplots(len(quantities), 1, figsize=size, sharex=True, squeeze=False, layout="constrained")
        for ax, (key, label) in zip(axes[:, 0], quantities, strict=True):
            ends = []
            for s in sweeps:
                colour, dashes, marker = look[s.method.key]
                N, values = [p.N for p in s.points], _values(s.points, key)
                held = np.where([p.stable for p in s.points], values, np.nan)
                ax.plot(N, held, color=colour, ls=dashes, marker=marker, ms=3.0, lw=1.1, zorder=2)
                ax.plot(N, values, color=colour, ls=(0, (1, 2.5)), lw=0.6, zorder=1)
                bad = [i for i, p in enumerate(s.points) if not p.stable]  # marked, where the curve is dotted
                ax.plot([N[i] for i in bad], values[bad], **CROSS, color=colour, zorder=1)
                ends.append((float(N[-1]), float(values[-1]), s.method.short_title, colour))
            ax.set_ylabel(label)
            style.log_axis(ax, 1.6 * TOP)
            ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, steps=style.STEPS))
            style.direct_labels(ax, ends)
        axes[-1, 0].set_xlabel("N, columns of the basis")
        if single and (handles := _remarks(sweeps)):
            figure.legend(handles=handles, loc="outside upper left", ncols=2)
    return figure


def figure_times(sweeps: Sequence[MethodSweep], full: float, out_png: Path) -> tuple[Path, ...]:
    """Error of the deformation against online and offline plus online time, with the Pareto front; ``full`` [s]."""
    look, key = looks(s.method.key for s in sweeps), QUANTITIES[0][0]
    with style.paper_style():
        figure, axes = plt.subplots(2, 1, figsize=(style.COLUMN + 0.9, 5.6), layout="constrained")
        named: dict[str, Line2D] = {}
        kinds = ((0, 1e3, "online time of a run [ms]"), (1, 1.0, "offline + online time [s]"))
        for ax, (offline, unit, xlabel) in zip(axes, kinds, strict=True):
            points = [
                (unit * (p.time_online + offline * p.time_offline), min(getattr(p, key), TOP), s)
                for s in sweeps for p in s.points if p.stable and np.isfinite(getattr(p, key))
            ]  # fmt: skip
            front = unbeaten(points)
            for shown, mark in ((points, OTHERS), (front, FRONT)):
                ax.plot([t for t, _, _ in shown], [e for _, e, _ in shown], **mark)
            for t, e, s in front:
                colour, dashes, marker = look[s.method.key]
                fill = colour if dashes == "-" else "white"
                mark = {"ls": "", "marker": marker, "ms": 5.0, "color": colour, "mfc": fill}
                ax.plot(t, e, **mark, zorder=3)
                named[s.method.key] = Line2D([], [], label=s.method.short_title, **mark)
            ax.axvline(full * unit, **style.FULL)
            ax.set(xscale="log", xlabel=xlabel, ylabel=QUANTITIES[0][1])
            style.log_axis(ax, 1.6 * TOP)
            style.few_ticks(ax.xaxis)
        rest = [
            Line2D([], [], label="other stable models", **OTHERS),
            Line2D([], [], label="Pareto front", **FRONT),
            Line2D([], [], label="full run, prefactored", **style.FULL),
        ]
        figure.legend(handles=[*named.values(), *rest], loc="outside upper center", ncols=2)
        return style.save(figure, out_png)


def figure_sigma(sweeps: Sequence[MethodSweep], out_png: Path) -> tuple[Path, ...]:
    """Singular values over the first, a line for each part of a decomposition; no figure without any."""
    look = looks(s.method.key for s in sweeps)
    known = [s for s in sweeps if any(len(v) for v in s.sigma)]
    groups = [[s for s in known if (s.method.key in PAPER_METHODS) == paper] for paper in (True, False)]
    groups = [g for g in groups if g]
    if not groups:
        return ()
    with style.paper_style():
        size = (style.COLUMN + 0.9, 0.3 + 2.9 * len(groups))
        figure, axes = plt.subplots(len(groups), 1, figsize=size, sharex=True, squeeze=False, layout="constrained")
        for ax, group in zip(axes[:, 0], groups, strict=True):
            for s in group:
                colour, dashes, _ = look[s.method.key]
                label, wide = s.method.short_title, 1.2
                for values in (v for v in s.sigma if len(v) and v[0] > 0):
                    shown = np.maximum(values[:SHOWN_VALUES] / values[0], LOWEST)
                    ax.plot(np.arange(1, len(shown) + 1), shown, color=colour, ls=dashes, lw=wide, label=label)
                    label, wide = "", 0.7  # of the further parts
            ax.set(yscale="log", ylabel="singular value over the first [1]")
            ax.legend(loc="upper right", handlelength=2.2, fontsize=6.5)
        axes[-1, 0].set_xlabel("number")
        return style.save(figure, out_png)


def _values(points: Sequence[Point], key: str) -> np.ndarray:
    """Values of points, those that overflowed or exceed the frame at its edge."""
    values = np.array([getattr(p, key) for p in points], dtype=float)
    return np.where(np.isfinite(values), np.minimum(values, TOP), TOP)


def _remarks(sweeps: Sequence[MethodSweep]) -> list[Line2D]:
    """What a legend says of unstable models and of errors beyond the frame, where there are any."""
    entries = []
    if any(not p.stable for s in sweeps for p in s.points):
        entries.append(Line2D([], [], **CROSS, color=style.OUTLINE, label="unstable: the curve is dotted"))
    if any(not p.error_deformation <= TOP for s in sweeps for p in s.points):
        entries.append(Line2D([], [], ls="", label=f"above {TOP:g} is drawn at {TOP:g}"))
    return entries


def figure_modes(views: Views, out_png: Path) -> tuple[Path, ...]:
    """First modes of the best methods drawn on the body, scaled to one largest displacement; PNG and PDF."""
    picture = views.picture
    size = float(np.ptp(picture.points, axis=0).max())
    titles = [
        f"{title.replace(', fixed solid modes', ', fixed')}, {k + 1}"
        for title, shapes, _ in views.modes
        for k in range(len(shapes))
    ]
    shapes = np.concatenate([shapes for _, shapes, _ in views.modes])
    shapes *= STRETCH * size / np.linalg.norm(shapes, axis=2).max(axis=1)[:, None, None]
    free = np.concatenate([np.full(len(shapes), absolute) for _, shapes, absolute in views.modes])
    times = np.arange(len(shapes), dtype=float)
    hands = np.zeros((len(shapes), picture.n_s))
    held = np.unique(picture.contact)
    near = np.setdiff1d(picture.cells[np.isin(picture.cells, held).any(axis=1)], held)
    if len(near):  # the hand moves by columns of its own: shown where the tissue beside it goes
        hands[free, : picture.dimension] = shapes[free][:, near].mean(axis=1)
        shapes[:, held] = np.stack([picture.rigid(q)[held] for q in hands])
    move = make_view(picture, shapes, times, np.column_stack([times, hands]), None)
    move = replace(move, path=move.path[:1])
    with style.paper_style():
        figure, axes = make_axes(move, len(shapes), captions=True, width=style.WIDTH, tallest=5.0)
        for ax, title in zip(axes, titles, strict=True):
            ax.set_title(title, pad=3, fontsize=6.5)
        settle(figure)
        for ax, shape, hand in zip(axes, shapes, move.hands, strict=True):
            draw_scene(ax, move, shape[None], None, hand[None])
        return style.save(figure, out_png)


def _figure(views: Views, note: str = "") -> tuple[Any, list[Any], MoveView]:
    """Axes for every reduced model in the frame of the full one, so that one that grew does not shrink the picture."""
    width = style.WIDTH if len(views.reduced) > 1 else style.COLUMN + 1
    move = make_view(views.picture, views.full, views.times, views.table, None)
    figure, axes = make_axes(move, len(views.reduced), captions=True, width=width, tallest=3.6)
    for ax, view in zip(axes, views.reduced, strict=True):
        ax.set_title(view.title + note, pad=3, fontsize=7)
    entries: list[Any] = [
        Patch(color=style.HAND, label="hand"),
        Line2D([], [], label="outline of the full model", **OUTLINE),
    ]
    figure.legend(handles=entries, loc="outside upper center", ncols=2)
    colour_bar(figure, axes, move)
    settle(figure)
    return figure, axes, move


def _draw(axes: Sequence[Any], move: MoveView, views: Views, k: int) -> None:
    """Every reduced model at one frame under the outline of the full one."""
    lines = outline(views.picture, views.picture.points + views.full[k])
    for ax, view in zip(axes, views.reduced, strict=True):
        draw_scene(ax, move, view.states[k : k + 1], None, move.hands[k : k + 1])
        ax.add_collection(LineCollection(lines, zorder=7, **OUTLINE), autolim=False)


def instants(views: Views) -> list[int]:
    """Frames of large deformation and large error whose bodies do not cover each other, the largest first."""
    rigid = [views.picture.rigid(q) for q in hands_at(views.table, views.times)]
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
    with style.paper_style():
        times = ", ".join(f"{views.times[k]:.2g}" for k in shown)
        figure, axes, move = _figure(views, f"\nbodies at t = {times} s")
        for k in shown:
            _draw(axes, move, views, k)
        return style.save(figure, out_png)


def gif_compare(views: Views, out_gif: Path) -> Path:
    """The same in motion."""
    kept, durations = timing(views.times)
    with style.paper_style():
        figure, axes, move = _figure(views)
        images = film(figure, axes, partial(_draw, axes, move, views), kept)
    return write_gif(gif_bytes(images, durations), out_gif)
