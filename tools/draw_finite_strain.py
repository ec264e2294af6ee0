"""Draw linear elasticity and finite strain on one move: ``python tools/draw_finite_strain.py docs/finite_strain.png``.

Bodies are shown against the hand, coloured by det F, the change of volume; below, the tip against the hand over time.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import TwoSlopeNorm

import softgrasp as sg
from softgrasp.fem.fields.picture import PictureMesh, gather_picture, vertex_displacement
from softgrasp.study.pictures.style import paper_style

TITLES = {None: "linear elasticity", "neo-hooke": "finite strain, neo-Hooke"}
SHARES = (0.2, 0.32, 0.55, 0.68)  # of the run, when the bodies are shown
SHOWN = len(SHARES)
NORM = TwoSlopeNorm(1.0, 0.5, 1.5)


def det_f(picture: PictureMesh, u: Any) -> Any:
    """det(I + grad u) of each triangle, from its edges before and after."""
    corners = picture.points[picture.cells], (picture.points + u)[picture.cells]
    before, after = (np.linalg.det(x[:, 1:] - x[:, :1]) for x in corners)
    return after / before


def body(axes: Any, picture: PictureMesh, u: Any) -> Any:
    """The deformed triangles, and the hand's sides as thick lines."""
    x = picture.points + u
    cells = PolyCollection(x[picture.cells], array=det_f(picture, u), cmap="RdBu", norm=NORM, ec="0.35", lw=0.15)
    axes.add_collection(cells)
    for facet in picture.contact:
        axes.plot(*x[facet].T, color="0.15", lw=2.5, solid_capstyle="butt")
    axes.set_aspect("equal")
    axes.set_xlim(-0.6, 1.6)
    axes.set_ylim(-0.2, 2.05)
    axes.axis("off")
    return cells


def main(out: Path) -> None:
    """Run both and draw them."""
    models = {law: sg.build("paper_forward", [f"effects.finite_strain.law='{law}'"] if law else []) for law in TITLES}
    runs = {law: sg.simulate(model) for law, model in models.items()}
    tips = {law: (run.outputs - run.outputs_rigid) for law, run in runs.items()}
    times, steps = runs[None].times, len(runs[None].times) - 1
    instants = [round(steps * share) for share in SHARES]
    with paper_style():
        figure = plt.figure(figsize=(7.2, 5.3), layout="constrained")
        grid = figure.add_gridspec(3, SHOWN + 1, height_ratios=(1.25, 1.25, 0.8), width_ratios=(*[1] * SHOWN, 0.06))
        for row, (law, model) in enumerate(models.items()):
            picture = gather_picture(model)
            snapshots = runs[law].snapshots
            assert picture is not None
            assert snapshots is not None
            n = model.system.layout.n_local
            for column, k in enumerate(instants):
                axes = figure.add_subplot(grid[row, column])
                u = vertex_displacement(model, snapshots.Z[:n, k], np.zeros(2))
                drawn = body(axes, picture, u)
                if row == 0:
                    axes.set_title(f"t = {times[k]:.3g} s")
                if column == 0:
                    axes.text(-0.62, 0.95, TITLES[law], rotation=90, va="center", ha="right", size=8, weight="bold")
        bar = figure.colorbar(drawn, cax=figure.add_subplot(grid[:2, SHOWN]), ticks=[0.5, 0.75, 1, 1.25, 1.5])
        bar.set_label("det F: volume over volume at rest")
        axes = figure.add_subplot(grid[2, :SHOWN])
        for law, colour in ((None, "#b2182b"), ("neo-hooke", "#2166ac")):
            axes.plot(times, tips[law][:, 0], color=colour, label=TITLES[law])
        for k in instants:
            axes.axvline(times[k], color="0.8", lw=0.6, zorder=0)
        axes.set_xlabel("time [s]")
        axes.set_ylabel("tip against the hand, x [m]")
        axes.legend(loc="lower right")
        figure.savefig(out, dpi=200)
    gap = np.linalg.norm(tips[None] - tips["neo-hooke"], axis=1).max() / np.linalg.norm(tips["neo-hooke"], axis=1).max()
    sys.stdout.write(f"largest error of the tip {100 * gap:.0f} %\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
