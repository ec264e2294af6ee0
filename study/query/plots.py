"""Figures of an answer: outputs with their band, bounds over time, three errors; a batch by its materials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D

from softgrasp.study.pictures import few_ticks, length_unit, paper_style, save, style
from softgrasp.study.query.answer import CertifiedAnswer, QueryResult
from softgrasp.study.report import percent

LEAST = 1e-16  # of an error that is drawn


def figure_answer(answer: CertifiedAnswer, out: Path) -> tuple[Path, ...]:
    """Deformation of the outputs with its band, bounds over time, and the three errors; only the last if refused."""
    c, run = answer.certificate, answer.run
    with paper_style():
        rows = 1 if run is None or answer.full else 3
        heights = [1.5, 1.3, 0.8][-rows:]
        figure, axes = plt.subplots(
            rows, 1, figsize=(style.COLUMN, 0.4 + 1.2 * sum(heights)), layout="constrained", height_ratios=heights,
            squeeze=False,
        )  # fmt: skip
        if rows == 3:
            assert run is not None
            y, names = answer.deformation(), run.output_names
            factor, unit = length_unit(float(np.abs(y).max(initial=0.0)))
            (top,), (below,) = axes[:2]
            below.sharex(top)
            for i, (name, colour) in enumerate(zip(names, style.CYCLE, strict=False)):
                bound = np.maximum.accumulate(c.outputs.values[:, i])
                band = factor * (y[:, i] - bound), factor * (y[:, i] + bound)
                top.fill_between(run.times, *band, color=colour, alpha=0.25, lw=0)
                top.plot(run.times, factor * y[:, i], color=colour, label=name)
                below.semilogy(run.times[1:], np.maximum(bound[1:], LEAST), color=colour)
                if c.proved and c.outputs_estimate is not None:
                    about = np.maximum(np.maximum.accumulate(c.outputs_estimate.values[1:, i]), LEAST)
                    below.semilogy(run.times[1:], about, color=colour, ls=":")
            top.set_ylabel(f"relative to hand [{unit}]")
            kinds = [Line2D([], [], color=style.HAND, ls=":", label="estimated")] if c.proved else []
            kinds = [Line2D([], [], color=style.HAND, label=c.how), *kinds]
            entries = [*top.get_legend_handles_labels()[0], *kinds]
            figure.legend(handles=entries, loc="outside upper left", ncols=min(4, len(entries)), columnspacing=1.2)
            largest = float(c.outputs.values.max(initial=LEAST))
            below.set(xlabel="time [s]", ylabel="largest error so far [m]", ylim=(1e-4 * largest, 2 * largest))
        _three(axes[-1, 0], answer)
        return save(figure, out / ("answer.png" if rows == 3 else "errors.png"))


def _three(ax: Any, answer: CertifiedAnswer) -> None:
    """The errors of reduction, time step and mesh as bars, proofs filled."""
    c = answer.certificate
    mesh = None if c.mesh is None else c.mesh.largest
    errors = [("mesh, estimated", mesh), ("time step, estimated", c.time_step), (f"reduction, {c.how}", c.reduction)]
    finite = [value for value in (*(value for _, value in errors), c.tolerance) if value and np.isfinite(value)]
    low = 0.2 * min(finite, default=1e-3)
    for i, (_, value) in enumerate(errors):
        proof = i == 2 and c.proved
        colour = style.BLUE if proof else style.ORANGE
        if value is not None and np.isfinite(value):
            ax.barh(i, value - low, left=low, color=colour if proof else "none", ec=colour, height=0.6)
    ax.set_yticks(range(3), [name if value is not None else f"{name}: not known" for name, value in errors])
    ax.set(xscale="log", xlim=(low, 3 * max(finite, default=1.0)), xlabel="relative error")
    style.percent_ticks(ax.xaxis)
    if c.tolerance is not None:
        ax.axvline(c.tolerance, color=style.UNSTABLE, lw=0.9, ls="--")
        ax.set_title(f"dashed: the tolerance of the reduction, {percent(c.tolerance)}", loc="right")


def figure_batch(answers: QueryResult, file: Path) -> tuple[Path, ...]:
    """Error of every answer at its lambda and mu."""
    lam, mu = (np.array([getattr(a.materials[0], key) for a in answers.each]) for key in ("lam", "mu"))
    errors = np.array([a.certificate.reduction for a in answers.each])
    shown, refused = np.isfinite(errors) & (errors > 0), np.array([a.run is None for a in answers.each])
    with paper_style():
        figure, ax = plt.subplots(figsize=(style.COLUMN, 2.8), layout="constrained")
        if shown.any():
            norm = LogNorm(0.9 * errors[shown].min(), 1.1 * errors[shown].max())
            points = ax.scatter(lam[shown], mu[shown], c=errors[shown], norm=norm, cmap="viridis_r", s=28)
            style.percent_ticks(figure.colorbar(points, label="relative error of the reduction").ax.yaxis)
        ax.plot(lam[refused], mu[refused], "x", color=style.UNSTABLE, ms=8)
        if answers.model.box is not None:
            (a, b), (c, d) = answers.model.box.lam, answers.model.box.mu
            ax.plot([a, b, b, a, a], [c, c, d, d, c], color="#999999", lw=0.7)
        logarithmic = bool((lam > 0).all())
        ax.set(xscale="log" if logarithmic else "linear", yscale="log")
        ax.set(xlabel="λ [Pa]", ylabel="μ [Pa]")
        for axis in (ax.xaxis, ax.yaxis)[not logarithmic :]:
            few_ticks(axis)
        return save(figure, file)
