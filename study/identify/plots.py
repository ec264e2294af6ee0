"""Figures of ``softgrasp identify``: data over fit with residuals, ellipses of pairs, history."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from softgrasp.reduction.identify.result import Identified
from softgrasp.study.pictures import (
    BLUE,
    COLUMN,
    CYCLE,
    GREEN,
    HAND,
    ORANGE,
    PURPLE,
    WIDTH,
    length_unit,
    paper_style,
    save,
)
from softgrasp.study.pictures.style import SKY

MOST_EXPERIMENTS, MOST_PAIRS = 3, 6  # that are drawn
RADII = (1.515, 2.448)  # of ellipses that hold 68 and 95 % of two normal values
FRAME = 3.2  # half width of the frame of an ellipse, in standard deviations, at least
WIDEST = 8.0  # at most: parts beyond are cut
COLOURS = {"mesh": ORANGE, "time step": GREEN, "reduction": PURPLE, "linear elasticity": SKY}


def draw(answer: Identified, out: Path) -> list[Path]:
    """All figures. Not collective."""
    with paper_style():
        files = [*_fit(answer, out / "fit.png")]
        if len(answer.unknowns) > 1:
            files += _ellipses(answer, out / "ellipses.png")
        return [*files, *_history(answer, out / "history.png")]


def _fit(answer: Identified, file: Path) -> tuple[Path, ...]:
    many = min(len(answer.data), MOST_EXPERIMENTS)
    figure, axes = plt.subplots(
        2, many, figsize=(WIDTH if many > 1 else COLUMN + 1.8, 3.8), sharex="col", squeeze=False, layout="constrained",
        height_ratios=[1.5, 1],
    )  # fmt: skip
    largest = max(float(np.nanmax(np.abs(d.values))) for d in answer.data)
    factor, unit = length_unit(largest)
    for n, (data, fitted) in enumerate(zip(answer.data[:many], answer.fitted[:many], strict=True)):
        top, below = axes[:, n]
        below.axhspan(-1.96, 1.96, color="#e6e6e6", lw=0)
        for j, column in enumerate(answer.columns):
            seen, colour = np.isfinite(data.values[:, j]), CYCLE[j % len(CYCLE)]
            if not seen.any():
                continue
            scale = 1.0 if column.rotation else factor
            t, y, z = data.times[seen], data.values[seen, j], fitted[seen, j]
            top.plot(t, scale * y, ".", ms=2.5, alpha=0.5, color=colour, mew=0)
            name = f"{column.label} [rad]" if column.rotation else column.label
            top.plot(t, scale * z, color=colour, label=name)
            below.plot(t, (z - y) / answer.sigma[j], ".", ms=2.0, color=colour, mew=0)
        top.set_title(data.name, loc="left")
        below.set_xlabel("time [s]")
    axes[0, 0].set_ylabel(f"output [{unit}]")
    axes[1, 0].set_ylabel("residual [sigma]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=6)
    return save(figure, file)


def _ellipses(answer: Identified, file: Path) -> tuple[Path, ...]:
    pairs = list(combinations(range(len(answer.unknowns)), 2))[:MOST_PAIRS]
    wide = min(len(pairs), 3)
    rows = -(-len(pairs) // wide)
    figure, axes = plt.subplots(
        rows, wide, figsize=(0.2 + 2.3 * wide, 0.5 + 2.1 * rows), squeeze=False, layout="constrained"
    )
    for ax in axes.flat[len(pairs) :]:
        ax.set_visible(False)
    for ax, (i, j) in zip(axes.flat, pairs, strict=False):
        _ellipse(ax, answer, i, j)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=5 if len(handles) < 6 else 3)
    return save(figure, file)


def _ellipse(ax: Any, answer: Identified, i: int, j: int) -> None:
    """Noise around the answer at zero, and arrows to where the truth would be without each part."""
    pick = [i, j]
    values, vectors = np.linalg.eigh(answer.covariance[np.ix_(pick, pick)])
    angle = np.linspace(0, 2 * np.pi, 200)
    unit = 100 * vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * np.array([np.cos(angle), np.sin(angle)]))
    for radius, look in zip(RADII, ("-", "--"), strict=True):
        ax.plot(*(radius * unit), color=BLUE, ls=look, lw=1.0, label="noise, 68 %" if look == "-" else "95 %")
    ax.plot(0, 0, "+", color=HAND, ms=6)
    sigma, reach = 100 * answer.noise[pick], np.full(2, FRAME)
    parts = {name: -100 * part[pick] for name, part in answer.parts.items() if part is not None}
    for part in parts.values():
        reach = np.maximum(reach, np.minimum(1.15 * np.abs(part) / sigma, WIDEST))
    for name, part in parts.items():
        cut = min(1.0, float((reach * sigma / np.maximum(np.abs(part), 1e-300)).min()))
        ax.plot(*(np.outer(part, [0, cut])), color=COLOURS[name], lw=1.3, label=name)
        if cut == 1.0:
            ax.plot(*part, ".", color=COLOURS[name], ms=5)
    ax.set(xlim=(-reach[0] * sigma[0], reach[0] * sigma[0]), ylim=(-reach[1] * sigma[1], reach[1] * sigma[1]))
    ax.set(xlabel=f"{answer.unknowns[i].name} [%]", ylabel=f"{answer.unknowns[j].name} [%]")
    ax.axhline(0, color="#dddddd", lw=0.5, zorder=0)
    ax.axvline(0, color="#dddddd", lw=0.5, zorder=0)


def _history(answer: Identified, file: Path) -> tuple[Path, ...]:
    figure, ax = plt.subplots(figsize=(COLUMN, 2.2), layout="constrained")
    table = np.array(answer.history)
    for k, u in enumerate(answer.unknowns):
        ax.plot(table[:, k] / table[-1, k], marker="o", ms=3, color=CYCLE[k % len(CYCLE)], label=u.name)
    ax.set(xlabel="round", ylabel="value over the final one", xticks=range(len(table)))
    ax.legend(loc="best")
    return save(figure, file)
