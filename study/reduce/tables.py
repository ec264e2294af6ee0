"""Columns that the tables of all reduced models share."""

from __future__ import annotations

import math

import numpy as np

from softgrasp.study.reduce.times import FullTimes, Timed

# headings: time of a run, of set-up and run at a new parameter, and offline; speed-ups; runs until offline has paid
TIMES = ("run [ms]", "new [ms]", "offline [s]", "x again", "x new", "break-even")


def short(value: float | None, digits: int = 2) -> str:
    """A number for a narrow column; "overflow" where it is not finite, "-" where there is none."""
    if value is None:
        return "-"
    return f"{value:.{digits}g}" if np.isfinite(value) else "overflow"


def time_cells(p: Timed, full: FullTimes) -> tuple[str, ...]:
    """Cells below :data:`TIMES` of a reduced model with the times ``p`` beside the full model."""
    up = full.against(p)
    runs = "never" if up.break_even_runs is None else str(math.ceil(up.break_even_runs))
    seconds = f"{1e3 * p.time_online:.2f}", f"{1e3 * (p.time_setup + p.time_online):.2f}", f"{p.time_offline:.2f}"
    return *seconds, short(up.again, 3), short(up.new, 3), runs
