"""Figures of ``softgrasp study``: accuracy against cost for every question, with fronts, slopes and the budget."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import Formatter, LogLocator, MaxNLocator

from softgrasp.lqr import BASES
from softgrasp.reduction import METHODS, OWN_METHODS
from softgrasp.study.control.plots import LOOKS as BASIS_LOOKS
from softgrasp.study.control.result import TITLES as BASIS_TITLES
from softgrasp.study.pictures import BLUE, FULL, GREEN, HAND, ORANGE, PURPLE, UNSTABLE, WIDTH, paper_style, save
from softgrasp.study.precision.fit import Slope, pareto, series_of, usable
from softgrasp.study.precision.forward import on_meshes, over_steps
from softgrasp.study.precision.points import (
    ForwardPoint,
    ReducedPoint,
    ReducedRiccatiPoint,
    RiccatiPoint,
    RunPoint,
    WorkPoint,
)
from softgrasp.study.precision.riccati import TITLES
from softgrasp.study.precision.tables import PAPER_ARE, PAPER_N, PAPER_SMALL
from softgrasp.study.reduce.linear.measure import PAPER_FULL, PAPER_REDUCED
from softgrasp.study.reduce.linear.plots import looks

ORDER_LOOK = {1: (BLUE, "o"), 2: (ORANGE, "s"), 3: (GREEN, "^")}
SERIES_LOOK = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (PURPLE, "D"), (HAND, "v"))
METHOD_LOOK = {"newton_adi": (BLUE, "o"), "radi": (ORANGE, "s"), "galerkin": (GREEN, "^"), "dense": (HAND, "D")}
FRONT: dict[str, Any] = {"color": HAND, "lw": 1.6, "alpha": 0.35, "zorder": 1, "marker": "o", "ms": 7, "mfc": "none"}
THIN: dict[str, Any] = {"lw": 0.6, "alpha": 0.6, "zorder": 2}
LINE: dict[str, Any] = {"color": "#D00000", "lw": 0.9, "ls": (0, (4, 3)), "zorder": 0}
SOLVERS: dict[str, Any] = {"ls": "", "marker": "x", "ms": 4, "color": HAND}
CROSS: dict[str, Any] = {"ls": "", "marker": "x", "ms": 5, "mew": 1.1, "color": UNSTABLE}
EDGE: dict[str, Any] = {"clip_on": False, "in_layout": False}
NEAR = 1e-2  # of the lowest point: a reference that is better still is not drawn, the text reports its error
TOP, LOW = 1.0, 1e-13  # errors and excess costs of gains above are on the edge, below are rounding
DEFORMATION = "relative error of the deformation"


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


def _one_and_two() -> list[Any]:
    """A figure with one wide panel beside two."""
    figure = plt.figure(figsize=(WIDTH, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.7, 1))
    return [figure, *(figure.add_subplot(grid[k]) for k in ((slice(None), 0), (0, 1), (1, 1)))]


def _axes_log(ax: Any, x: str, y: str) -> None:
    """Logarithmic axes with labels and a pale grid."""
    ax.set(xscale="log", yscale="log", xlabel=x, ylabel=y)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(LogLocator(numticks=10))
        axis.set_minor_formatter(Between())
    ax.grid(color="#e6e6e6", lw=0.5, zorder=0)
    ax.set_axisbelow(True)


def _curve(ax: Any, points: Sequence[WorkPoint], x: str = "seconds", y: str = "error", **style: Any) -> None:
    """One attribute of the points against another."""
    ax.plot([getattr(p, x) for p in points], [getattr(p, y) for p in points], **style)


def _front(ax: Any, points: Sequence[WorkPoint], x: str = "seconds", y: str = "error") -> list[Line2D]:
    """The points that no other beats, as a thick pale line; its handle for a legend."""
    _curve(ax, pareto(points, x, y), x, y, **FRONT)
    return [_handle("Pareto front", **FRONT)]


def _handle(label: str, **style: Any) -> Line2D:
    return Line2D([], [], label=label, **style)


def _band(ax: Any, error: float | None) -> list[Line2D]:
    """Grey below the error of the reference, where it is near the points; its handle for a legend."""
    low, high = ax.get_ylim()
    if error is None or not error > NEAR * low:
        return []
    ax.axhspan(1e-300, error, color="#bbbbbb", alpha=0.35, zorder=0, lw=0)
    ax.set_ylim(min(low, 0.3 * error), high)
    return [_handle("error of the reference", color="#bbbbbb", lw=5, alpha=0.5)]


def _mark(axes: Sequence[Any], paper: bool, seconds: float, label: str, **style: Any) -> list[Line2D]:
    """A time of the paper in its own scene; its handle for a legend."""
    for ax in axes if paper else ():
        ax.axvline(seconds, **(LINE | style))
    return [_handle(label, **(LINE | style))] if paper else []


def figure_forward(
    points: Sequence[ForwardPoint], slopes: Sequence[Slope], truth_error: float, paper: bool, out_png: Path
) -> tuple[Path, ...]:
    """Error of the deformation against the time of a whole run; beside it orders in space and time; PNG and PDF."""
    good = [p for p in usable(points) if p.series != "solver"]
    with paper_style():
        figure, ax, space, time = _one_and_two()
        for line in series_of(sorted(good, key=lambda p: p.steps)).values():
            _curve(ax, line, **_look(line[-1]), **THIN)
        for last in (line[-1] for line in on_meshes(good).values() if line[-1].refine != "off"):
            ax.annotate(
                f"n = {last.n_e}", (last.seconds, last.error), (4, 6 * last.order - 14), fontsize=6,
                textcoords="offset points", color=ORDER_LOOK[last.order][0],
            )  # fmt: skip
        _curve(ax, [p for p in usable(points) if p.series == "solver"], **SOLVERS)
        front = _front(ax, points)
        _axes_log(ax, "time of a run [s]", DEFORMATION)
        handles = [
            _handle(f"{name}; along a line: steps" if line[0].refine != "off" else name, **_look(line[0]), **THIN)
            for name, line in on_meshes(good).items()
        ]
        handles += [_handle("other solvers", **SOLVERS), *front]
        handles += _mark([ax], paper, PAPER_FULL, f"paper, {PAPER_FULL} s (no error given)")
        handles += _band(ax, truth_error)
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
        fitted = next((s for s in slopes if s.series == name and "n_e" in s.against), None)
        label = name if fitted is None else f"{name}: {-fitted.power:.2f} ({-(fitted.expected or 0):.2g})"
        _curve(space, line, "n_e", lw=0.9, label=label, **_look(line[0]))
    _axes_log(space, "tissue unknowns", "error")
    for line in over_steps(points).values():
        _curve(time, line, "steps", "error_time", **(_look(line[0]) | {"ms": 2.4}), **THIN)
    powers = [s.power for s in slopes if s.against == "change in time against steps"]
    if powers:
        time.plot([], [], color=BLUE, label=f"slope {np.median(powers):.2f} (-2)", **THIN)
    _axes_log(time, "time steps", "change against the\nmost steps")
    if space.get_legend_handles_labels()[0]:
        space.set_ylim(bottom=space.get_ylim()[0] / 30)  # room for the legend below the curves
        space.legend(loc="lower left", fontsize=5, ncols=2, handlelength=1.4, title="order (theory)", title_fontsize=5)
    if powers:
        time.legend(loc="best", fontsize=6.5, handlelength=1.4)


def figure_reduced(points: Sequence[ReducedPoint], full: float, paper: bool, out_png: Path) -> tuple[Path, ...]:
    """Error of the deformation against the online time, and against that from nothing; PNG and PDF.

    Beside them the seconds of the full run, and times of the paper, whose error is one of the state.
    """
    names = list(series_of(points))
    look: dict[str, dict[str, Any]] = {
        name: {"color": colour, "ls": dashes, "marker": marker, "ms": 3.2, "lw": 0.6}
        for name, (colour, dashes, marker) in looks(names).items()
    }
    lines = series_of(sorted(usable(points), key=lambda p: p.N))
    costs = {"seconds": "online time of a run [s]", "scratch": "time from nothing: full run, basis, online [s]"}
    with paper_style():
        figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.7), sharey=True, layout="constrained")
        for ax, (x, label) in zip(axes, costs.items(), strict=True):
            for name, line in lines.items():
                fill = "full" if look[name]["ls"] == "-" else "none"
                _curve(ax, line, x, "error_outputs_full", fillstyle=fill, **(look[name] | THIN))
            front = _front(ax, points, x, "error_outputs_full")
            _axes_log(ax, label, DEFORMATION if ax is axes[0] else "")
            ax.axvline(full, **FULL)
        known = METHODS | OWN_METHODS
        titles = {name: known[name].short_title if name in known else name for name in names}
        handles = [_handle(titles[n], **look[n]) for n in names] + front + [_handle("full run", **FULL)]
        handles += _mark(axes[:1], paper, PAPER_REDUCED, f"paper, N = 14: {PAPER_REDUCED} s", ls=":")
        handles += _mark(axes[1:], paper, PAPER_FULL, f"paper, full: {PAPER_FULL} s")
        figure.legend(handles=handles, loc="outside upper center", ncols=3, fontsize=6.5)
        return save(figure, out_png)


def figure_series(points: Sequence[WorkPoint], x: str, y: str, out_png: Path) -> tuple[Path, ...]:
    """One line a series, error against time; PNG and PDF."""
    with paper_style():
        figure, ax = plt.subplots(figsize=(0.62 * WIDTH, 2.9), layout="constrained")
        for k, (name, points_of) in enumerate(series_of(points).items()):
            line = [p for p in points_of if np.isfinite(p.error) and p.error > 0]
            colour, marker = SERIES_LOOK[k % len(SERIES_LOOK)]
            _curve(ax, line, color=colour, lw=0.8, label=name)
            for p in line:
                _curve(ax, [p], ls="", marker=marker, ms=3.6, color=colour, mfc=colour if p.ok else "none")
        _curve(ax, pareto(points), label="Pareto front", **FRONT)
        _axes_log(ax, x, y)
        figure.legend(loc="outside right center", fontsize=6.5)
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
            _curve(ax, good, "p50", ls="", marker="o", ms=2.8, color=colour, label=name)
            _curve(ax, good, "max", ls="", marker="|", ms=4, color=colour, alpha=0.6)
        ax.axvline(budget, label="the budget", **(LINE | {"zorder": 5}))
        _axes_log(ax, "time of a step [s]: median, bar to 99 %, thin to the largest", DEFORMATION)
        ax.legend(loc="best")
        return save(figure, out_png)


def figure_riccati(points: Sequence[RiccatiPoint], error: float | None, paper: bool, out_png: Path) -> tuple[Path, ...]:
    """Error of the gain and true residual against time, one line a method along its tolerances; PNG and PDF."""
    lines = series_of(usable(points))
    look: dict[str, dict[str, Any]] = {
        name: {"color": colour, "marker": marker, "ms": 3.4, "lw": 0.7}
        for name, (colour, marker) in METHOD_LOOK.items()
        if name in lines
    }
    with paper_style():
        figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.2), layout="constrained")
        values = {"error": "relative error of the gain", "residual": "relative residual"}
        for ax, (y, label) in zip(axes, values.items(), strict=True):
            for name, style in look.items():
                _curve(ax, [p for p in lines[name] if getattr(p, y) > 0], y=y, **style)
            front = _front(ax, points, y=y)
            _axes_log(ax, "time of the solution [s]", label)
        handles = [_handle(TITLES[name], **style) for name, style in look.items()]
        handles += front + _band(axes[0], error)
        handles += _mark(axes, paper, PAPER_ARE, f"paper, {PAPER_ARE} s (no error given)")
        figure.legend(handles=handles, loc="outside upper center", ncols=4)
        return save(figure, out_png)


def figure_reduced_riccati(points: Sequence[ReducedRiccatiPoint], paper: bool, out_png: Path) -> tuple[Path, ...]:
    """Error of the gain and excess cost, each against N and against the time of the equation; PNG and PDF.

    Gains that are not ok are crossed out.
    """
    good = [replace(p, error=max(p.error, LOW), cost_excess=max(p.cost_excess, LOW)) for p in usable(points)]
    bad = [p for p in points if not p.ok and not p.reason]
    names = series_of(points)
    look: dict[str, dict[str, Any]] = {}
    for name in (*(n for n in BASES if n in names), *(n for n in names if n not in BASES)):
        colour, dashes, marker = BASIS_LOOKS.get(name, (HAND, ":", "x"))
        look[name] = {"color": colour, "ls": dashes, "lw": 1.0, "marker": marker, "ms": 3.4, "mfc": "none"}
    with paper_style():
        figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 5.0), sharey="row", sharex="col", layout="constrained")
        values = {"error": "error of the gain K", "cost_excess": "excess cost"}
        for row, (y, label) in zip(grid, values.items(), strict=True):
            for name, line in series_of(sorted(good, key=lambda p: p.N)).items():
                _basis_lines(row, line, y, look[name] | {"mew": 0.9})
            height = [min(getattr(p, y), TOP) for p in bad]
            for ax, x in zip(row, ("N", "seconds"), strict=True):
                ax.plot([getattr(p, x) for p in bad], height, zorder=4, **CROSS, **EDGE)
            front = _front(row[1], [p for p in good if getattr(p, y) <= TOP], y=y)
            mark = _mark(row[1:], paper, PAPER_SMALL, f"paper, {1e3 * PAPER_SMALL:.0f} ms at N = {PAPER_N}")
            _axes_log(row[1], "time of the reduced equation [s]", "")
            _axes_log(row[0], "N", label)
            row[0].set_xscale("linear")
            row[0].xaxis.set_major_locator(MaxNLocator(6, integer=True))
            row[0].set_ylim(top=1.6 * TOP)
        for ax in grid[0]:
            ax.set_xlabel("")
        handles = [_handle(BASIS_TITLES.get(name, name), **style) for name, style in look.items()] + front
        if any(not p.ok for p in points):
            handles.append(_handle("full loop not stable", **CROSS))
        figure.legend(handles=handles + mark, loc="outside upper center", ncols=3)
        return save(figure, out_png)


def _basis_lines(row: Any, line: Sequence[ReducedRiccatiPoint], y: str, style: dict[str, Any]) -> None:
    """One basis in both panels of a row; above the top the line is broken and a mark stays on the edge."""
    inside = [p if getattr(p, y) <= TOP else replace(p, **{y: float("nan")}) for p in line]  # type: ignore[arg-type]
    above = [replace(p, **{y: TOP}) for p in line if getattr(p, y) > TOP]  # type: ignore[arg-type]
    marks = style | {"ls": ""}
    for ax, x, look in zip(row, ("N", "seconds"), (style, marks), strict=True):
        _curve(ax, inside, x, y, **look)
        _curve(ax, above, x, y, **marks, **EDGE)
