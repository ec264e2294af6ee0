"""Figures of a closed loop: outputs and inputs against time, the move to the target, decay rates.

Everything comes in as arrays; nothing here computes a simulation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, cycle
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.lines import Line2D

from softgrasp.fem import AXES, Array, Columns, farthest
from softgrasp.study.pictures import style
from softgrasp.study.pictures.style import few_ticks, length_unit, paper_style, save

Poles = npt.NDArray[np.complex128]
Runs = Mapping[str, tuple[Array, Array]]
COLOURS = (*style.CYCLE, "#E69F00", style.SKY, "#7f7f7f", "#000000", "#8c564b")  # a hand and a node in space: six
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "^", "s", "D", "v", "P")
NEAREST = 1e-16  # smallest distance to the target that a double of order one can show
BESIDE: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "handlelength": 1.6}  # hides nothing
AIM: dict[str, Any] = {"color": style.TARGET, "lw": 1.0, "ls": (0, (1, 1.2))}
LIMIT: dict[str, Any] = {"color": "#999999", "lw": 0.8, "ls": (0, (4, 2))}
MANY_POINTS = 4000  # a line of more points is thinned, in print they coincide


@dataclass(frozen=True)
class _Panel:
    """One pair of axes with the same quantities of every run."""

    label: str  # label of the axis
    values: Sequence[Array]  # of each run, (m + 1, names) for outputs, (m, names) for inputs
    names: Sequence[str]  # of the colours
    levels: Sequence[float]  # targets of outputs, limits of inputs
    inputs: bool = False  # whether the curves are inputs


def histories(
    times: Array,
    outputs: Array,
    inputs: Array,
    columns: Columns,
    *,
    target: npt.ArrayLike | None = None,
    limits: npt.ArrayLike | None = None,
    others: Mapping[str, tuple[Array, Array]] | None = None,
    settle: float | None = None,
    dimension: int | None = None,
) -> Any:
    """Outputs, their distance to the target, and inputs against time; a Matplotlib figure.

    Args:
        times: grid, shape (m + 1,) [s].
        outputs: shape (m + 1, p) [m, rad]; rotations get axes of their own.
        inputs: constant in each step, shape (m, n_s) [N, N m].
        columns: one per output.
        target: outputs aimed at, shape (p,).
        limits: bounds on the inputs, shape (n_s,); drawn when finite.
        others: outputs and inputs of other runs on the same grid by name, drawn thin.
        settle: end of the time axis of outputs and inputs [s]; the distance keeps the whole run.
        dimension: inputs from this number on are torques; default all are forces.
    """
    runs = {"full order": (outputs, inputs), **(others or {})}
    aim = None if target is None else np.asarray(target, dtype=np.float64)
    panels = [*_output_panels(runs, columns, aim), *_input_panels(runs, limits, dimension)]
    with paper_style():
        rows = len(panels) + (aim is not None)
        figure, axes = plt.subplots(rows, 1, figsize=(style.WIDTH * 0.8, 1.15 + 1.5 * rows), layout="constrained")
        for ax, panel in zip(axes, panels, strict=False):
            for look, values in zip(_looks(), panel.values, strict=False):
                _lines(ax, times, values, look)
            ax.set_ylabel(panel.label)
            ax.set_xlim(0.0, float(times[-1]) if settle is None else min(settle, float(times[-1])))
            shown = zip(cycle(COLOURS), panel.names, strict=False)
            entries = [Line2D([], [], color=colour, label=name) for colour, name in shown]
            for level in panel.levels:
                ax.axhline(level, zorder=0, **(LIMIT if panel.inputs else AIM))
            if panel.levels and panel.inputs:
                ax.margins(y=0.08)
            elif panel.levels:
                entries.append(Line2D([], [], label="target", **AIM))
            ax.legend(handles=entries, **BESIDE)
        if aim is not None:
            # the last swings have no later ones to be compared with
            keep = slice(0, max(2, int(0.97 * len(times))), _every(len(times)))
            for look, (y, _) in zip(_looks(), runs.values(), strict=False):
                axes[-1].semilogy(times[keep], settling_distance(y, aim, columns)[keep], color=style.OUTLINE, **look)
            axes[-1].set_ylabel("distance to target,\nlargest from then on [m]")
            axes[-1].set_xlim(0.0, float(times[-1]))
            axes[-2].set_xlabel("time [s], the move only")
        axes[-1].set_xlabel("time [s]")
        if len(runs) > 1:
            shown = zip(cycle(STYLES), runs, strict=False)
            entries = [Line2D([], [], color=style.OUTLINE, ls=dashes, label=name) for dashes, name in shown]
            axes[-1].legend(
                handles=entries, **(BESIDE if aim is not None else {**BESIDE, "bbox_to_anchor": (1.0, 0.5)})
            )
        return figure


def _output_panels(runs: Runs, columns: Columns, aim: Array | None) -> list[_Panel]:
    parts = [[j for j, column in enumerate(columns) if column.rotation == turns] for turns in (False, True)]
    factor, unit = length_unit(float(np.abs(next(iter(runs.values()))[0][:, parts[0]]).max(initial=0.0)))
    scaled = ((f"outputs [{unit}]", factor, parts[0]), ("rotation [rad]", 1.0, parts[1]))
    return [
        _Panel(
            label, [scale * y[:, part] for y, _ in runs.values()], [columns[j].title for j in part],
            () if aim is None else [scale * value for value in dict.fromkeys(aim[part].tolist())],
        )
        for label, scale, part in scaled if part
    ]  # fmt: skip


def _input_panels(runs: Runs, limits: npt.ArrayLike | None, dimension: int | None) -> list[_Panel]:
    n = next(iter(runs.values()))[1].shape[1]
    d = n if dimension is None else min(dimension, n)
    bounds = np.broadcast_to(np.asarray(np.inf if limits is None else limits, dtype=np.float64), n)
    forces = [f"force, {AXES[j] if d <= len(AXES) else j + 1}" for j in range(d)]
    about = ["z"] if n - d == 1 else [*AXES, *map(str, range(4, n - d + 1))]
    torques = [f"torque, {a}" for a in about[: n - d]]
    parts = (("force [N]", slice(0, d), forces), ("torque [N m]", slice(d, n), torques))
    return [
        _Panel(
            label, [u[:, part] for _, u in runs.values()], names,
            [sign * b for b in {float(b) for b in bounds[part] if np.isfinite(b)} for sign in (-1, 1)], inputs=True,
        )
        for label, part, names in parts if names
    ]  # fmt: skip


def _looks() -> Iterator[dict[str, Any]]:
    """Lines of the first run, thick and pale, and of the others over it."""
    yield {"ls": STYLES[0], "lw": 2.6, "alpha": 0.45}
    for number in count(1):
        yield {"ls": STYLES[number % len(STYLES)], "lw": 1.0, "alpha": 1.0}


def settling_distance(outputs: Array, target: Array, columns: Columns = ()) -> Array:
    """Largest distance from each instant on: how well the outputs have settled, without the swings. Shape (m,).

    Args and distance as in :func:`softgrasp.fem.columns.farthest`.
    """
    distance = np.maximum(farthest(outputs, target, columns), NEAREST)
    return np.asarray(np.maximum.accumulate(distance[::-1])[::-1])


def _every(count: int) -> int:
    return max(1, count // MANY_POINTS)


def _lines(ax: Any, times: Array, values: Array, look: dict[str, Any]) -> None:
    """Lines of outputs; inputs are constant within a step, and the last is repeated to close it."""
    keep = slice(None, None, _every(len(values)))
    constant = len(values) < len(times)
    at = np.append(times[:-1][keep], times[-1]) if constant else times[keep]
    shown = np.vstack([values[keep], values[-1:]]) if constant else values[keep]
    for column, colour in zip(shown.T, cycle(COLOURS), strict=False):
        ax.plot(at, column, color=colour, drawstyle="steps-post" if constant else "default", **look)


def figure_decay(poles: Mapping[str, Poles], out_png: Path, *, noise: float = 0.0) -> tuple[Path, ...]:
    """Decay rate -Re p of every pole against its frequency |Im p|, one mark a plant or gain; PNG and PDF.

    Poles on the real axis stand in a strip at the left; poles that do not decay are drawn as crosses on the lower edge
    and counted in the legend.

    Args:
        poles: by name, complex arrays of any length, both or one of each conjugate pair [1/s].
        out_png: name of the picture; the PDF gets its stem.
        noise: rates below it are rounding and count as no decay [1/s].
    """

    def swings(p: Poles) -> npt.NDArray[np.bool_]:
        return np.abs(p.imag) > 1e-9 * np.maximum(np.abs(p), 1e-300)

    sets = {name: np.asarray(p, dtype=np.complex128).ravel() for name, p in poles.items()}
    together = np.concatenate([np.zeros(0, dtype=np.complex128), *sets.values()])
    rates, frequencies = -together.real[-together.real > noise], np.abs(together.imag[swings(together)])
    low, high = (rates.min() / 2, rates.max() * 2) if len(rates) else (0.1, 10.0)
    left, right = (frequencies.min(), frequencies.max()) if len(frequencies) else (1.0, 10.0)
    axis_strip = left / 2.5
    with paper_style():
        figure, ax = plt.subplots(figsize=(style.COLUMN + 1, 3.3), layout="constrained")
        for (name, p), colour, marker in zip(sets.items(), cycle(style.CYCLE), cycle(MARKERS), strict=False):
            x = np.where(swings(p), np.abs(p.imag), axis_strip)
            fine = -p.real > noise
            lost = int((~fine).sum())
            label = name if lost == 0 else f"{name} ({lost} without decay)"
            look: dict[str, Any] = {"marker": marker, "ms": 3.6, "mew": 0.8, "mfc": "none"}
            ax.plot(x[fine], -p.real[fine], ls="", color=colour, label=label, **look)
            ax.plot(x[~fine], np.full(lost, low), "x", color=colour, ms=4.5, mew=1.0, clip_on=False)
        ax.set(xscale="log", yscale="log", ylim=(low, high), xlim=(axis_strip / 1.4, right * 1.3))
        if not swings(together).all():
            ax.axvline(np.sqrt(axis_strip * left), color="#bbbbbb", lw=0.6)
            ax.text(axis_strip, high, "real", ha="center", va="bottom", fontsize=8, color=style.OUTLINE)
        ax.set_xlabel("frequency |Im p| [1/s]")
        ax.set_ylabel("decay rate −Re p [1/s]")
        few_ticks(ax.xaxis)
        few_ticks(ax.yaxis)
        figure.legend(loc="outside upper center", ncols=2, columnspacing=1.2, handletextpad=0.2)
        return save(figure, out_png)
