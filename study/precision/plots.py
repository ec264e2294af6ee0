"""Figures of ``softgrasp study``: error against time for every question, fronts, slopes, budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import Formatter, LogLocator

from softgrasp.reduction.registry import METHODS
from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE, WIDTH, paper_style, save
from softgrasp.study.precision.fit import Slope, pareto, usable
from softgrasp.study.precision.points import WorkPoint
from softgrasp.study.reduce.plots import LOOKS, SPARE
from softgrasp.study.reduce.times import PAPER_FULL, PAPER_REDUCED

ORDER_LOOK = {1: (BLUE, "o"), 2: (ORANGE, "s")}
SERIES_LOOK = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "D"), (HAND, "v"))
FRONT: dict[str, Any] = {"color": HAND, "lw": 1.6, "alpha": 0.35, "zorder": 1}
THIN: dict[str, Any] = {"lw": 0.6, "alpha": 0.6, "zorder": 2}
LINE: dict[str, Any] = {"color": "#D00000", "lw": 0.9, "ls": (0, (4, 3)), "zorder": 0}
Value = Callable[[WorkPoint], float]


class Between(Formatter):
    """Labels 2 and 5 between powers of ten, on axes that show at most one power."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        """The label of a tick; empty for none."""
        if self.axis is None or not x > 0:
            return ""
        low, high = sorted(self.axis.get_view_interval())
        powers = np.floor(np.log10(high)) - np.ceil(np.log10(low)) + 1
        digit = round(x / 10.0 ** np.floor(np.log10(x) + 1e-9))
        return f"{x:g}" if powers <= 1 and digit in (2, 5) else ""


def axes_log(ax: Any, x: str, y: str) -> None:
    """Logarithmic axes with labels and a pale grid."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(numticks=10))
        axis.set_minor_formatter(Between())
    ax.grid(color="#e6e6e6", lw=0.5, zorder=0)
    ax.set_axisbelow(True)


def draw_front(ax: Any, points: Sequence[WorkPoint], x: Value, y: Value) -> None:
    """The points that no other beats, as a thick pale line."""
    moved = [WorkPoint(p.question, p.series, p.label, x(p), y(p), p.ok) for p in points]
    front = pareto(moved)
    ax.plot([p.seconds for p in front], [p.error for p in front], marker="o", ms=7, mfc="none", **FRONT)


def _error(p: WorkPoint) -> float:
    return p.error


def _seconds(p: WorkPoint) -> float:
    return p.seconds


def figure_forward(
    points: Sequence[WorkPoint], slopes: Sequence[Slope], reference_error: float, paper: bool, out_png: Path
) -> tuple[Path, Path]:
    """Error of the deformation against the time of a whole run; beside it orders in space and time; PNG and PDF.

    Args:
        points: of the forward question.
        slopes: fitted, for the labels.
        reference_error: below it nothing can be told.
        paper: draw the paper's time.
        out_png: name of the picture; the PDF gets its stem.
    """
    plain = [p for p in usable(points) if p.series != "solver"]
    with paper_style():
        figure = plt.figure(figsize=(WIDTH, 4.3), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.7, 1))
        ax, space, time = (figure.add_subplot(grid[k]) for k in ((slice(None), 0), (0, 1), (1, 1)))
        for name in dict.fromkeys(p.series for p in plain):
            mine = sorted((p for p in plain if p.series == name), key=lambda p: p.details["steps"])
            colour, marker = ORDER_LOOK[mine[0].details["order"]]
            ax.plot([p.seconds for p in mine], [p.error for p in mine], color=colour, marker=marker, ms=3.2, **THIN)
            cells = mine[-1].details["cells"]
            if cells is not None:
                ax.annotate(
                    "x".join(map(str, cells)), (mine[-1].seconds, mine[-1].error), (4, -2), textcoords="offset points",
                    fontsize=6, color=colour,
                )  # fmt: skip
        solvers = [p for p in usable(points) if p.series == "solver"]
        ax.plot([p.seconds for p in solvers], [p.error for p in solvers], ls="", marker="x", ms=4, color=GREEN)
        draw_front(ax, points, _seconds, _error)
        axes_log(ax, "time of a run [s]", "relative error of the deformation")
        handles = [_order_handle(order, plain) for order in (1, 2)]
        handles += [Line2D([], [], ls="", marker="x", ms=4, color=GREEN, label="other solvers")]
        handles += [Line2D([], [], marker="o", ms=7, mfc="none", label="Pareto front", **FRONT)]
        if paper:
            ax.axvline(PAPER_FULL, **LINE)
            handles.append(Line2D([], [], label=f"paper, {PAPER_FULL} s (no error given)", **LINE))
        if reference_error > 0:
            ax.axhspan(ax.get_ylim()[0] * 1e-6, reference_error, color="#bbbbbb", alpha=0.35, zorder=0, lw=0)
            low = min([p.error for p in plain if p.error > 0], default=reference_error)
            ax.set_ylim(bottom=min(0.5 * reference_error, 0.5 * low))
            handles.append(Line2D([], [], color="#bbbbbb", lw=5, alpha=0.5, label="error of the reference"))
        shown = [h for h in handles if h is not None]
        figure.legend(handles=shown, loc="outside upper center", ncols=3, fontsize=6.5)
        _orders(space, time, plain, slopes)
        return save(figure, out_png)


