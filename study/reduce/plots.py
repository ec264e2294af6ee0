"""Figures of ``softgrasp reduce``: errors against N and against time, singular values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from softgrasp.reduction.bases.registry import PAPER_METHODS
from softgrasp.study.pictures import style
from softgrasp.study.reduce.result import MethodSweep, Point, nearest

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
FULL: dict[str, Any] = {"color": "#888888", "lw": 0.9, "ls": (0, (4, 3)), "zorder": 0}
QUANTITIES = (
    ("error_deformation", "error of the deformation"),
    ("error", r"error of $[q_s, v_s, q_e, v_e]$"),
    ("error_canonical", r"error of $[q_s, p_s, q_e, p_e]$"),
    ("error_energy", "error of the energy"),
)


def looks(sweeps: Sequence[MethodSweep]) -> dict[str, tuple[str, str, str]]:
    """Colour, dashes and marker of every method; those without a place of their own share one colour."""
    others = [s.method.key for s in sweeps if s.method.key not in LOOKS]
    return {**LOOKS, **{key: SPARE[i % len(SPARE)] for i, key in enumerate(others)}}


def of_paper(sweeps: Sequence[MethodSweep]) -> list[MethodSweep]:
    """The paper's six, as far as they ran."""
    return [s for s in sweeps if s.method.key in PAPER_METHODS and s.points]


def further_methods(sweeps: Sequence[MethodSweep]) -> list[MethodSweep]:
    """The others, after the best of the paper's at the N compared."""
    old = [(s.points[i], s) for s in of_paper(sweeps) if (i := nearest(s.points)) is not None]
    first = min(old, key=lambda f: f[0].error_deformation, default=None)
    return ([] if first is None else [first[1]]) + [s for s in sweeps if s.method.key not in PAPER_METHODS and s.points]


def figure_errors(sweeps: Sequence[MethodSweep], out_png: Path) -> tuple[Path, ...]:
    """Error of the deformation against N; a curve is dotted where its model is unstable."""
    with style.paper_style():
        figure, ax = plt.subplots(figsize=(style.COLUMN + 1.6, 3.4))
        figure.subplots_adjust(left=0.13, right=0.66, bottom=0.13, top=0.9)
        _errors_axis(ax, sweeps, *QUANTITIES[0])
        ax.set_xlabel("$N$, columns of the basis")
        if handles := _remarks(sweeps):
            ax.legend(handles=handles, loc="lower left", bbox_to_anchor=(-0.1, 1.0), borderaxespad=0.2, ncols=2)
        return style.save(figure, out_png)


def figure_further_errors(sweeps: Sequence[MethodSweep], out_png: Path) -> tuple[Path, ...]:
    """State, canonical state and energy, one below the other, as the deformation in :func:`figure_errors`."""
    with style.paper_style():
        figure, axes = plt.subplots(3, 1, figsize=(style.COLUMN + 1.6, 6.4), sharex=True)
        figure.subplots_adjust(left=0.13, right=0.66, bottom=0.07, top=0.97, hspace=0.1)
        for ax, quantity in zip(axes, QUANTITIES[1:], strict=True):
            _errors_axis(ax, sweeps, *quantity)
        axes[-1].set_xlabel("$N$, columns of the basis")
        return style.save(figure, out_png)


def _errors_axis(ax: Any, sweeps: Sequence[MethodSweep], key: str, label: str) -> None:
    """Curves of one error, each with its name at its end."""
    look, ends = looks(sweeps), []
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


def figure_times(sweeps: Sequence[MethodSweep], full: float, out_png: Path) -> tuple[Path, ...]:
    """Error of the deformation against online and offline plus online time, with the Pareto front; ``full`` [s]."""
    look, key = looks(sweeps), QUANTITIES[0][0]
    with style.paper_style():
        figure, axes = plt.subplots(2, 1, figsize=(style.COLUMN + 0.9, 5.6), layout="constrained")
        named: dict[str, Line2D] = {}
        for ax, offline in zip(axes, (False, True), strict=True):
            unit = 1.0 if offline else 1e3
            points = [
                (unit * (p.time_online + offline * p.time_offline), min(getattr(p, key), TOP), s)
                for s in sweeps for p in s.points if p.stable and np.isfinite(getattr(p, key))
            ]  # fmt: skip
            ax.plot([t for t, _, _ in points], [e for _, e, _ in points], ls="", marker=".", ms=4, color="#c4c4c4")
            front = pareto(points)
            ax.plot([t for t, _, _ in front], [e for _, e, _ in front], color=style.OUTLINE, lw=1.6, zorder=2)
            for t, e, s in front:
                colour, dashes, marker = look[s.method.key]
                mark: dict[str, Any] = {"ls": "", "marker": marker, "ms": 5.0, "color": colour}
                mark["mfc"] = colour if dashes == "-" else "white"
                ax.plot(t, e, **mark, zorder=3)
                named[s.method.key] = Line2D([], [], label=s.method.short_title, **mark)
            ax.axvline(full * unit, **FULL)
            ax.set_xscale("log")
            style.log_axis(ax, 1.6 * TOP)
            ax.set_ylabel(QUANTITIES[0][1])
            style.few_ticks(ax.xaxis)
        axes[0].set_xlabel("online time of a run [ms]")
        axes[1].set_xlabel("offline + online time [s]")
        rest = [
            Line2D([], [], ls="", marker=".", ms=4, color="#c4c4c4", label="other stable models"),
            Line2D([], [], color=style.OUTLINE, lw=1.6, label="Pareto front"),
            Line2D([], [], label="full run, prefactored", **FULL),
        ]
        figure.legend(handles=[*named.values(), *rest], loc="outside upper center", ncols=2)
        return style.save(figure, out_png)


def pareto(points: Sequence[tuple[float, float, MethodSweep]]) -> list[tuple[float, float, MethodSweep]]:
    """Those of (time, error, method) that no other beats in both, by time."""
    front: list[tuple[float, float, MethodSweep]] = []
    for point in sorted(points, key=lambda p: p[:2]):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def figure_sigma(sweeps: Sequence[MethodSweep], out_png: Path) -> tuple[Path, ...] | None:
    """Singular values over the first, a line for each part of a decomposition; PNG and PDF, None without any."""
    look = looks(sweeps)
    groups = [
        [s for s in part if any(len(v) for v in s.sigma)]
        for part in (of_paper(sweeps), [s for s in sweeps if s.method.key not in PAPER_METHODS])
    ]
    groups = [g for g in groups if g]
    if not groups:
        return None
    with style.paper_style():
        size = (style.WIDTH if len(groups) > 1 else 0.6 * style.WIDTH, 3.3)
        figure, axes = plt.subplots(1, len(groups), figsize=size, sharey=True, squeeze=False, layout="constrained")
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
