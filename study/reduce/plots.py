"""Figures of ``softgrasp reduce``: errors against N and against time, singular values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from softgrasp.reduction.registry import PAPER_METHODS
from softgrasp.study.pictures.style import (
    BLUE,
    GREEN,
    HAND,
    ORANGE,
    PURPLE,
    SKY,
    STEPS,
    UNSTABLE,
    WIDTH,
    paper_style,
    save,
)
from softgrasp.study.reduce.result import Point, Sweep, nearest

TOP = 1.0  # errors above are drawn at the upper edge
NARROW = 16.0  # largest over least time below which an axis has numbers between the powers of ten
LOWEST = 1e-17  # of a singular value over the first
SHOWN_VALUES = 100
OLIVE, BROWN = "#8a8a00", "#8c510a"
LOOKS: dict[str, tuple[str, str, str]] = {  # colour by decomposition, dashes for global bases
    "global_pod": (BLUE, "--", "o"),
    "pod_fixed": (BLUE, "-", "o"),
    "componentwise_pod": (ORANGE, "--", "s"),
    "componentwise_pod_fixed": (ORANGE, "-", "s"),
    "psd": (GREEN, "--", "^"),
    "psd_fixed": (GREEN, "-", "^"),
    "psd_svd_like": (PURPLE, "--", "D"),
    "psd_svd_like_fixed": (PURPLE, "-", "D"),
    "psd_cotangent_lift_fixed": (SKY, "-", "v"),
    "psd_fixed_relative": (OLIVE, "-", "<"),
    "craig_bampton": (HAND, "-", "P"),
}
SPARE = ((BROWN, "-", ">"), (BROWN, "--", "h"), (BROWN, ":", "X"), (BROWN, "-.", "p"))
CROSS: dict[str, Any] = {"ls": "", "marker": "x", "ms": 6.0, "mew": 1.1, "color": UNSTABLE}
FULL: dict[str, Any] = {"color": "#888888", "lw": 0.9, "ls": (0, (4, 3)), "zorder": 0}
QUANTITIES = (
    ("error_deformation", "projection_error_deformation", "error of the deformation"),
    ("error", "projection_error", r"error of $[q_s, v_s, q_e, v_e]$"),
    ("error_canonical", "", r"error of $[q_s, p_s, q_e, p_e]$"),
    ("error_energy", "", "error of the energy"),
)


def looks(sweeps: Sequence[Sweep]) -> dict[str, tuple[str, str, str]]:
    """Colour, dashes and marker of every method; those without a place of their own share one colour."""
    others = [s.method.key for s in sweeps if s.method.key not in LOOKS]
    return {**LOOKS, **{key: SPARE[i % len(SPARE)] for i, key in enumerate(others)}}


def of_paper(sweeps: Sequence[Sweep]) -> list[Sweep]:
    """The paper's six, as far as they ran."""
    return [s for s in sweeps if s.method.key in PAPER_METHODS and s.points]


def further_methods(sweeps: Sequence[Sweep]) -> list[Sweep]:
    """The others, after the best of the paper's at the N compared."""
    old = [(s.points[i], s) for s in of_paper(sweeps) if (i := nearest(s.points)) is not None]
    first = min(old, key=lambda f: f[0].error_deformation, default=None)
    return ([] if first is None else [first[1]]) + [s for s in sweeps if s.method.key not in PAPER_METHODS and s.points]


def figure_errors(sweeps: Sequence[Sweep], out_png: Path) -> tuple[Path, ...]:
    """Four errors against N with the floor of the projection and the unstable points; PNG and PDF."""
    look = looks(sweeps)
    with paper_style():
        figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 5.4), sharex=True)
        clipped = False
        for ax, (key, floor, label) in zip(grid.flat, QUANTITIES, strict=True):
            for s in sweeps:
                N = [p.N for p in s.points]
                if floor:
                    ax.plot(N, _values(s.points, floor), color=look[s.method.key][0], ls=":", lw=0.7, zorder=1)
                clipped |= _curve(ax, s, N, key, look[s.method.key])
            ax.set_ylabel(label)
            _log_axis(ax)
            ax.xaxis.set_major_locator(MaxNLocator(8, integer=True, steps=STEPS))
        for ax in grid[1]:
            ax.set_xlabel("$N$")
        _legend(figure, _entries(sweeps, look, clipped))
        return save(figure, out_png)


def figure_times(sweeps: Sequence[Sweep], full: float, out_png: Path) -> tuple[Path, ...]:
    """Errors against online time, and against offline plus online time, with the unstable points; PNG and PDF.

    Args:
        sweeps: methods.
        full: seconds of the steps of a full run.
        out_png: name of the picture; the PDF gets its stem.
    """
    look = looks(sweeps)
    with paper_style():
        figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 5.4), sharex="col")
        clipped = False
        for row, (key, _, label) in zip(grid, QUANTITIES[:2], strict=True):
            row[0].set_ylabel(label)
            for ax, offline in zip(row, (False, True), strict=True):
                unit = 1.0 if offline else 1e3
                for s in sweeps:
                    times = [unit * (p.time_online + offline * p.time_offline) for p in s.points]
                    ax.plot(times, _values(s.points, key), **_marks(look[s.method.key]))
                    _crosses(ax, s, times, key)
                    clipped |= _clipped(s, key)
                ax.axvline(full * unit, **FULL)
                ax.set_xscale("log")
                _log_axis(ax)
        for ax in grid[1]:
            _time_axis(ax)
        grid[1, 0].set_xlabel("online time of a run [ms]")
        grid[1, 1].set_xlabel("offline + online time [s]")
        entries = [Line2D([], [], label=s.method.short_title, **_marks(look[s.method.key])) for s in sweeps if s.points]
        entries.append(Line2D([], [], label="full run, prefactored", **FULL))
        _legend(figure, [*entries, *_remarks(sweeps, clipped)])
        return save(figure, out_png)


