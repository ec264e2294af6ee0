"""One picture a family of hard cases: softgrasp and the textbook way against the bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from softgrasp.study.hardcases.cases import Family, HardCase, Outcome
from softgrasp.study.pictures.style import BLUE, COLUMN, ORANGE, OUTLINE, WIDTH, paper_style, save

SMALLEST = 1e-17  # smaller numbers, and zero, are drawn here
LARGEST = 1e12  # larger numbers are drawn as none
GAP = 0.6  # [decades] around the numbers
WORDS = 42  # [letters] of a failure that fit beside the frame
SIZE = 4.5  # of a mark


def figure_family(family: Family, rows: Sequence[HardCase], out_png: Path) -> tuple[Path, ...]:
    """Numbers against what is varied, with lanes above for refusals and for what has no number; PNG and PDF."""
    with paper_style():
        draw = _listed if family.axis == "listed" else _curves
        return save(draw(family, rows), out_png)


def _drawn(outcome: Outcome) -> float:
    """Logarithm of the value as it is drawn; NaN for one of the lanes."""
    value = outcome.value
    if outcome.refused or value is None or not math.isfinite(value) or value > LARGEST:
        return math.nan
    return _log(value)


def _log(value: float) -> float:
    return math.log10(max(value, SMALLEST))


def _range(rows: Sequence[HardCase]) -> tuple[float, float]:
    """Decades that hold all numbers and bounds."""
    values = [v for r in rows for o in (r.here, r.textbook) if math.isfinite(v := _drawn(o))]
    values += [_log(r.bound) for r in rows if r.bound is not None]
    return (min(values) - GAP, max(values) + GAP) if values else (-1.0, 1.0)


def _ticks(low: float, high: float, count: int) -> list[int]:
    """Round powers of ten between two, not more than about so many."""
    step = next(s for s in (1, 2, 3, 4, 5, 10, 20, 50, 100, 200, 500) if (high - low) / s <= count)
    return list(range(step * math.ceil(low / step), math.floor(high) + 1, step))


def _positions(family: Family, rows: Sequence[HardCase]) -> tuple[dict[float, float], list[float], list[str]]:
    """Where each varied number stands, and the ticks; zero stands apart on the left of a logarithm."""
    xs = sorted({r.x for r in rows})
    if family.axis == "linear":
        ticks = MaxNLocator(6, integer=True).tick_values(min(xs), max(xs))
        shown = [float(t) for t in ticks if 0 <= t <= 1.05 * max(xs)]
        return {x: x for x in xs}, shown, [f"{t:g}" for t in shown]
    powers = [math.log10(x) for x in xs if x > 0] or [0.0]
    apart = min(powers) - max(1.0, 0.1 * (max(powers) - min(powers)))
    at = {x: math.log10(x) if x > 0 else apart for x in xs}
    whole = _ticks(min(powers) - 0.2, max(powers) + 0.2, 8)
    ticks, names = [float(p) for p in whole], [f"$10^{{{p}}}$" for p in whole]
    return (at, [apart, *ticks], ["0", *names]) if 0.0 in at else (at, ticks, names)


def _curves(family: Family, rows: Sequence[HardCase]) -> Any:
    """Number against varied number; a curve for each group, one for the textbook way."""
    figure, ax = plt.subplots(figsize=(COLUMN + 0.9, 2.9), layout="constrained")
    low, high = _range(rows)
    lane = max(0.6, 0.11 * (high - low))
    lanes = {"no number": high + 0.55 * lane, "refused": high + 1.55 * lane}
    at, ticks, names = _positions(family, rows)
    marks: dict[str, Any] = {}
    groups = list(dict.fromkeys(r.group for r in rows))
    first = {r.x: r for r in reversed(rows)}
    ways = [("textbook", family.textbook, sorted(first.values(), key=lambda r: r.x), ORANGE, "x", "-")]
    for k, group in enumerate(groups):
        own = sorted((r for r in rows if r.group == group), key=lambda r: r.x)
        name = f"here, {group}" if group else "here"
        ways.append(("here", name, own, BLUE, "os"[k % 2], "-" if k == 0 else "--"))
    for way, name, own, colour, marker, line in ways:
        x = [at[r.x] for r in own]
        ax.plot(x, [_drawn(getattr(r, way)) for r in own], color=colour, marker=marker, ms=SIZE, lw=1.0, ls=line)
        for r in own:
            outcome: Outcome = getattr(r, way)
            if math.isnan(_drawn(outcome)):
                height = (
                    lanes["refused" if outcome.refused else "no number"] + (0.12 if way == "textbook" else -0.12) * lane
                )
                ax.plot(at[r.x], height, marker, color=colour, ms=SIZE)
        marks[name] = Line2D([], [], color=colour, marker=marker, ms=SIZE, lw=1.0, ls=line)
    bounds = [(at[r.x], _log(r.bound)) for r in rows if r.bound is not None]
    if bounds:
        ax.plot(*zip(*bounds, strict=True), ls="", marker="_", ms=13, mew=1.6, color=OUTLINE)
        marks["bound"] = Line2D([], [], color=OUTLINE, lw=1.6)
    powers = _ticks(low, high - 0.03 * (high - low), 7)
    ax.set_yticks([*powers, *lanes.values()], [*(f"$10^{{{p}}}$" for p in powers), *lanes.keys()])
    ax.set_ylim(low, high + 2.1 * lane)
    ax.axhline(high, color="#bbbbbb", lw=0.6)
    ax.set_xticks(ticks, names)
    span = max(at.values()) - min(at.values()) or 1.0
    ax.set_xlim(min(at.values()) - 0.06 * span, max(at.values()) + 0.06 * span)
    ax.set_xlabel(family.varied)
    ax.set_ylabel(family.quantity)
    shown = sorted(marks, key=lambda name: (name == "bound", not name.startswith("here")))
    figure.legend(
        [marks[n] for n in shown], shown, loc="outside upper left", ncols=2, handlelength=1.6, columnspacing=1.2
    )
    return figure


def _listed(family: Family, rows: Sequence[HardCase]) -> Any:
    """One line a case; numbers to the right, on a logarithm when some of them are small."""
    figure, ax = plt.subplots(figsize=(WIDTH, 0.95 + 0.33 * len(rows)), layout="constrained")
    values = [v for r in rows for v in (r.here.value, r.textbook.value, r.bound) if v is not None and math.isfinite(v)]
    scaled = min((v for v in values if v > 0), default=1.0) < 1e-2
    if scaled:
        low, high = _range(rows)
    else:
        low, high = -0.03 * max([*values, 1.0]), 1.03 * max([*values, 1.0])
    span = high - low
    for i, row in enumerate(rows):
        if row.bound is not None:
            at = _log(row.bound) if scaled else row.bound
            ax.plot([at, at], [i - 0.36, i + 0.36], color=OUTLINE, lw=1.6)
        for outcome, colour, marker, shift in ((row.here, BLUE, "o", -0.2), (row.textbook, ORANGE, "x", 0.2)):
            place = _drawn(outcome)
            if not scaled and math.isfinite(place):
                place = outcome.value or 0.0
            missing = math.isnan(place)
            ax.plot(high + 0.05 * span if missing else place, i + shift, marker, color=colour, ms=SIZE, clip_on=False)
            if missing:
                word = "refused" if outcome.refused else outcome.text[:WORDS]
                ax.text(high + 0.08 * span, i + shift, word, color=colour, fontsize=6.5, va="center")
    ax.set_yticks(range(len(rows)), [row.case for row in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(low, high + 0.62 * span)
    if scaled:
        powers = _ticks(low, high, 8)
        ax.set_xticks(powers, [f"$10^{{{p}}}$" for p in powers])
    else:
        ax.set_xticks([t for t in MaxNLocator(6).tick_values(0, high) if 0 <= t <= high])
    for i in np.arange(len(rows) - 1) + 0.5:
        ax.axhline(i, color="#eeeeee", lw=0.6, zorder=0)
    ax.axvline(high, color="#bbbbbb", lw=0.6)
    ax.set_xlabel(family.quantity, loc="left")
    marks = {
        "here": Line2D([], [], color=BLUE, marker="o", ms=SIZE, ls=""),
        family.textbook: Line2D([], [], color=ORANGE, marker="x", ms=SIZE, ls=""),
        "bound": Line2D([], [], color=OUTLINE, lw=1.6),
    }
    figure.legend(marks.values(), marks.keys(), loc="outside upper left", ncols=3, handlelength=1.6)
    return figure
