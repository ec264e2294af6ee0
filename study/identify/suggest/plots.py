"""The body with the candidates for markers, coloured by the error with each alone, and the chosen ones."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm

from softgrasp.fem import PictureMesh
from softgrasp.reduction.identify.suggest import SuggestedMarkers
from softgrasp.study.pictures import COLUMN, HAND, OUTLINE, few_ticks, paper_style, save, seen

WIDEST = 100.0  # of the colours: what is so much worse than the best candidate looks alike


def draw(answer: SuggestedMarkers, picture: PictureMesh, out: Path) -> list[Path]:
    """The figure. Not collective."""
    with paper_style():
        figure, ax = plt.subplots(figsize=(COLUMN + 0.6, 3.6), layout="constrained")
        lines = seen(picture.points)
        for facets, colour, width in ((picture.facets, OUTLINE, 0.7), (picture.contact, HAND, 2.5)):
            corners = facets if facets.shape[1] == 2 else facets[:, [0, 1, 2, 0]]
            thin = width if facets.shape[1] == 2 else width / 4
            ax.add_collection(LineCollection(list(lines[corners]), colors=colour, lw=thin, zorder=1))
        plan = answer.motions[0]
        share = 100 * plan.alone
        x = seen(answer.points)
        top = min(share.max(), WIDEST * share.min())
        norm = LogNorm(share.min(), top if top > share.min() else 1.01 * share.min())
        dots = ax.scatter(x[:, 0], x[:, 1], c=share, cmap="viridis_r", norm=norm, s=18, zorder=3, linewidths=0)
        best = x[list(plan.chosen)]
        ax.scatter(best[:, 0], best[:, 1], s=75, facecolors="none", edgecolors="black", linewidths=1.1, zorder=4)
        middle = lines.mean(axis=0)
        for number, at in enumerate(best):
            away = (at - middle) / max(float(np.linalg.norm(at - middle)), 1e-300)
            ax.annotate(f"m{number + 1}", at, xytext=tuple(11 * away), textcoords="offset points", ha="center",
                va="center", fontsize=8, zorder=5)  # fmt: skip
        ax.set_aspect("equal")
        ax.margins(0.12)
        flat = answer.points.shape[1] == 2
        ax.set(xlabel="x [m]" if flat else "", ylabel="y [m]" if flat else "")
        if not flat:
            ax.set_axis_off()
        bar = figure.colorbar(dots, ax=ax, label="size of the errors with this marker alone [%]", shrink=0.8)
        few_ticks(bar.ax.yaxis)
        return [*save(figure, out / "markers.png")]