def _order_handle(order: int, points: Sequence[WorkPoint]) -> Line2D | None:
    if all(p.details["order"] != order for p in points):
        return None
    colour, marker = ORDER_LOOK[order]
    return Line2D([], [], color=colour, marker=marker, ms=3.2, label=f"P{order}; along a line: steps", **THIN)


def _orders(space: Any, time: Any, plain: Sequence[WorkPoint], slopes: Sequence[Slope]) -> None:
    """Error against the cells at the most steps, and change against the steps."""
    for order in (1, 2):
        mine = [
            p for p in plain if p.details["order"] == order and p.details["cells"] and "error_time" not in p.details
        ]
        mine.sort(key=lambda p: p.details["cells"][0])
        if not mine:
            continue
        colour, marker = ORDER_LOOK[order]
        power = next((s.power for s in slopes if s.series == f"P{order}" and "cells" in s.against), None)
        label = f"P{order}" + ("" if power is None else f", slope {power:.2f}")
        x, y = [p.details["cells"][0] for p in mine], [p.error for p in mine]
        space.plot(x, y, color=colour, marker=marker, ms=3.2, lw=0.9, label=label)
    axes_log(space, "cells along an edge", "error")
    timed = [p for p in plain if p.details.get("error_time", 0) > 0]
    names = list(dict.fromkeys(p.series for p in timed))
    for name in names:
        mine = sorted((p for p in timed if p.series == name), key=lambda p: p.details["steps"])
        colour, marker = ORDER_LOOK[mine[0].details["order"]]
        x, y = [p.details["steps"] for p in mine], [p.details["error_time"] for p in mine]
        time.plot(x, y, color=colour, marker=marker, ms=2.4, **THIN)
    powers = [s.power for s in slopes if s.against == "change in time against steps"]
    if powers:
        time.plot([], [], color=BLUE, label=f"slope {np.median(powers):.2f}", **THIN)
    axes_log(time, "time steps", "change against the\nmost steps")
    for ax in (space, time):
        if ax.get_legend_handles_labels()[0]:
            ax.legend(loc="best", fontsize=6.5, handlelength=1.4)


