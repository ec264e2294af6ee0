"""Pictures of sweeps and of two runs beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from softgrasp.study.pictures import BLUE, COLUMN, CYCLE, OUTLINE, colour_map, few_ticks, paper_style, save
from softgrasp.study.report import Table
from softgrasp.study.runs.sweep import DECADE, SweepAxis, SweepPoint, axis_label

BARS = 16  # numbers that a picture of two runs shows: the largest changes
PANELS = 4  # outputs of a picture


def figure_sweep(axes: Sequence[SweepAxis], points: Sequence[SweepPoint], file: Path) -> tuple[Path, ...]:
    """Lag of every output against the first key, one curve a value of the second."""
    names = list(next(p for p in points if not p.reason).lags())[:PANELS]
    first, second = axes[0], axes[1] if len(axes) > 1 else None
    curves = [(None, BLUE)] if second is None else [
        (v, CYCLE[i] if len(second.values) <= len(CYCLE) else colour_map()(i / (len(second.values) - 1)))
        for i, v in enumerate(second.values)
    ]  # fmt: skip
    with paper_style():
        figure, panels = plt.subplots(
            len(names), 1, figsize=(COLUMN, 0.5 + 1.6 * len(names)), sharex=True, layout="constrained", squeeze=False
        )
        for axis, name in zip(panels[:, 0], names, strict=True):
            for value, colour in curves:
                shown = [p for p in points if second is None or p.values[second.key] == value]
                y = [p.lags().get(name, np.nan) for p in shown]
                label = None if second is None else f"{axis_label(second.key)} = {value:.4g}"
                axis.plot([p.values[first.key] for p in shown], y, ".-", color=colour, label=label)
            axis.set_ylabel(name.replace(" lag ", ", largest lag\nbehind the rigid motion "))
            lags = [p.lags()[name] for p in points if not p.reason]
            if min(lags) > 0 and max(lags) >= DECADE * min(lags):
                axis.set_yscale("log")
                few_ticks(axis.yaxis)
        panels[-1, 0].set_xlabel(f"{first.key.rpartition('.')[0]}.{axis_label(first.key)}".lstrip("."))
        if first.log:
            panels[-1, 0].set_xscale("log")
            few_ticks(panels[-1, 0].xaxis)
        if second is not None:
            panels[0, 0].legend()
        return save(figure, file)


def figure_two(
    names: Sequence[str], a: np.ndarray, b: np.ndarray, runs: tuple[str, str], file: Path
) -> tuple[Path, ...]:
    """Trajectories of two runs, and below B - A where both have times."""
    outputs = [i for i, name in enumerate(names) if i and not name.startswith(("hand", "force"))] or [1]
    t = a[(a[:, 0] <= b[-1, 0]) & (a[:, 0] >= b[0, 0]), 0]
    with paper_style():
        figure, (top, below) = plt.subplots(2, 1, figsize=(COLUMN, 3.6), sharex=True, layout="constrained")
        for i, colour in zip(outputs, CYCLE, strict=False):
            label = names[i].split(" [")[0]
            top.plot(a[:, 0], a[:, i], color=colour, label=f"{label}, A")
            top.plot(b[:, 0], b[:, i], "--", color=colour, label=f"{label}, B")
            difference = np.interp(t, b[:, 0], b[:, i]) - np.interp(t, a[:, 0], a[:, i])
            below.plot(t, difference, color=colour, label=label)
        top.set_ylabel(f"outputs [{names[outputs[0]].split('[')[1]}")
        top.set_title(f"A: {runs[0]}\nB: {runs[1]}", loc="left")
        below.axhline(0, color=OUTLINE, lw=0.5, zorder=0)
        below.set(xlabel="t [s]", ylabel=f"B - A [{names[outputs[0]].split('[')[1]}")
        top.legend(ncols=2)
        return save(figure, file)


def figure_numbers(numbers: Table, runs: tuple[str, str], file: Path) -> tuple[Path, ...]:
    """B / A of the numbers that changed most, on a logarithmic axis."""
    ratios = [(name, y / x) for name, x, y, _ in numbers.rows if x and y / x > 0]
    ratios = sorted(ratios, key=lambda pair: -abs(np.log(pair[1])))[:BARS][::-1]
    with paper_style():
        figure, axis = plt.subplots(figsize=(COLUMN, 0.8 + 0.2 * len(ratios)), layout="constrained")
        axis.hlines(range(len(ratios)), 1, [r for _, r in ratios], color=OUTLINE, lw=0.7)
        axis.plot([r for _, r in ratios], range(len(ratios)), "o", ms=4, color=BLUE)
        axis.axvline(1, color=OUTLINE, lw=0.7)
        axis.set_yticks(range(len(ratios)), [name for name, _ in ratios])
        axis.set(xscale="log", xlabel=f"B / A\nA: {runs[0]}\nB: {runs[1]}")
        return save(figure, file)
