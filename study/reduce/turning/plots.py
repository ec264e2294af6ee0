"""Figure of reduced models in the frame of the hand: errors against N."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt

from softgrasp.study.pictures import save, style
from softgrasp.study.reduce.turning.measure import TurningPoint


def draw(out: Path, points: Sequence[TurningPoint]) -> list[Path]:
    """The figure. Rank 0 only."""
    with style.paper_style():
        figure, ax = plt.subplots(figsize=(style.COLUMN, 2.6), layout="constrained")
        for name, colour in zip(dict.fromkeys(p.method for p in points), style.CYCLE, strict=False):
            of = [p for p in points if p.method == name]
            ax.semilogy([p.N for p in of], [max(p.error, 1e-8) for p in of], "o-", color=colour, ms=3.4, label=name)
        ax.set(xlabel="N, columns of the basis", ylabel="error of the deformation z [1]")
        ax.legend(fontsize=6.5, loc="lower left", bbox_to_anchor=(0.0, 1.0))
        return list(save(figure, out / "errors.png"))
