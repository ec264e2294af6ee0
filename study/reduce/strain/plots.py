"""Figures of reduced models at finite strain: errors against N and cells, sampled cells on the body."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LogNorm

from softgrasp.fem import PictureMesh
from softgrasp.reduction import StrainModel
from softgrasp.study.pictures import hand_polygons, seen, shadow, style
from softgrasp.study.reduce.strain.result import CELLS_AT, StrainPoint, StrainStudy


def draw(out: Path, study: StrainStudy, picture: PictureMesh | None) -> list[Path]:
    """Figures. Rank 0 only."""
    files = list(figure_strain_errors(study, out / "strain_errors.png"))
    last = study.families[-1]
    shown = [last.models[N] for N in CELLS_AT if N in last.models]
    if picture is not None and shown:
        files += figure_cells(picture, shown, out / "cells.png")
    return files


def figure_strain_errors(study: StrainStudy, out_png: Path) -> tuple[Path, ...]:
    """Errors against N, and against the number of cells."""
    colours = dict(zip((f.key for f in study.families), (style.BLUE, style.ORANGE), strict=False))
    with style.paper_style():
        figure, (left, right) = plt.subplots(2, 1, figsize=(style.COLUMN + 0.9, 7.0), layout="constrained")
        for f in study.families:
            _pair(left, [p.N for p in f.points], f.points, colours[f.key], f.title)
            left.plot([p.N for p in f.points], [p.error_galerkin for p in f.points], ls=":", color=colours[f.key])
            for N, colour in zip(CELLS_AT, (style.GREEN, style.PURPLE), strict=True):
                points = sorted((p for p in f.curves if p.N == N), key=lambda p: p.cells)
                if f is study.families[-1] and points:
                    _pair(right, [p.cells for p in points], points, colour, f"N = {N}, {f.title}")
                    right.axhline(points[0].error_galerkin, ls=":", color=colour)
        for ax, label in ((left, "N"), (right, "sampled cells")):
            ax.axhline(study.linear, **style.FULL)
            ax.set_xlabel(label)
            style.log_axis(ax, None)
            ax.set_ylabel("error of the deformation z [1]")
            ax.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        at = {"xy": (0.99, study.linear), "xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
        right.annotate("linear elasticity", **at, fontsize=6.5)
        return tuple(style.save(figure, out_png))


def _pair(ax: Any, x: Sequence[int], points: Sequence[StrainPoint], colour: str, label: str) -> None:
    """Filled marks for training runs, open ones for the largest held-out error."""
    ax.plot(x, [p.error_training for p in points], "o-", color=colour, ms=3.4, label=label)
    held = [max((e for e in (p.error_materials, p.error_motions) if e is not None), default=np.nan) for p in points]
    if not np.isnan(held).all():
        ax.plot(x, held, "o--", color=colour, ms=3.8, fillstyle="none", label=f"{label}, held out")


def figure_cells(picture: PictureMesh, models: Sequence[StrainModel], out_png: Path) -> tuple[Path, ...]:
    """Sampled cells on the body at rest, coloured by their weight."""
    flat = seen(picture.points)
    size = np.ptp(flat, axis=0)
    wide = style.WIDTH if len(models) > 1 else style.COLUMN
    height = min(4.0, 1.1 + wide / min(len(models), 2) * float(size[1] / size[0]) * 0.8)
    sampled = [np.unique(m.cells.cell, return_index=True) for m in models]
    weights = [m.cells.xi[first] for m, (_, first) in zip(models, sampled, strict=True)]  # xi = weight / vol
    norm, edge = LogNorm(float(min(map(np.min, weights))), float(max(map(np.max, weights)))), style.OUTLINE
    with style.paper_style():
        figure, axes = plt.subplots(1, len(models), figsize=(wide, height), squeeze=False, layout="constrained")
        for ax, model, (cells, _), xi in zip(axes[0], models, sampled, weights, strict=True):
            colours = style.colour_map()(norm(xi))
            if picture.dimension == 2:
                looks: list[tuple[Any, Any, str, float]] = [
                    (flat[picture.cells], "#f4f4f4", "#d0d0d0", 0.3),
                    (flat[picture.cells[cells]], colours, edge, 0.5),
                    (hand_polygons(picture)[0], style.HAND, style.HAND, 0.3),
                ]
                for i, (polygons, inside, line, lw) in enumerate(looks, 1):
                    ax.add_collection(PolyCollection(list(polygons), zorder=i, fc=inside, ec=line, lw=lw))
            else:
                ax.add_collection(LineCollection(shadow(flat, picture.facets), colors=edge, linewidths=0.8))
                x = seen(picture.points[picture.cells[cells]].mean(axis=1))
                ax.scatter(x[:, 0], x[:, 1], c=colours, s=14, edgecolors=edge, linewidths=0.3)
            ax.set_title(f"N = {model.N}: {len(cells)} of {model.cells_full} cells", pad=4)
            ax.autoscale_view()
            ax.set_aspect("equal")
            ax.axis("off")
        scale = ScalarMappable(norm, style.colour_map())
        figure.colorbar(scale, ax=list(axes[0]), shrink=0.7, label="weight ξ of a cell")
        return tuple(style.save(figure, out_png))
