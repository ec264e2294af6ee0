"""Figures of ``softgrasp study`` about feedback: Riccati equation, reduced Riccati equations, closed loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from softgrasp.lqr.reduced.bases import BASES
from softgrasp.study.control.plots import LOOKS
from softgrasp.study.control.result import TITLES as BASIS_TITLES
from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE, UNSTABLE, WIDTH, paper_style, save
from softgrasp.study.precision.fit import error_of, series_of, usable
from softgrasp.study.precision.plots import LINE, axes_log, draw_band, draw_front, front_handle
from softgrasp.study.precision.points import LoopPoint, ReducedRiccatiPoint, RiccatiPoint
from softgrasp.study.precision.riccati import TITLES
from softgrasp.study.precision.tables import PAPER_ARE, PAPER_N, PAPER_SMALL

METHOD_LOOK = {"newton_adi": (BLUE, "o"), "radi": (ORANGE, "s"), "galerkin": (GREEN, "^"), "dense": (HAND, "D")}
GAIN_COLOURS = (HAND, ORANGE, BLUE, GREEN, PURPLE)
TOP, LOW = 1.0, 1e-13  # errors and excess costs above are on the edge, below are rounding
TICK = 1e-3  # [s], of a robot's control loop
EDGE: dict[str, Any] = {"clip_on": False, "in_layout": False}
Value = Callable[[ReducedRiccatiPoint], float]


def figure_riccati(points: Sequence[RiccatiPoint], error: float | None, paper: bool, out_png: Path) -> tuple[Path, ...]:
    """Error of the gain and true residual against time, one line a method along its tolerances; PNG and PDF.

    Args:
        error: estimated error of the reference.
    """
    good = usable(points)

    def residual(p: RiccatiPoint) -> float:
        return p.residual

    values = ((error_of, "relative error of the gain"), (residual, "relative residual"))
    with paper_style():
        figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.2), layout="constrained")
        for ax, (value, label) in zip(axes, values, strict=True):
            for name, (colour, marker) in METHOD_LOOK.items():
                line = [p for p in good if p.series == name and value(p) > 0]
                ax.plot([p.seconds for p in line], [value(p) for p in line], color=colour, marker=marker, ms=3.4,
                        lw=0.7)  # fmt: skip
            draw_front(ax, good, y=value)
            if paper:
                ax.axvline(PAPER_ARE, **LINE)
            axes_log(ax, "time of the solution [s]", label)
        band = draw_band(axes[0], error)
        handles = [
            Line2D([], [], color=c, marker=m, ms=3.4, lw=0.7, label=TITLES[n])
            for n, (c, m) in METHOD_LOOK.items()
            if any(p.series == n for p in good)
        ]
        handles.append(front_handle())
        handles += band
        if paper:
            handles.append(Line2D([], [], label=f"paper, {PAPER_ARE} s (no error given)", **LINE))
        figure.legend(handles=handles, loc="outside upper center", ncols=4)
        return save(figure, out_png)


def figure_reduced_riccati(points: Sequence[ReducedRiccatiPoint], paper: bool, out_png: Path) -> tuple[Path, ...]:
    """Error of the gain and excess cost, each against N and against the time of the equation; PNG and PDF.

    Args:
        points: of the question; gains that are not ok are crossed out.
    """
    good = usable(points)

    def cost(p: ReducedRiccatiPoint) -> float:
        return p.cost_excess

    with paper_style():
        figure, grid = plt.subplots(2, 2, figsize=(WIDTH, 5.0), sharey="row", sharex="col", layout="constrained")
        for row, (value, label) in zip(grid, ((error_of, "error of the gain $K$"), (cost, "excess cost")), strict=True):
            for name, line in series_of(sorted(good, key=lambda p: p.N)).items():
                _basis_lines(row, line, value, LOOKS.get(name, (HAND, ":", "x")))
            bad = [p for p in points if not p.ok and not p.reason]
            height = [min(value(p), TOP) for p in bad]
            for ax, x in zip(row, ([p.N for p in bad], [p.seconds for p in bad]), strict=True):
                ax.plot(x, height, ls="", marker="x", ms=5, mew=1.1, color=UNSTABLE, zorder=4, **EDGE)
            inside = [p for p in good if value(p) <= TOP]
            draw_front(row[1], inside, y=_at_least(value))
            if paper:
                row[1].axvline(PAPER_SMALL, **LINE)
            axes_log(row[1], "time of the reduced equation [s]", "")
            _against_order(row[0], label)
            row[0].set_ylim(top=1.6 * TOP)
        for ax in grid[0]:
            ax.set_xlabel("")
        figure.legend(handles=_reduced_handles(points, paper), loc="outside upper center", ncols=3)
        return save(figure, out_png)


def _at_least(value: Value) -> Value:
    """The value, or what is left of it above rounding."""
    return lambda p: max(value(p), LOW)


def _basis_lines(row: Any, line: Sequence[ReducedRiccatiPoint], value: Value, look: tuple[str, str, str]) -> None:
    """One basis in both panels of a row; above the top the line is broken and a mark stays on the edge."""
    colour, dashes, marker = look
    style: dict[str, Any] = {"color": colour, "marker": marker, "ms": 3.4, "mfc": "none", "mew": 0.9}
    y = [max(value(p), LOW) for p in line]
    inside = [v if v <= TOP else float("nan") for v in y]
    for ax, x in zip(row, ([float(p.N) for p in line], [p.seconds for p in line]), strict=True):
        ax.plot(x, inside, ls=dashes if ax is row[0] else "", lw=1.0, **style)
        above = [a for a, v in zip(x, y, strict=True) if v > TOP]
        ax.plot(above, [TOP] * len(above), ls="", **EDGE, **style)


def _against_order(ax: Any, label: str) -> None:
    axes_log(ax, "$N$", label)
    ax.set_xscale("linear")
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))


def _reduced_handles(points: Sequence[ReducedRiccatiPoint], paper: bool) -> list[Line2D]:
    handles = []
    for name in [n for n in BASES if any(p.series == n for p in points)]:
        colour, dashes, marker = LOOKS.get(name, (HAND, ":", "x"))
        label = BASIS_TITLES.get(name, name)
        handles.append(Line2D([], [], color=colour, ls=dashes, marker=marker, ms=3.4, mfc="none", lw=1.0, label=label))
    handles.append(front_handle())
    if any(not p.ok for p in points):
        cross: dict[str, Any] = {"ls": "", "marker": "x", "ms": 5, "mew": 1.1, "color": UNSTABLE}
        handles.append(Line2D([], [], label="full loop not stable", **cross))
    if paper:
        handles.append(Line2D([], [], label=f"paper, {1e3 * PAPER_SMALL:.0f} ms at N = {PAPER_N}", **LINE))
    return handles


def figure_loop(points: Sequence[LoopPoint], error: float | None, out_png: Path) -> tuple[Path, ...]:
    """Error of the trajectory against time, error in time against the steps, time of a step; PNG and PDF.

    Args:
        error: estimated error of the reference.
    """
    lines = series_of(points)
    gains = list(dict.fromkeys(_gain(p) for p in points))
    colours = {g: GAIN_COLOURS[k % len(GAIN_COLOURS)] for k, g in enumerate(gains)}
    with paper_style():
        figure = plt.figure(figsize=(WIDTH, 4.6), layout="constrained")
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1))
        ax, order, step = (figure.add_subplot(grid[k]) for k in ((slice(None), 0), (0, 1), (1, 1)))
        handles = []
        for k, (name, (first, *rest)) in enumerate(lines.items()):
            line = usable([first, *rest])
            style: dict[str, Any] = {
                "color": colours[_gain(first)], "ls": "--" if first.held else "-",
                "marker": "s" if first.held else "o", "ms": 3.4, "mew": 0.9, "lw": 0.8,
                "mfc": "none" if first.reduced_plant else None,
            }  # fmt: skip
            handles.append(Line2D([], [], label=name, **style))
            ax.plot([p.seconds for p in line], [p.error for p in line], **style)
            if not first.reduced_plant:
                order.plot([p.steps for p in line], [p.error_time for p in line], **style)
            per_step = [p.per_step for p in line]
            if per_step:
                step.plot([min(per_step), max(per_step)], [-k, -k], color=style["color"], lw=0.8)
                step.plot([np.median(per_step)], [-k], **(style | {"ls": ""}))
        draw_front(ax, points)
        axes_log(ax, "time of a run [s]", "relative error of the deformation")
        axes_log(order, "time steps", "error in time")
        _steps_axes(step, list(lines))
        handles += draw_band(ax, error)
        handles.append(front_handle())
        figure.legend(handles=handles, loc="outside upper center", ncols=3)
        return save(figure, out_png)


def _gain(p: LoopPoint) -> tuple[str, int]:
    return p.basis, p.N


def _steps_axes(ax: Any, names: Sequence[str]) -> None:
    """Time of a step of every controller, in the order of the legend."""
    ax.set_xscale("log")
    ax.set_xlabel("time of a step [s]")
    ax.grid(color="#e6e6e6", lw=0.5)
    ax.set_axisbelow(True)
    ax.axvline(TICK, **LINE)
    ax.annotate("1 ms", (TICK, 0.6), (-3, 0), textcoords="offset points", fontsize=6.5, color="#D00000", ha="right")
    ax.set_yticks([-k for k in range(len(names))], names, fontsize=6)
    ax.set_ylim(-len(names) + 0.4, 1.0)
