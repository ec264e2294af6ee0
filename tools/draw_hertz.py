"""Draw a disc pressed into a block beside Hertz: ``python -m tools.draw_hertz docs/hertz.png``."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from softgrasp.study.pictures.style import paper_style
from tests.helpers.hertz import HALF_WIDTH, Pressed, press

ORDERS = {1: ("linear elements", "C1", "o"), 2: ("quadratic elements", "C0", "s")}
EDGES = (2, 4, 8, 16)  # in a half-width
SHOWN = 8  # of them, with the pressure over the place


def main(path: Path) -> None:
    """Press, print the errors and draw."""
    with tempfile.TemporaryDirectory() as folder:
        runs = {(order, n): press(order, HALF_WIDTH / n, Path(folder)) for order in ORDERS for n in EDGES}
    for (order, n), run in runs.items():
        width, peak = run.errors
        sys.stdout.write(f"order {order}, h = a / {n}: half-width {width:+.1e}, peak {peak:+.1e}\n")
    with paper_style():
        draw(runs).savefig(path)


def draw(runs: dict[tuple[int, int], Pressed]) -> plt.Figure:
    """Pressure over the place on the left, errors against the edge on the right."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.4), layout="constrained")
    x = np.linspace(-1, 1, 401)
    left.plot(x, np.sqrt(1 - x**2), color="0.4", lw=1.2, label="Hertz")
    for order, (name, colour, marker) in ORDERS.items():
        run = runs[order, SHOWN]
        left.plot(run.x / run.a, run.pressure / run.peak, marker, color=colour, ms=4, mfc="none", label=name)
        errors = np.abs([runs[order, n].errors for n in EDGES])
        for error, line, what in zip(errors.T, ("-", "--"), ("half-width", "peak"), strict=True):
            right.loglog(1 / np.array(EDGES), error, line, marker=marker, color=colour, ms=4, mfc="none",
                         label=f"{what}, {name}")  # fmt: skip
    left.set(xlabel="place over half-width, x / a", ylabel="pressure over largest, p / p0")
    right.set(xlabel="edge over half-width, h / a", ylabel="relative error")
    right.set_xticks([1 / n for n in EDGES], [f"1/{n}" for n in EDGES])
    right.minorticks_off()
    left.legend(loc="lower center")
    right.legend(fontsize="small")
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
