"""Force, least gap and number of touching nodes of each obstacle over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.record import ContactRecord
from softgrasp.study.pictures.style import COLUMN, CYCLE, STEPS, length_unit, paper_style, save


def figure_contact(times: Array, contact: ContactRecord, out_png: Path) -> tuple[Path, ...]:
    """:func:`contact_figure` as PNG and PDF."""
    return save(contact_figure(times, contact), out_png)


def contact_figure(times: Array, contact: ContactRecord) -> Any:
    """Length of the force, each step's thin and the mean of two bold, gap, and nodes touching."""
    force, touching = np.linalg.norm(contact.force, axis=2), contact.touching
    even = np.linalg.norm(np.vstack([contact.force[:1], (contact.force[1:] + contact.force[:-1]) / 2]), axis=2)
    factor, unit = length_unit(float(np.abs(contact.gap).max()))
    with paper_style():
        figure, axes = plt.subplots(3, 1, figsize=(COLUMN, 4.0), sharex=True, layout="constrained")
        for o, name in enumerate(contact.names):
            look = {"color": CYCLE[o % len(CYCLE)], "ls": ("-", "--", ":")[o // len(CYCLE) % 3]}
            axes[0].stairs(force[:, o], times, baseline=None, lw=0.5, alpha=0.4, **look)
            axes[0].plot(times[:-1], even[:, o], label=name, **look)
            axes[2].stairs(touching[:, o], times, baseline=None, lw=1.2, **look)
            axes[1].plot(times, factor * contact.gap[:, o], **look)
        axes[0].set_ylabel("force [N]")
        axes[1].set_ylabel(f"least gap [{unit}]")
        axes[2].set_ylabel("nodes touching")
        for ax in axes:
            ax.axhline(0.0, color="#bbbbbb", lw=0.6, zorder=0)
            ax.yaxis.set_major_locator(MaxNLocator(4, steps=STEPS, integer=ax is axes[2]))
        axes[2].set_xlabel("time [s]")
        axes[2].set_xlim(float(times[0]), float(times[-1]))
        figure.legend(
            *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=min(4, len(contact.names))
        )
        figure.align_ylabels(axes)
    return figure
