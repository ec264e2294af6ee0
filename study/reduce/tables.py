"""Columns that the tables of all reduced models share."""

from __future__ import annotations

import math
from typing import Any

from softgrasp.study.reduce.times import FullTimes, Timed
from softgrasp.study.report import Columns


def timed(p: Timed, full: FullTimes, **more: Any) -> dict[str, Any]:
    """A row below :data:`TIMES`: a reduced model with the times ``p`` beside the full model."""
    return {"p": p, "up": full.against(p), **more}


TIMES: Columns = {
    "run [ms]": lambda r: f"{1e3 * r['p'].time_online:.2f}",
    "new [ms]": lambda r: f"{1e3 * (r['p'].time_setup + r['p'].time_online):.2f}",
    "offline [s]": "p.time_offline .2f",
    "x again": "up.again .3g",
    "x new": "up.new .3g",
    "break-even": lambda r: "never" if (runs := r["up"].break_even_runs) is None else str(math.ceil(runs)),
}
"""Time of a run, of set-up and run at a new parameter, and offline; speed-ups; runs until offline has paid."""
