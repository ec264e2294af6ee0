"""Frequency response of the loop under the small controller, and its margins in words."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MultipleLocator

from softgrasp.lqr.loop.margins import LoopMargins
from softgrasp.study.pictures.style import CYCLE, OUTLINE, WIDTH, paper_style, save
from softgrasp.study.report.tables import Table

SHOWN = 1e-4  # gains below are not drawn
STYLES = ("-", "--", ":", "-.")


def figure_bode(margins: LoopMargins, out_png: Path) -> tuple[Path, ...]:
    """Gain and phase of the loop at each input, with the crossover of its phase margin."""
    with paper_style():
        figure, (gain, phase) = plt.subplots(2, 1, figsize=(WIDTH, 0.6 * WIDTH), sharex=True, layout="constrained")
        for i, axis in enumerate(margins.axes):
            loop = margins.response[:, i]
            colour, style = CYCLE[i % len(CYCLE)], STYLES[i % len(STYLES)]
            size, shown = np.abs(loop), np.abs(loop) > SHOWN
            gain.loglog(margins.omega[shown], size[shown], color=colour, ls=style, label=axis.name)
            angle = np.degrees(np.unwrap(np.angle(-loop))) - 180
            angle -= 360 * np.round((angle[0] + 180) / 360)
            phase.semilogx(margins.omega[shown], angle[shown], color=colour, ls=style)
            if np.isfinite(axis.crossover):
                gain.plot(axis.crossover, 1.0, "o", color=colour, ms=4)
                at = float(np.interp(np.log(axis.crossover), np.log(margins.omega), angle))
                phase.plot([axis.crossover] * 2, [-180, at], "o-", color=colour, ms=3, lw=0.8)
        gain.axhline(1.0, color=OUTLINE, lw=0.7)
        phase.axhline(-180.0, color=OUTLINE, lw=0.7)
        phase.yaxis.set_major_locator(MultipleLocator(45))
        gain.set_ylabel("gain of the loop [1]")
        phase.set(xlabel="frequency [rad/s]", ylabel="phase [deg]")
        gain.legend()
        return save(figure, out_png)


def margin_table(margins: LoopMargins) -> Table:
    """One row an input: gain factors, phase margin, crossover, delay."""
    rows = [
        (a.name, f"{a.gain_down:.3g} to {_number(a.gain_up)}", f"{_number(a.phase)} deg",
         f"{_number(a.crossover)} rad/s", f"{_number(a.delay)} s")
        for a in margins.axes
    ]  # fmt: skip
    header = ("input", "gain may change by a factor", "phase margin", "at", "delay it bears")
    return Table(header, rows, "Margins of the small controller")


def margin_text(margins: LoopMargins) -> str:
    """What all inputs bear at once, in one sentence."""
    low, high, phase = margins.together
    return (
        f"All inputs together bear any gain factors from {low:.3g} to {_number(high)}, or phase shifts up to "
        f"{phase:.3g} deg; the smallest singular value of I + L is {margins.distance:.3g}."
    )


def _number(x: float) -> str:
    return "any" if np.isinf(x) or x > 1e3 else "none" if np.isnan(x) else f"{x:.3g}"