def figure_reduced(points: Sequence[WorkPoint], full: float, paper: bool, out_png: Path) -> tuple[Path, Path]:
    """Error of the deformation against the online time, and against that from nothing; PNG and PDF.

    Args:
        points: of the reduced question.
        full: seconds of the full run on the same mesh and steps.
        paper: draw the paper's times; its error is one of the state.
        out_png: name of the picture; the PDF gets its stem.
    """
    names = list(dict.fromkeys(p.series for p in points))
    others = [n for n in names if n not in LOOKS]
    look = {**LOOKS, **{key: SPARE[i % len(SPARE)] for i, key in enumerate(others)}}

    def error(p: WorkPoint) -> float:
        return float(p.details["error_outputs_full"])

    def scratch(p: WorkPoint) -> float:
        return float(p.details["scratch"])

    good = usable(points)
    with paper_style():
        figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.7), sharey=True)
        for ax, x, label in zip(
            axes, (_seconds, scratch), ("online time of a run [s]", "time from nothing: full run, basis, online [s]"),
            strict=True,
        ):  # fmt: skip
            for name in names:
                mine = sorted((p for p in good if p.series == name), key=lambda p: p.details["N"])
                colour, dashes, marker = look[name]
                fill = "full" if dashes == "-" else "none"
                ax.plot(
                    [x(p) for p in mine], [error(p) for p in mine], color=colour, ls=dashes, marker=marker, ms=3.2,
                    fillstyle=fill, **THIN,
                )  # fmt: skip
            draw_front(ax, points, x, error)
            axes_log(ax, label, "relative error of the deformation" if ax is axes[0] else "")
            ax.axvline(full, color="#888888", lw=0.9, ls=(0, (4, 3)), zorder=0)
        if paper:
            axes[0].axvline(PAPER_REDUCED, **(LINE | {"ls": ":"}))
            axes[1].axvline(PAPER_FULL, **LINE)
        handles = [
            Line2D([], [], color=look[n][0], ls=look[n][1], marker=look[n][2], ms=3.2, lw=0.6, label=_title(n))
            for n in names
        ]
        handles += [Line2D([], [], marker="o", ms=7, mfc="none", label="Pareto front", **FRONT)]
        handles += [Line2D([], [], color="#888888", lw=0.9, ls=(0, (4, 3)), label="full run")]
        if paper:
            handles += [Line2D([], [], label=f"paper, N = 14: {PAPER_REDUCED} s", **(LINE | {"ls": ":"}))]
            handles += [Line2D([], [], label=f"paper, full: {PAPER_FULL} s", **LINE)]
        rows = -(-len(handles) // 3)
        figure.subplots_adjust(left=0.085, right=0.985, bottom=0.13, top=1 - (0.05 + 0.14 * rows) / 3.7, wspace=0.06)
        figure.legend(handles=handles, loc="upper center", ncols=3, fontsize=6.5, borderaxespad=0.0)
        return save(figure, out_png)


def _title(name: str) -> str:
    return METHODS[name].title.replace(", fixed solid modes", ", fixed") if name in METHODS else name


def figure_series(points: Sequence[WorkPoint], x: str, y: str, out_png: Path) -> tuple[Path, Path]:
    """One line a series, error against time; PNG and PDF."""
    with paper_style():
        figure, ax = plt.subplots(figsize=(0.62 * WIDTH, 2.9), layout="constrained")
        for k, name in enumerate(dict.fromkeys(p.series for p in points)):
            mine = [p for p in points if p.series == name and np.isfinite(p.error) and p.error > 0]
            colour, marker = SERIES_LOOK[k % len(SERIES_LOOK)]
            ax.plot([p.seconds for p in mine], [p.error for p in mine], color=colour, lw=0.8, label=_title(name))
            for p in mine:
                face = colour if p.ok else "none"
                ax.plot([p.seconds], [p.error], ls="", marker=marker, ms=3.6, color=colour, mfc=face)
        draw_front(ax, points, _seconds, _error)
        ax.plot([], [], marker="o", ms=7, mfc="none", label="Pareto front", **FRONT)
        axes_log(ax, x, y)
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5)
        return save(figure, out_png)


def figure_budget(
    forward: Sequence[WorkPoint], reduced: Sequence[WorkPoint], budget: float, out_png: Path
) -> tuple[Path, Path]:
    """Time of a step, median to 99 % and the largest, against the error of the deformation; PNG and PDF."""
    groups = (("full model", BLUE, forward), ("reduced models", ORANGE, reduced))
    with paper_style():
        figure, ax = plt.subplots(figsize=(0.75 * WIDTH, 3.3), layout="constrained")
        for name, colour, points in groups:
            good = [p for p in usable(points) if p.details.get("p99") is not None and p.error > 0]
            for p in good:
                d = p.details
                ax.plot([d["p50"], d["p99"]], [p.error] * 2, color=colour, lw=1.4, alpha=0.6, zorder=2)
                ax.plot([d["p99"], d["max"]], [p.error] * 2, color=colour, lw=0.5, alpha=0.35, zorder=1)
            y = [p.error for p in good]
            ax.plot([p.details["p50"] for p in good], y, ls="", marker="o", ms=2.8, color=colour, label=name)
            ax.plot([p.details["max"] for p in good], y, ls="", marker="|", ms=4, color=colour, alpha=0.6)
        ax.axvline(budget, label="the budget", **(LINE | {"zorder": 5}))
        axes_log(
            ax, "time of a step [s]: median, bar to 99 %, thin to the largest", "relative error of the deformation"
        )
        ax.legend(loc="best")
        return save(figure, out_png)
