"""Processor time of the full model, and what a reduced one gains."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Model, RunOptions, Stopwatch, Trajectory, simulate
from softgrasp.fem.errors import raise_on_all_ranks
from softgrasp.reduction import FullRun, full_run
from softgrasp.study.report import Columns, percent
from softgrasp.study.shell import RepeatableRun, processor_seconds

FULL_REPEATS = 3  # runs of which the full run's time is the median
PATIENCE = 2.0  # seconds of a full run above which few are enough
ROUNDS, OFTEN = 9, 10  # in which both sides take turns, and reduced runs in each: one takes about a millisecond
STEADY = 1.3  # ratio of the quartiles up to which a speed-up is named
Say = Callable[[str, int, int], None]
"""Called with what is done, its number and how many there are."""


class Timed(Protocol):
    """The seconds of a reduced model."""

    @property
    def time_offline(self) -> float:
        """Time to make basis and model [s]."""

    @property
    def time_setup(self) -> float:
        """Time to set up a new parameter before its run [s]."""

    @property
    def time_online(self) -> float:
        """Time of a whole run [s]."""


@dataclass(frozen=True)
class SpeedUp:
    """The full model's time over that of a reduced one."""

    again: float  # ratio at the same parameter, of the steps alone [1]
    new: float  # ratio at a new parameter, factorisation or set-up included [1]
    break_even_runs: float | None  # runs at new parameters that save the offline time [1]; None where none is saved


@dataclass(frozen=True)
class FullTimes:
    """Processor time of the full model [s]: the steps of a run alone, and the set-up with its factorisation before."""

    steps: float  # processor time of all steps of a run [s]
    factor: float  # processor time of set-up and factorisation [s]

    def against(self, p: Timed) -> SpeedUp:
        """What a reduced model gains."""
        whole, new = self.factor + self.steps, p.time_setup + p.time_online
        runs = p.time_offline / (whole - new) if whole > new else None
        return SpeedUp(self.steps / p.time_online, whole / new, runs)

    def to_json(self) -> dict[str, float]:
        """In "time" of ``result.json``."""
        return {"full_steps_median": self.steps, "full_factor_median": self.factor}


@dataclass(frozen=True)
class Spread:
    """A ratio over several rounds."""

    low: float  # lower quartile
    median: float  # median of all rounds
    high: float  # upper quartile

    def __str__(self) -> str:
        return f"{self.median:.3g} ({self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class Turns:
    """Processor time of the full model over that of a reduced one, both sides in turn."""

    again: Spread  # ratio at the same parameter, of the steps alone [1]
    new: Spread  # ratio at a new parameter, factorisation or set-up included [1]
    rounds: int  # number of rounds that the quartiles are of

    @property
    def steady(self) -> bool:
        """Whether the quartiles lie so close that a number may be named."""
        return all(x.high <= STEADY * x.low for x in (self.again, self.new))

    def sentence(self, own: float, others: str) -> str:
        """The headline: error and speed in one sentence, or that there is none. ``others``: error at new materials."""
        error = f"Its error of the deformation is {percent(own)} at the scene's parameter, {others}"
        how = f"quartiles of {self.rounds} rounds, processor time of both in turn"
        if self.steady:
            again = f"{self.again} times as fast as the full model, {self.new} at a new parameter"
            return f"{error}; it runs {again} (median and {how})."
        again, new = (f"{x.low:.3g} to {x.high:.3g} times as fast" for x in (self.again, self.new))
        return f"{error}; the times scatter too much to name a speed-up ({again}, at a new parameter {new}: {how})."


def in_turn(
    model: Model, again: Callable[[], object], new: Callable[[], object], ranks: MPI.Intracomm = MPI.COMM_SELF
) -> Turns:
    """Full model and reduced one in turn: ``again`` a run, ``new`` a new parameter and its run. Collective.

    ``ranks``: that divide the rounds, with the whole model each.
    """
    comm = model.system.layout.comm
    for call in (again, new):
        call()  # what is made once
    samples: list[tuple[float, float]] = []
    rounds = ROUNDS
    with raise_on_all_ranks(ranks):
        while len(samples) * ranks.size < rounds:
            factor, steps = _full_seconds(model)
            runs = [processor_seconds(comm, partial(_often, call)) / OFTEN for call in (again, new)]
            samples.append((steps / runs[0], (factor + steps) / runs[1]))
            rounds = comm.bcast(ROUNDS if factor + steps < PATIENCE else FULL_REPEATS)
    samples = [sample for part in ranks.allgather(samples) for sample in part]
    spreads = [Spread(*np.quantile(x, (0.25, 0.5, 0.75)).tolist()) for x in zip(*samples, strict=True)]
    return Turns(spreads[0], spreads[1], len(samples))


def _often(call: Callable[[], object]) -> None:
    for _ in range(OFTEN):
        call()


def _full_seconds(model: Model) -> tuple[float, float]:
    """Processor time of the factorisation and of all steps of one full run. Collective."""
    comm, runs = model.system.layout.comm, []
    factor = processor_seconds(comm, lambda: runs.append(RepeatableRun(replace(model, watch=Stopwatch(comm)))))
    (again,) = runs
    steps = processor_seconds(comm, lambda: again.run.advance_to(again.ts, again.run.steps))
    again.destroy()
    return factor, steps


def measured_run(model: Model, say: Say, ranks: MPI.Intracomm = MPI.COMM_SELF) -> tuple[FullRun, FullTimes]:
    """The full run, and its processor time in the median of several when it is short. Collective.

    ``ranks``: that divide the repeats, with the whole model each.
    """
    comm, times = model.system.layout.comm, list[tuple[float, float]]()
    with raise_on_all_ranks(ranks):
        first = simulate(model, RunOptions(progress=lambda run: say("full run", run.reached, run.steps)))
        repeats = comm.bcast(FULL_REPEATS if steps_seconds(first) < PATIENCE else 1)
        times = [_full_seconds(model) for _ in range(-(-repeats // ranks.size))]
    every = [each for part in ranks.allgather(times) for each in part]
    factor, steps = map(statistics.median, zip(*every, strict=True))
    return full_run(model, first), FullTimes(steps, factor)


def steps_seconds(run: Trajectory) -> float:
    """Seconds of all steps; the first is not among those measured, since it sets up the solver."""
    n = len(run.times) - 1
    return run.seconds["steps"] / max(n - 1, 1) * n


def timed(p: Timed, full: FullTimes, **more: Any) -> dict[str, Any]:
    """A row below :data:`TIMES`: a reduced model with the times ``p`` beside the full model."""
    return {"p": p, "up": full.against(p), **more}


TIMES: Columns = {
    "run [ms]": lambda r: f"{1e3 * r['p'].time_online:.2f}",
    "new [ms]": lambda r: f"{1e3 * (r['p'].time_setup + r['p'].time_online):.2f}",
    "offline [s]": "p.time_offline 3",
    "x again": "up.again .3g",
    "x new": "up.new .3g",
    "break-even": lambda r: "never" if (runs := r["up"].break_even_runs) is None else str(math.ceil(runs)),
}
"""Time of a run, of set-up and run at a new parameter, and offline; speed-ups; runs until the offline time is saved."""