def _marks(look: tuple[str, str, str]) -> dict[str, Any]:
    """Filled marks for bases that keep the hand apart, open ones for global bases."""
    colour, dashes, marker = look
    fill = "full" if dashes == "-" else "none"
    return {"ls": "", "marker": marker, "ms": 3.6, "mew": 0.8, "color": colour, "fillstyle": fill}


def figure_sigma(sweeps: Sequence[Sweep], out_png: Path) -> tuple[Path, ...] | None:
    """Singular values over the first, a line for each part of a decomposition; PNG and PDF, None without any."""
    look = looks(sweeps)
    groups = [
        [s for s in part if any(len(v) for v in s.sigma)]
        for part in (of_paper(sweeps), [s for s in sweeps if s.method.key not in PAPER_METHODS])
    ]
    groups = [g for g in groups if g]
    if not groups:
        return None
    with paper_style():
        figure, axes = plt.subplots(
            1, len(groups), figsize=(WIDTH if len(groups) > 1 else 0.6 * WIDTH, 3.3), sharey=True, squeeze=False,
            layout="constrained",
        )  # fmt: skip
        for ax, group in zip(axes[0], groups, strict=True):
            for s in group:
                colour, dashes, _ = look[s.method.key]
                for j, values in enumerate(v for v in s.sigma if len(v) and v[0] > 0):
                    shown = np.maximum(values[:SHOWN_VALUES] / values[0], LOWEST)
                    wide = 1.2 if j == 0 else 0.7
                    label = s.method.short_title if j == 0 else None
                    ax.plot(np.arange(1, len(shown) + 1), shown, color=colour, ls=dashes, lw=wide, label=label)
            ax.set_yscale("log")
            ax.set_xlabel("number")
            ax.legend(loc="upper right", handlelength=2.2, fontsize=6.5)
        axes[0, 0].set_ylabel(r"singular value over the first, $\sigma_i / \sigma_1$")
        return save(figure, out_png)


def _values(points: Sequence[Point], key: str) -> np.ndarray:
    """Values of points, those that overflowed or exceed the frame at its edge."""
    values = np.array([getattr(p, key) for p in points], dtype=float)
    return np.where(np.isfinite(values), np.minimum(values, TOP), TOP)


def _curve(ax: Any, s: Sweep, N: list[int], key: str, look: tuple[str, str, str]) -> bool:
    """One method; whether a value had to be drawn at the edge."""
    colour, dashes, marker = look
    shown = _values(s.points, key)
    ax.plot(N, shown, color=colour, ls=dashes, marker=marker, ms=3.0, lw=1.1, zorder=2)
    _crosses(ax, s, N, key)
    return _clipped(s, key)


def _crosses(ax: Any, s: Sweep, at: Sequence[float], key: str) -> None:
    """Marks of the unstable models among the points at these abscissae."""
    bad = [i for i, p in enumerate(s.points) if not p.stable]
    ax.plot([at[i] for i in bad], _values(s.points, key)[bad], **CROSS, zorder=4, clip_on=False)


def _clipped(s: Sweep, key: str) -> bool:
    """Whether a value has to be drawn at the edge."""
    return not all(getattr(p, key) <= TOP for p in s.points)


def _log_axis(ax: Any) -> None:
    ax.set_yscale("log")
    ax.set_ylim(top=1.6 * TOP)
    ax.yaxis.set_major_locator(LogLocator(numticks=12))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(axis="y", color="#e6e6e6", lw=0.5, zorder=0)
    ax.set_axisbelow(True)


def _time_axis(ax: Any) -> None:
    """Plain numbers at the powers of ten, and between them where the axis spans hardly more than one."""
    low, high = ax.get_xlim()
    shown = "235" if high < NARROW * low else ""
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_locator(LogLocator(subs=tuple(range(2, 10))))
    ax.xaxis.set_minor_formatter(FuncFormatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in shown else ""))


def _entries(sweeps: Sequence[Sweep], look: dict[str, tuple[str, str, str]], clipped: bool) -> list[Line2D]:
    """Legend of the errors against N."""
    entries = []
    for s in sweeps:
        colour, dashes, marker = look[s.method.key]
        entries.append(
            Line2D([], [], color=colour, ls=dashes, marker=marker, ms=3.0, lw=1.1, label=s.method.short_title)
        )
    entries.append(Line2D([], [], color="#777777", ls=":", lw=0.9, label="projection error, the floor"))
    return [*entries, *_remarks(sweeps, clipped)]


def _remarks(sweeps: Sequence[Sweep], clipped: bool) -> list[Line2D]:
    """What a legend says of unstable models and of errors beyond the frame, where there are any."""
    entries = []
    if any(not p.stable for s in sweeps for p in s.points):
        entries.append(Line2D([], [], **CROSS, label="unstable model"))
    if clipped:
        entries.append(Line2D([], [], ls="", label=f"errors above {TOP:g} are drawn at {TOP:g}"))
    return entries


def _legend(figure: Any, entries: list[Line2D]) -> None:
    """Three columns above the axes, which take the rest of the figure."""
    height = float(figure.get_figheight())
    rows = -(-len(entries) // 3)
    top = 1 - (0.12 + 0.165 * rows) / height
    figure.subplots_adjust(left=0.085, right=0.99, bottom=0.45 / height, top=top, wspace=0.24, hspace=0.1)
    figure.legend(
        handles=entries, loc="upper center", bbox_to_anchor=(0.5, 1.0), ncols=3, columnspacing=1.4, handlelength=2.4,
        borderaxespad=0.0, fontsize=7,
    )  # fmt: skip
