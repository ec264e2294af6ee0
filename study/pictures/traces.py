"""Hand and outputs of a move against time, and the error of the mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator

from softgrasp.fem import AXES, Array, Columns, MeshEstimate, Trajectory, hand_columns
from softgrasp.study.pictures.style import COLUMN, CYCLE, HAND, STEPS, length_unit, paper_style, save


def traces(
    times: Array,
    outputs: Array,
    columns: Columns,
    q_s: Array,
    *,
    rigid: Array | None = None,
    dimension: int | None = None,
) -> Any:
    """Hand and outputs against time, and below what the outputs move relative to the hand; a Matplotlib figure.

    An output that is the hand again is drawn once, as the hand, and has no share in what moves relative to it.

    Args:
        times: shape (m,) [s].
        outputs: absolute displacements, shape (m, c) [m], with their columns.
        q_s: hand, shape (m, n_s) [m, rad]; its rotations have a panel of their own.
        rigid: share of the outputs that moves with the hand, shape (m, c); by default the hand's translation.
        dimension: 2 or 3; needed when a 2D hand turns.
    """
    d = dimension or min(q_s.shape[1], 3)
    axes_of = [AXES.index(column.axis) if column.axis in AXES else -1 for column in columns]
    shown = _not_the_hand(outputs, columns, axes_of, q_s, d)
    moving = q_s[:, [axes_of[i] for i in shown]] if rigid is None else rigid[:, shown]
    relative = outputs[:, shown] - moving
    bodies = list(dict.fromkeys(columns[i].name for i in shown))
    angles = q_s.shape[1] > d
    with paper_style():
        panels = 1 + bool(shown) + angles
        figure, axes = plt.subplots(
            panels, 1, figsize=(COLUMN, 0.4 + 1.5 * panels), sharex=True, layout="constrained", squeeze=False
        )
        axes = axes[:, 0]
        drawn = np.hstack([outputs[:, shown], q_s[:, :d]])
        factors = [length_unit(float(np.abs(a).max(initial=0.0))) for a in (drawn, relative)]
        for k, i in enumerate(shown):
            style = ("-", "-.", ":")[bodies.index(columns[i].name) % 3]
            look: dict[str, Any] = {"color": CYCLE[axes_of[i]], "ls": style}
            axes[0].plot(times, factors[0][0] * outputs[:, i], label=columns[i].title, **look)
            axes[1].plot(times, factors[1][0] * relative[:, k], **look)
        # The hand last: its thin dashes lie on the lines of the outputs.
        for j in np.flatnonzero(np.abs(q_s[:, :d]).max(axis=0) > 0).tolist():
            look = {"color": HAND, "ls": ((0, (4, 3)), (0, (1, 1.5)), (0, (4, 2, 1, 2)))[j], "lw": 0.8}
            axes[0].plot(times, factors[0][0] * q_s[:, j], label=f"hand, {'xyz'[j]}", **look)
        axes[0].set_ylabel(f"displacement [{factors[0][1]}]")
        if shown:
            axes[1].set_ylabel(f"relative to hand [{factors[1][1]}]")
        if angles:
            _angles(axes[-1], times, q_s, d)
        entries, labels = axes[0].get_legend_handles_labels()
        figure.legend(
            entries, labels, loc="outside upper center", ncols=min(4, max(2, -(-len(labels) // d))), handlelength=2.4,
            columnspacing=1.4,
        )  # fmt: skip
        for ax in axes:
            ax.axhline(0.0, color="#bbbbbb", lw=0.6, zorder=0)
            ax.yaxis.set_major_locator(MaxNLocator(5, steps=STEPS))
        axes[-1].set_xlabel("time [s]")
        axes[-1].set_xlim(float(times[0]), float(times[-1]))
        figure.align_ylabels(axes)
        return figure


def _not_the_hand(outputs: Array, columns: Columns, axes_of: list[int], q_s: Array, d: int) -> list[int]:
    """Displacements to draw: those of outputs that do not repeat a moving hand."""
    groups: dict[str, list[int]] = {}
    for i, axis in enumerate(axes_of):
        if 0 <= axis < d:
            groups.setdefault(columns[i].name, []).append(i)
    moves = bool(np.abs(q_s[:, :d]).max(initial=0.0) > 0)
    repeated = [moves and np.array_equal(outputs[:, g], q_s[:, [axes_of[i] for i in g]]) for g in groups.values()]
    return [i for group, same in zip(groups.values(), repeated, strict=True) if not same for i in group]


def _angles(ax: Any, times: Array, q_s: Array, d: int) -> None:
    """The angles that the hand turns by; all if it turns by none."""
    turned = np.abs(q_s[:, d:]).max(axis=0) > 0
    for j, column in enumerate(hand_columns(q_s.shape[1], d)[d:]):
        if turned[j] or not turned.any():
            look: dict[str, Any] = {
                "color": CYCLE["xyz".index(column.axis[-1])],
                "ls": ("-", (0, (4, 3)), (0, (1, 2)))[j],
            }
            ax.plot(times, q_s[:, d + j], label=f"hand, {column.axis}", **look)
    ax.set_ylabel("hand angle [rad]")
    ax.legend(loc="best", handlelength=2.0)


def figure_mesh_error(out_png: Path, run: Trajectory, result: MeshEstimate) -> tuple[Path, ...]:
    """Outputs against the hand, y and y + delta y, with the band of the bound; PNG and PDF."""
    relative = run.outputs - run.outputs_rigid
    shown = [i for i in range(relative.shape[1]) if np.abs(relative[:, i]).max() > 0][:6]
    corrected = relative + result.delta
    band = result.bound * np.linalg.norm(corrected, axis=1).max()
    factor, unit = length_unit(float(np.abs(relative).max(initial=0.0)))
    with paper_style():
        figure, ax = plt.subplots(figsize=(COLUMN, 2.4), layout="constrained")
        for k, i in enumerate(shown):
            color = CYCLE[k % len(CYCLE)]
            y, name = factor * relative[:, i], run.output_names[i]
            ax.fill_between(run.times, y - factor * band, y + factor * band, color=color, alpha=0.15, lw=0)
            ax.plot(run.times, y, color=color, label=f"{name} of this mesh")
            ax.plot(run.times, factor * corrected[:, i], color=color, ls="--", label=f"{name} corrected")
        ax.set_xlabel("time [s]")
        ax.set_ylabel(f"relative to hand [{unit}]")
        figure.legend(loc="outside upper center", ncols=2)
        return save(figure, out_png)
