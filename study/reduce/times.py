"""Seconds of the full model, and what a reduced one gains."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.reduction.replay import FullRun, full_run

FULL_REPEATS = 3  # behind the median of the full run
PATIENCE = 2.0  # seconds of a full run above which one is enough
Say = Callable[[str, int, int], None]
"""Called with what is done, its number and how many there are."""


class Timed(Protocol):
    """The seconds of a reduced model."""

    @property
    def time_offline(self) -> float:
        """Basis and model."""

    @property
    def time_setup(self) -> float:
        """A new parameter before its run."""

    @property
    def time_online(self) -> float:
        """A whole run."""


@dataclass(frozen=True)
class SpeedUp:
    """The full model's time over that of a reduced one."""

    again: float  # steps over a run of the same model again, both with everything prefactored
    new: float  # factorisation and steps over set-up and run
    # time_offline / (full run - reduced run) at new parameters; None when the reduced is not faster
    break_even_runs: float | None


@dataclass(frozen=True)
class FullTimes:
    """Seconds of the full model: the steps of a run alone, and the factorisation before them."""

    steps: float
    factor: float

    def against(self, p: Timed) -> SpeedUp:
        """What a reduced model gains."""
        whole, new = self.factor + self.steps, p.time_setup + p.time_online
        runs = p.time_offline / (whole - new) if whole > new else None
        return SpeedUp(self.steps / p.time_online, whole / new, runs)

    def to_json(self) -> dict[str, float]:
        """In "time" of ``result.json``."""
        return {"full_steps_median": self.steps, "full_factor_median": self.factor}


def measured_run(model: Model, say: Say) -> tuple[FullRun, FullTimes]:
    """The full run, and its seconds in the median of several when it is short. Collective."""
    comm = model.system.layout.comm
    first = simulate(model, RunOptions(progress=lambda run: say("full run", run.reached, run.steps)))
    repeats = comm.bcast(FULL_REPEATS if steps_seconds(first) < PATIENCE else 1)
    runs = [first] + [simulate(replace(model, watch=Stopwatch(comm))) for _ in range(repeats - 1)]
    factor = statistics.median(run.seconds["factor"] for run in runs)
    return full_run(model, first), FullTimes(statistics.median(map(steps_seconds, runs)), factor)


def steps_seconds(run: Trajectory) -> float:
    """Seconds of all steps; the first is not among those measured, since it sets up the solver."""
    n = len(run.times) - 1
    return run.seconds["steps"] / max(n - 1, 1) * n
