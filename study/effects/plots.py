"""Change against cost of every effect, in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from softgrasp.study.effects.result import Change, Cost, Finding
from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, OUTLINE, STEPS, WIDTH, paper_style, save

MANY = 1.0  # added share of a cost from which the axis is logarithmic beyond 10 %
COLOURS = {"needed": GREEN, "optional": BLUE, "wasted": ORANGE}
BAND = "#e4e4e4"
ROUNDING = 1e-15  # a smaller change is drawn as none
ROW, BELOW = 0.34, 0.8  # [inch]


Tried = tuple[Finding, Change, Cost]


def figure_effects(
    findings: Sequence[Finding], tolerance: float, noise: tuple[float, float], out_png: Path
) -> tuple[Path, ...]:
    """Each effect in a row: what it changes on the left, what it costs on the right; PNG and PDF."""
    marks = [(f, f.change, f.cost) for f in findings if f.change is not None and f.cost is not None]
    with paper_style():
        height = ROW * len(marks)
        size = (WIDTH, height + BELOW + 0.25)
        figure = plt.figure(figsize=size)
        axes = [
            figure.add_axes((x / size[0], BELOW / size[1], w / size[0], height / size[1]))
            for x, w in ((1.1, 2.6), (3.95, 1.85))
        ]
        axes[1].tick_params(labelleft=False)
        rows = np.arange(len(marks))[::-1]
        _changes(axes[0], marks, rows, tolerance)
        _costs(axes[1], marks, rows, noise)
        axes[0].set_yticks(rows, [f"{f.name} ({'on' if f.on else 'off'})" for f, _, _ in marks])
        for ax in axes:
            ax.set_ylim(-0.6, len(marks) - 0.4)
            ax.tick_params(axis="y", length=0)
            ax.spines["left"].set_visible(False)
            for row in rows:
                ax.axhline(row, color="#eeeeee", lw=0.8, zorder=0)
        return save(figure, out_png)


def _changes(ax: Any, marks: Sequence[Tried], rows: Any, tolerance: float) -> None:
    values = [v for f, c, _ in marks for v in (c.outputs, f.control, f.together) if v is not None and v > ROUNDING]
    low, high = min([*values, tolerance]), max([*values, tolerance])
    left = 10.0 ** (np.floor(np.log10(low)) - 1)  # a decade for those that change nothing
    nothing = 1.5 * left
    for (mark, change, _), row in zip(marks, rows, strict=True):
        colour = COLOURS[mark.verdict]
        look: dict[str, Any] = {"color": colour, "mfc": colour if mark.on else "white", "mew": 1.3, "ls": "none"}
        if mark.control is not None and mark.control > ROUNDING:
            ax.plot(mark.control, row, marker="D", ms=4.5, zorder=2, **look)
        if mark.together is not None:
            ax.plot(mark.together, row, marker="^", ms=6, zorder=2, **look)
        if change.outputs > ROUNDING:
            ax.plot(change.outputs, row, marker="o", ms=7, zorder=3, **look)
        else:
            ax.plot(nothing, row, marker="<", ms=6.5, zorder=3, **look)
            ax.annotate("none", (nothing, row), (7, 0), textcoords="offset points", va="center", color=OUTLINE)
    ax.axvline(tolerance, color=HAND, lw=0.9, ls=(0, (4, 3)), zorder=1)
    ax.annotate(
        f"tolerance {tolerance:g}", (tolerance, 1.0), (0, 2), xycoords=("data", "axes fraction"),
        textcoords="offset points", ha="center", va="bottom", color=HAND,
    )  # fmt: skip
    ax.set_xscale("log")
    ax.set_xlim(left, 3 * high)
    ax.xaxis.set_major_locator(LogLocator(numticks=6))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("relative change of the outputs")
    entries = [_grey("this run", "o", 6)]
    if any(f.control is not None and f.control > ROUNDING for f, _, _ in marks):
        entries.append(_grey("under a force", "D", 4.5))
    if any(f.together is not None for f, _, _ in marks):
        entries.append(_grey("with a partner", "^", 6))
    if not all(f.on for f, _, _ in marks):
        entries.append(_grey("off, tried", "o", 6, mfc="white"))
    _legend(ax, entries)


def _costs(ax: Any, marks: Sequence[Tried], rows: Any, noise: tuple[float, float]) -> None:
    ax.axvspan(100 * min(noise[0], 0.0), 100 * max(noise[1], 0.0), color=BAND, lw=0, zorder=0)
    for (mark, _, cost), row in zip(marks, rows, strict=True):
        colour = COLOURS[mark.verdict]
        face = colour if mark.on else "white"
        low, high = cost.step_quartiles
        error = 100 * np.array([[cost.step_relative - low], [high - cost.step_relative]])
        ax.errorbar(
            100 * cost.step_relative, row + 0.13, xerr=error, fmt="o", ms=5.5, color=colour, mfc=face,
            mew=1.3, elinewidth=0.8,
            capsize=2, zorder=3,
        )  # fmt: skip
        ax.plot(100 * cost.memory_relative, row - 0.17, marker="s", ms=4.5, color=colour, mfc=face, mew=1.3, zorder=3)
        ax.annotate(
            mark.label, (1.02, row), xycoords=("axes fraction", "data"), va="center", color=colour, weight="bold"
        )
    ax.axvline(0.0, color=HAND, lw=0.7, zorder=1)
    if max(max(cost.step_relative, cost.memory_relative) for _, _, cost in marks) > MANY:
        ax.set_xscale("symlog", linthresh=10.0)
        ax.xaxis.set_major_formatter("{x:g}")
        ax.tick_params(axis="x", labelsize=6)
    else:
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=STEPS))
    ax.margins(x=0.08)
    ax.set_xlabel("added cost [%]")
    entries = [_grey("time of a step", "o", 5.5), _grey("memory", "s", 4.5)]
    _legend(ax, [*entries, Patch(color=BAND, label="noise of the time")])


def _grey(label: str, marker: str, size: float, **look: Any) -> Any:
    return Line2D([], [], marker=marker, ms=size, label=label, color=OUTLINE, ls="none", mew=1.3, **look)


def _legend(ax: Any, entries: list[Any]) -> None:
    below = -0.52 / (ax.get_position().height * ax.figure.get_figheight())
    ax.legend(
        handles=entries, loc="upper left", bbox_to_anchor=(-0.1, below),
        ncols=len(entries) if len(entries) < 4 else 2, handlelength=1.2, columnspacing=1.2, borderaxespad=0.0,
    )  # fmt: skip
