"""Figures of a closed loop: outputs and inputs against time, the move to the target, decay rates.

Everything comes in as arrays; nothing here computes a simulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from softgrasp.fem.columns import AXES, Array, Columns, farthest
from softgrasp.fem.fields.picture import PictureMesh
from softgrasp.study.pictures.body import figure_move
from softgrasp.study.pictures.shapes import pick_instants
from softgrasp.study.pictures.style import (
    COLUMN,
    CYCLE,
    OUTLINE,
    SKY,
    TARGET,
    WIDTH,
    few_ticks,
    length_unit,
    paper_style,
    save,
)

Poles = npt.NDArray[np.complex128]

COLOURS = (*CYCLE, "#E69F00", SKY, "#7f7f7f", "#000000", "#8c564b")  # a hand and a node in space: six
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "^", "s", "D", "v", "P")
FLOOR = 1e-16  # smallest distance to the target that a double of order one can show
MANY_POINTS = 4000  # a line of more points is thinned, in print they coincide


def figure_histories(
    times: Array,
    outputs: Array,
    inputs: Array,
    columns: Columns,
    out_png: Path,
    *,
    target: npt.ArrayLike | None = None,
    limits: npt.ArrayLike | None = None,
    others: Mapping[str, tuple[Array, Array]] | None = None,
    settle: float | None = None,
    dimension: int | None = None,
) -> tuple[Path, ...]:
    """Outputs, their distance to the target, and inputs against time; PNG and PDF.

    Args:
        times: grid, shape (m + 1,) [s].
        outputs: shape (m + 1, p) [m, rad].
        inputs: constant in each step, shape (m, n_s) [N, N m].
        columns: one per output; rotations get axes of their own.
        out_png: name of the picture; the PDF gets its stem.
        target: outputs aimed at, shape (p,).
        limits: bounds on the inputs, shape (n_s,); drawn when finite.
        others: outputs and inputs of other runs on the same grid by name, drawn thin.
        settle: end of the time axis of outputs and inputs [s]; the distance keeps the whole run.
        dimension: inputs from this number on are torques; default all are forces.

    Returns:
        Names of PNG and PDF.
    """
    aim = None if target is None else np.asarray(target, dtype=np.float64)
    d = inputs.shape[1] if dimension is None else min(dimension, inputs.shape[1])
    runs = {"": (outputs, inputs), **(others or {})}
    angles = [j for j, column in enumerate(columns) if column.rotation]
    lengths = [j for j in range(outputs.shape[1]) if j not in angles]
    panels = [p for p in (lengths, angles) if p]
    first = len(panels)
    rows = first + 1 + (aim is not None) + (d < inputs.shape[1])
    unit = length_unit(float(np.abs(outputs[:, lengths]).max(initial=0.0)))
    with paper_style():
        figure, axes = plt.subplots(rows, 1, figsize=(WIDTH * 0.8, 1.15 + 1.5 * rows), layout="constrained")
        for number, (y, u) in enumerate(runs.values()):
            look: dict[str, Any] = {
                "ls": STYLES[number % len(STYLES)],
                "lw": 2.6 if number == 0 else 1.0,
                "alpha": 0.45 if number == 0 else 1.0,
            }
            for ax, part in zip(axes, panels, strict=False):
                _lines(ax, times, (unit[0] if part is lengths else 1.0) * y[:, part], look)
            _steps(axes[first], times, u[:, :d], look)
            if d < u.shape[1]:
                _steps(axes[first + 1], times, u[:, d:], look)
            if aim is not None:
                # the last swings have no later ones to be compared with
                keep = slice(0, max(2, int(0.97 * len(times))), _thin(len(times)).step)
                axes[-1].semilogy(times[keep], still_to_come(y, aim, columns)[keep], color=OUTLINE, **look)
        if aim is not None:
            for ax, part in zip(axes, panels, strict=False):
                for value in dict.fromkeys(aim[part].tolist()):
                    height = (unit[0] if part is lengths else 1.0) * value
                    ax.axhline(height, color=TARGET, lw=1.0, ls=(0, (1, 1.2)), zorder=0)
            axes[-1].set_ylabel("distance to target,\nlargest from then on [m]")
        bounds = np.broadcast_to(np.asarray(np.inf if limits is None else limits, dtype=np.float64), inputs.shape[1:])
        _limits(axes[first], bounds, slice(0, d))
        if d < inputs.shape[1]:
            _limits(axes[first + 1], bounds, slice(d, None))
        for ax, part in zip(axes, panels, strict=False):
            ax.set_ylabel(f"outputs [{unit[1]}]" if part is lengths else "rotation [rad]")
        axes[first].set_ylabel("force [N]")
        if d < inputs.shape[1]:
            axes[first + 1].set_ylabel("torque [N m]")
        whole = axes[-1:] if aim is not None else []
        for ax in axes:
            ax.set_xlim(0.0, float(times[-1]) if settle is None or ax in whole else min(settle, float(times[-1])))
        axes[-1].set_xlabel("time [s]")
        if aim is not None:
            axes[-2].set_xlabel("time [s], the move only")
        labels = [[columns[j].formula for j in part] for part in panels]
        _legends(axes, labels, inputs.shape[1], d, list(runs), aim is not None)
        return save(figure, out_png)


def still_to_come(outputs: Array, target: Array, columns: Columns = ()) -> Array:
    """Largest distance from each instant on: how well the outputs have settled, without the swings. Shape (m,).

    Args and distance as in :func:`softgrasp.fem.columns.farthest`.
    """
    distance = np.maximum(farthest(outputs, target, columns), FLOOR)
    return np.asarray(np.maximum.accumulate(distance[::-1])[::-1])


def _thin(count: int) -> slice:
    return slice(None, None, max(1, count // MANY_POINTS))


def _lines(ax: Any, times: Array, values: Array, look: dict[str, Any]) -> None:
    keep = _thin(len(times))
    for j, column in enumerate(values.T):
        ax.plot(times[keep], column[keep], color=COLOURS[j % len(COLOURS)], **look)


def _steps(ax: Any, times: Array, values: Array, look: dict[str, Any]) -> None:
    """Inputs are constant within a step; the last value is repeated to close it."""
    keep = _thin(len(values))
    shown = np.vstack([values[keep], values[-1:]])
    at = np.append(times[:-1][keep], times[-1])
    for j, column in enumerate(shown.T):
        ax.step(at, column, where="post", color=CYCLE[j % len(CYCLE)], **look)


def _limits(ax: Any, limits: Array, part: slice) -> None:
    for bound in {float(b) for b in limits[part] if np.isfinite(b)}:
        for value in (-bound, bound):
            ax.axhline(value, color="#999999", lw=0.8, ls=(0, (4, 2)), zorder=0)
        ax.margins(y=0.08)


def _legends(axes: Any, names: list[list[str]], inputs: int, d: int, runs: list[str], aimed: bool) -> None:
    """Colours name components, line styles name runs; beside the axes, where they hide nothing."""
    place: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "handlelength": 1.6}

    def colours(labels: list[str]) -> list[Line2D]:
        return [Line2D([], [], color=COLOURS[j % len(COLOURS)], label=label) for j, label in enumerate(labels)]

    for ax, part in zip(axes, names, strict=False):
        shown = colours(part)
        if aimed:
            shown.append(Line2D([], [], color=TARGET, lw=1.0, ls=(0, (1, 1.2)), label="target"))
        ax.legend(handles=shown, **place)
    first = len(names)
    axes[first].legend(handles=colours([f"$u_{AXES[j] if d <= len(AXES) else j + 1}$" for j in range(d)]), **place)
    if d < inputs:
        about = ["z"] if inputs - d == 1 else [*AXES, *map(str, range(4, inputs - d + 1))]
        axes[first + 1].legend(handles=colours([f"torque, ${a}$" for a in about[: inputs - d]]), **place)
    if len(runs) > 1:
        entries = [
            Line2D([], [], color=OUTLINE, ls=STYLES[i % len(STYLES)], label=name or "full order")
            for i, name in enumerate(runs)
        ]
        axes[-1].legend(handles=entries, **(place if aimed else {**place, "bbox_to_anchor": (1.0, 0.5)}))


def figure_loop_move(
    picture: PictureMesh,
    states: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    out_png: Path,
) -> tuple[Path, ...]:
    """The body at a few instants of the move to the target, at equal steps along the path of the hand; PNG and PDF.

    Args and return value as in :func:`softgrasp.study.pictures.body.figure_move`, with as many states as there are.
    """
    chosen = pick_instants(picture, np.asarray(states, dtype=np.float64), times, table)
    return figure_move(picture, np.asarray(states)[chosen], np.asarray(times)[chosen], table, target, out_png)


def figure_decay(
    poles: Mapping[str, Poles],
    out_png: Path,
    *,
    noise: float = 0.0,
) -> tuple[Path, ...]:
    """Decay rate -Re p of every pole against its frequency |Im p|, one mark a plant or gain; PNG and PDF.

    Poles on the real axis stand in a strip at the left; poles that do not decay are drawn as crosses on the lower edge
    and counted in the legend.

    Args:
        poles: by name, complex arrays of any length, both or one of each conjugate pair [1/s].
        out_png: name of the picture; the PDF gets its stem.
        noise: rates below it are rounding and count as no decay [1/s].

    Returns:
        Names of PNG and PDF.
    """
    sets = {name: np.asarray(p, dtype=np.complex128).ravel() for name, p in poles.items()}
    together = np.concatenate(list(sets.values())) if sets else np.zeros(0, dtype=np.complex128)
    size = np.abs(together)
    swings = np.abs(together.imag) > 1e-9 * np.maximum(size, 1e-300)
    decays = -together.real > noise
    rates, frequencies = -together.real[decays], np.abs(together.imag[swings])
    low, high = (rates.min() / 2, rates.max() * 2) if len(rates) else (0.1, 10.0)
    left, right = (frequencies.min(), frequencies.max()) if len(frequencies) else (1.0, 10.0)
    axis_strip = left / 2.5
    with paper_style():
        figure, ax = plt.subplots(figsize=(COLUMN + 1, 3.3), layout="constrained")
        for i, (name, p) in enumerate(sets.items()):
            x = np.where(np.abs(p.imag) > 1e-9 * np.abs(p), np.abs(p.imag), axis_strip)
            fine = -p.real > noise
            colour = CYCLE[i % len(CYCLE)]
            lost = int((~fine).sum())
            label = name if lost == 0 else f"{name} ({lost} without decay)"
            look: dict[str, Any] = {"marker": MARKERS[i % len(MARKERS)], "ms": 3.6, "mew": 0.8, "mfc": "none"}
            ax.plot(x[fine], -p.real[fine], ls="", color=colour, label=label, **look)
            ax.plot(x[~fine], np.full((~fine).sum(), low), "x", color=colour, ms=4.5, mew=1.0, clip_on=False)
        ax.set(xscale="log", yscale="log", ylim=(low, high), xlim=(axis_strip / 1.4, right * 1.3))
        if not swings.all():
            ax.axvline(np.sqrt(axis_strip * left), color="#bbbbbb", lw=0.6)
            ax.text(axis_strip, high, "real", ha="center", va="bottom", fontsize=8, color=OUTLINE)
        ax.set_xlabel(r"frequency $|\mathrm{Im}\,p|$ [1/s]")
        ax.set_ylabel(r"decay rate $-\mathrm{Re}\,p$ [1/s]")
        few_ticks(ax.xaxis)
        few_ticks(ax.yaxis)
        figure.legend(loc="outside upper center", ncols=2, columnspacing=1.2, handletextpad=0.2)
        return save(figure, out_png)
