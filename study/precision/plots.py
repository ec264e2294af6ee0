"""Figures of ``softgrasp study``: error against time for every question, fronts, slopes, budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import Formatter, LogLocator

from softgrasp.reduction.bases.registry import METHODS
from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE, WIDTH, paper_style, save
from softgrasp.study.precision.fit import Slope, error_of, pareto, seconds_of, series_of, usable
from softgrasp.study.precision.forward import on_meshes, over_steps
from softgrasp.study.precision.points import ForwardPoint, ReducedPoint, RunPoint, WorkPoint
from softgrasp.study.precision.tables import error_outputs
from softgrasp.study.reduce.measure import PAPER_FULL, PAPER_REDUCED
from softgrasp.study.reduce.plots import LOOKS, SPARE

ORDER_LOOK = {1: (BLUE, "o"), 2: (ORANGE, "s"), 3: (GREEN, "^")}
SERIES_LOOK = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "D"), (HAND, "v"))
FRONT: dict[str, Any] = {"color": HAND, "lw": 1.6, "alpha": 0.35, "zorder": 1}
NEAR = 1e-2  # of the lowest point: a reference that is better still is not drawn, the text tells its error
THIN: dict[str, Any] = {"lw": 0.6, "alpha": 0.6, "zorder": 2}
LINE: dict[str, Any] = {"color": "#D00000", "lw": 0.9, "ls": (0, (4, 3)), "zorder": 0}


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


def draw_front[P: WorkPoint](
    ax: Any, points: Sequence[P], x: Callable[[P], float] = seconds_of, y: Callable[[P], float] = error_of
) -> None:
    """The points that no other beats, as a thick pale line."""
    front = pareto(points, x, y)
    ax.plot([x(p) for p in front], [y(p) for p in front], marker="o", ms=7, mfc="none", **FRONT)


def front_handle() -> Line2D:
    """Of the front, for a legend."""
    return Line2D([], [], marker="o", ms=7, mfc="none", label="Pareto front", **FRONT)


def draw_band(ax: Any, error: float | None) -> list[Line2D]:
    """Grey below the error of the reference, where it is near the points; its handle for a legend."""
    low, high = ax.get_ylim()
    if error is None or not error > NEAR * low:
        return []
    ax.axhspan(1e-300, error, color="#bbbbbb", alpha=0.35, zorder=0, lw=0)
    ax.set_ylim(min(low, 0.3 * error), high)
    return [Line2D([], [], color="#bbbbbb", lw=5, alpha=0.5, label="error of the reference")]


def figure_forward(
    points: Sequence[ForwardPoint], slopes: Sequence[Slope], truth_error: float, paper: bool, out_png: Path
) -> tuple[Path, ...]:
    """Error of the deformation against the time of a whole run; beside it orders in space and time; PNG and PDF.

    Args:
        slopes: fitted, for the labels.
        truth_error: below it nothing can be told.
    """
    good = [p for p in usable(points) if p.series != "solver"]
    with paper_style():
        figure = plt.figure(figsize=(WIDTH, 4.6), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.7, 1))
        ax, space, time = (figure.add_subplot(grid[k]) for k in ((slice(None), 0), (0, 1), (1, 1)))
        for line in series_of(sorted(good, key=lambda p: p.steps)).values():
            look = _look(line[-1])
            ax.plot([p.seconds for p in line], [p.error for p in line], **look, **THIN)
        for last in (line[-1] for line in on_meshes(good).values() if line[-1].refine != "off"):
            ax.annotate(
                f"n = {last.n_e}", (last.seconds, last.error), (4, 6 * last.order - 14), fontsize=6,
                textcoords="offset points", color=ORDER_LOOK[last.order][0],
            )  # fmt: skip
        solvers = [p for p in usable(points) if p.series == "solver"]
        ax.plot([p.seconds for p in solvers], [p.error for p in solvers], ls="", marker="x", ms=4, color=HAND)
        draw_front(ax, points)
        axes_log(ax, "time of a run [s]", "relative error of the deformation")
        handles = [
            Line2D([], [], label=f"{name}; along a line: steps" if line[0].refine != "off" else name,
                   **_look(line[0]), **THIN)
            for name, line in on_meshes(good).items()
        ]  # fmt: skip
        handles += [Line2D([], [], ls="", marker="x", ms=4, color=HAND, label="other solvers"), front_handle()]
        if paper:
            ax.axvline(PAPER_FULL, **LINE)
            handles.append(Line2D([], [], label=f"paper, {PAPER_FULL} s (no error given)", **LINE))
        handles += draw_band(ax, truth_error)
        figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=6.5)
        _orders(space, time, good, slopes)
        return save(figure, out_png)


def _look(p: ForwardPoint) -> dict[str, Any]:
    """Colour by order; filled marks on graded meshes."""
    colour, marker = ORDER_LOOK[p.order]
    return {"color": colour, "marker": marker, "ms": 3.2, "mfc": "none" if p.refine == "off" else colour}


def _orders(space: Any, time: Any, points: Sequence[ForwardPoint], slopes: Sequence[Slope]) -> None:
    """Error against n_e at the most steps, and change against the steps."""
    for name, line in on_meshes(points).items():
        found = next((s for s in slopes if s.series == name and "n_e" in s.against), None)
        label = name if found is None else f"{name}: {-found.power:.2f} ({-(found.expected or 0):.2g})"
        space.plot([p.n_e for p in line], [p.error for p in line], lw=0.9, label=label, **_look(line[0]))
    axes_log(space, "tissue unknowns $n_e$", "error")
    for line in over_steps(points).values():
        time.plot([p.steps for p in line], [p.error_time for p in line], **(_look(line[0]) | {"ms": 2.4}), **THIN)
    powers = [s.power for s in slopes if s.against == "change in time against steps"]
    if powers:
        time.plot([], [], color=BLUE, label=f"slope {np.median(powers):.2f} (-2)", **THIN)
    axes_log(time, "time steps", "change against the\nmost steps")
    if space.get_legend_handles_labels()[0]:
        space.set_ylim(bottom=space.get_ylim()[0] / 30)  # room for the legend below the curves
        space.legend(loc="lower left", fontsize=5, ncols=2, handlelength=1.4, title="order (theory)", title_fontsize=5)
    if powers:
        time.legend(loc="best", fontsize=6.5, handlelength=1.4)


def figure_reduced(points: Sequence[ReducedPoint], full: float, paper: bool, out_png: Path) -> tuple[Path, ...]:
    """Error of the deformation against the online time, and against that from nothing; PNG and PDF.

    Args:
        full: seconds of the full run on the same mesh and steps.
        paper: draw the paper's times; its error is one of the state.
    """
    names = list(series_of(points))
    others = [n for n in names if n not in LOOKS]
    look = {**LOOKS, **{key: SPARE[i % len(SPARE)] for i, key in enumerate(others)}}

    def scratch(p: ReducedPoint) -> float:
        return p.scratch

    lines = series_of(sorted(usable(points), key=lambda p: p.N))
    with paper_style():
        figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.7), sharey=True)
        for ax, x, label in zip(
            axes, (seconds_of, scratch), ("online time of a run [s]", "time from nothing: full run, basis, online [s]"),
            strict=True,
        ):  # fmt: skip
            for name, line in lines.items():
                colour, dashes, marker = look[name]
                fill = "full" if dashes == "-" else "none"
                ax.plot(
                    [x(p) for p in line], [error_outputs(p) for p in line], color=colour, ls=dashes, marker=marker,
                    ms=3.2, fillstyle=fill, **THIN,
                )  # fmt: skip
            draw_front(ax, points, x, error_outputs)
            axes_log(ax, label, "relative error of the deformation" if ax is axes[0] else "")
            ax.axvline(full, color="#888888", lw=0.9, ls=(0, (4, 3)), zorder=0)
        if paper:
            axes[0].axvline(PAPER_REDUCED, **(LINE | {"ls": ":"}))
            axes[1].axvline(PAPER_FULL, **LINE)
        handles = [
            Line2D([], [], color=look[n][0], ls=look[n][1], marker=look[n][2], ms=3.2, lw=0.6, label=_title(n))
            for n in names
        ]
        handles += [front_handle(), Line2D([], [], color="#888888", lw=0.9, ls=(0, (4, 3)), label="full run")]
        if paper:
            handles += [Line2D([], [], label=f"paper, N = 14: {PAPER_REDUCED} s", **(LINE | {"ls": ":"}))]
            handles += [Line2D([], [], label=f"paper, full: {PAPER_FULL} s", **LINE)]
        rows = -(-len(handles) // 3)
        figure.subplots_adjust(left=0.085, right=0.985, bottom=0.13, top=1 - (0.05 + 0.14 * rows) / 3.7, wspace=0.06)
        figure.legend(handles=handles, loc="upper center", ncols=3, fontsize=6.5, borderaxespad=0.0)
        return save(figure, out_png)


def _title(name: str) -> str:
    return METHODS[name].title.replace(", fixed solid modes", ", fixed") if name in METHODS else name


def figure_series(points: Sequence[WorkPoint], x: str, y: str, out_png: Path) -> tuple[Path, ...]:
    """One line a series, error against time; PNG and PDF."""
    with paper_style():
        figure, ax = plt.subplots(figsize=(0.62 * WIDTH, 2.9), layout="constrained")
        for k, (name, points_of) in enumerate(series_of(points).items()):
            line = [p for p in points_of if np.isfinite(p.error) and p.error > 0]
            colour, marker = SERIES_LOOK[k % len(SERIES_LOOK)]
            ax.plot([p.seconds for p in line], [p.error for p in line], color=colour, lw=0.8, label=_title(name))
            for p in line:
                face = colour if p.ok else "none"
                ax.plot([p.seconds], [p.error], ls="", marker=marker, ms=3.6, color=colour, mfc=face)
        draw_front(ax, points)
        ax.plot([], [], marker="o", ms=7, mfc="none", label="Pareto front", **FRONT)
        axes_log(ax, x, y)
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=6.5)
        return save(figure, out_png)


def figure_budget(points: Sequence[WorkPoint], budget: float, out_png: Path) -> tuple[Path, ...]:
    """Time of a step, median to 99 % and the largest, against the error of the deformation; PNG and PDF."""
    with paper_style():
        figure, ax = plt.subplots(figsize=(0.75 * WIDTH, 3.3), layout="constrained")
        for name, colour, kind in (("full model", BLUE, ForwardPoint), ("reduced models", ORANGE, ReducedPoint)):
            good: list[RunPoint] = [p for p in usable(points) if isinstance(p, kind) and p.error > 0]
            for p in good:
                ax.plot([p.p50, p.p99], [p.error] * 2, color=colour, lw=1.4, alpha=0.6, zorder=2)
                ax.plot([p.p99, p.max], [p.error] * 2, color=colour, lw=0.5, alpha=0.35, zorder=1)
            y = [p.error for p in good]
            ax.plot([p.p50 for p in good], y, ls="", marker="o", ms=2.8, color=colour, label=name)
            ax.plot([p.max for p in good], y, ls="", marker="|", ms=4, color=colour, alpha=0.6)
        ax.axvline(budget, label="the budget", **(LINE | {"zorder": 5}))
        axes_log(
            ax, "time of a step [s]: median, bar to 99 %, thin to the largest", "relative error of the deformation"
        )
        ax.legend(loc="best")
        return save(figure, out_png)
