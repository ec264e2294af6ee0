"""Figures of reduced models with contact: errors against N, force and gap over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from softgrasp.study.pictures import save, style
from softgrasp.study.reduce.contact.measure import ContactPoint, ContactStudy


def draw(out: Path, study: ContactStudy) -> list[Path]:
    """Both figures. Rank 0 only."""
    return [*figure_errors(study, out / "errors.png"), *figure_force(study, out / "force.png")]


def figure_errors(study: ContactStudy, out_png: Path) -> tuple[Path, ...]:
    """Errors of z and of the forces against N."""
    with style.paper_style():
        figure, axes = plt.subplots(1, 2, figsize=(style.WIDTH, 2.8), layout="constrained")
        points = sorted(study.points.values(), key=lambda p: p.N)
        _pair(axes[0], points, ("error", "error_held_out"))
        _pair(axes[1], points, ("error_force", "error_force_held_out"))
        for ax, label in zip(axes, ("error of the deformation z [1]", "error of the forces [1]"), strict=True):
            ax.set(xlabel="N, columns of the basis", ylabel=label, xticks=[p.N for p in points])
            style.log_axis(ax, None)
            low, high = ax.dataLim.intervaly
            ax.set_ylim(10 ** np.floor(np.log10(low)), 10 ** np.ceil(np.log10(high)))
        handles = axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside upper center", ncols=2, fontsize=7)
        return tuple(save(figure, out_png))


def _pair(ax: Any, points: Sequence[ContactPoint], keys: tuple[str, str]) -> None:
    """Filled marks for the motion of the scene, open ones for the largest held-out error."""
    N = [p.N for p in points]
    for key, look, fill, label in zip(
        keys, ("o-", "o--"), ("full", "none"), ("motion of the scene", "largest on held-out motions"), strict=True
    ):
        values = [np.nan if (x := getattr(p, key)) is None else x for p in points]
        if not np.isnan(values).all():
            ax.plot(N, values, look, color=style.BLUE, ms=3.8, fillstyle=fill, label=label)


def figure_force(study: ContactStudy, out_png: Path) -> tuple[Path, ...]:
    """Length of the force of each obstacle, means of two steps, and least gap; full model in grey behind."""
    title, full, run = study.shown
    contact, times = full.trajectory.contact, run.times
    assert contact is not None
    factor, unit = style.length_unit(float(np.abs(contact.gap).max()))
    with style.paper_style():
        figure, axes = plt.subplots(2, 1, figsize=(style.COLUMN + 0.6, 3.6), sharex=True, layout="constrained")
        for o, name in enumerate(contact.names):
            colour = style.CYCLE[o % len(style.CYCLE)]
            named = "" if len(contact.names) == 1 else f", {name}"
            for force, gap, look, label in (
                (contact.force, contact.gap, {"color": "#999999", "lw": 2.6}, "full"),
                (run.force, run.gap, {"color": colour, "lw": 1.0}, f"reduced, N = {run.a.shape[1]}"),
            ):
                size = np.linalg.norm(force[:, o], axis=1)
                axes[0].plot(times[1:-1], (size[1:] + size[:-1]) / 2, label=label + named, **look)
                axes[1].plot(times, factor * gap[:, o], **look)
        axes[0].set_ylabel("force [N]")
        axes[1].set_ylabel(f"least gap [{unit}]")
        axes[1].set_xlabel("time [s]")
        for ax in axes:
            ax.axhline(0.0, color="#bbbbbb", lw=0.6, zorder=0)
        axes[0].set_title(title, pad=4)
        axes[0].legend(fontsize=7)
        figure.align_ylabels(axes)
        return tuple(save(figure, out_png))
