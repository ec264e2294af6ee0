"""The picture of the error of the mesh."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from softgrasp.fem import MeshEstimate, Trajectory
from softgrasp.study.pictures import COLUMN, CYCLE, length_unit, paper_style, save


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
