"""Seconds of calls on the slowest rank, in turn, their medians, and how they grow with a size."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Model, PETSc, Run, RunOptions, make_ts

TICK = 0.01  # s, by which the coarsest systems count processor time


def timed(comm: MPI.Intracomm, call: Callable[[], Any]) -> float:
    """Seconds of a call on the slowest rank, after a collection of garbage. Collective."""
    gc.collect()
    return repeated(comm, call, 1)[0]


def repeated(comm: MPI.Intracomm, call: Callable[[], Any], repeats: int, seconds: float = math.inf) -> list[float]:
    """Seconds of a call on the slowest rank, once and again while it was called fewer times and took less in all.

    Collective. Garbage is not collected between the calls, which takes longer than short ones do.
    """
    times: list[float] = []
    while not times or (len(times) < repeats and sum(times) < seconds):
        comm.Barrier()
        begin = time.perf_counter()
        call()
        times.append(float(comm.allreduce(time.perf_counter() - begin, MPI.MAX)))
    return times


def median_seconds(comm: MPI.Intracomm, call: Callable[[], Any], repeats: int) -> float:
    """Median seconds of a call on the slowest rank. Collective."""
    return statistics.median(repeated(comm, call, repeats))


def processor_seconds(comm: MPI.Intracomm, call: Callable[[], Any]) -> float:
    """Processor time of a call on the rank that takes most; other programs hardly change it. Collective.

    Where the system counts it in ticks, a call within one has the seconds of the clock, at most those of a tick.
    """
    comm.Barrier()
    begin, clock = time.process_time(), time.perf_counter()
    call()
    spent, passed = time.process_time() - begin, time.perf_counter() - clock
    return float(comm.allreduce(spent if spent > 0 else min(passed, TICK), MPI.MAX))


def median_processor_seconds(comm: MPI.Intracomm, call: Callable[[], Any], repeats: int) -> float:
    """Median of :func:`processor_seconds`. Collective."""
    return statistics.median(processor_seconds(comm, call) for _ in range(repeats))


def warm(count: int) -> int:
    """Steps before the timed ones: the method before left the caches full of its own factor."""
    return max(1, count // 20)


def interleave(
    methods: Mapping[str, Callable[[], float]], repeats: int, most: Mapping[str, int] | None = None
) -> dict[str, list[float]]:
    """Call every method once a repeat, in rotated order, so that noise hits all alike; what each returned.

    Collective if the methods are. ``most``: calls of each after which it is left out; None leaves out none.
    """
    samples: dict[str, list[float]] = {name: [] for name in methods}
    for i in range(repeats):
        for name in rotated(methods, i):
            if most is None or i < most[name]:
                samples[name].append(methods[name]())
    return samples


def rotated(names: Iterable[str], i: int) -> list[str]:
    """The order of round i: each name is once the first."""
    order = list(names)
    shift = i % len(order)
    return order[shift:] + order[:shift]


def medians(samples: Mapping[str, list[float]]) -> dict[str, float]:
    """Median of each list."""
    return {name: float(statistics.median(values)) for name, values in samples.items()}


def power_law(x: Sequence[float | None], y: Sequence[float | None]) -> float | None:
    """Exponent of y ~ x^power by least squares in logarithms, over pairs of finite positive numbers.

    None where these have fewer than two different x.
    """
    a, b = np.array(x, dtype=float), np.array(y, dtype=float)
    good = (a > 0) & (b > 0) & np.isfinite(a) & np.isfinite(b)
    if len(set(a[good])) < 2:
        return None
    return float(np.polyfit(np.log(a[good]), np.log(b[good]), 1)[0])


class RepeatableRun:
    """A run that can be taken back to its start, to time its steps any number of times. Collective."""

    def __init__(self, model: Model) -> None:
        self.comm: MPI.Intracomm = model.system.layout.comm
        self.run = Run(model, RunOptions())
        self.ts = make_ts(self.run)
        self.run.start()
        self.begin = self.run.state.array.copy()

    def rewind(self) -> None:
        """Back to step 0. Collective."""
        run = self.run
        run.state.array[:] = self.begin
        run.state.z.stateIncrease()
        run.state.v.stateIncrease()
        run.midpoint.start(run.state)
        run.midpoint.dissipated = 0.0
        if run.contact is not None:
            run.contact.start(run.state, run.drive.q[0])
        run.reached = 0
        self.ts.setStepNumber(0)

    def seconds_per_step(self, count: int) -> float:
        """Seconds of a step on the slowest rank, over at least ``count`` steps. Collective."""
        run, before, done = self.run, self.run.seconds, 0
        while done < count:
            self.rewind()
            n = min(run.steps, count - done)
            self.comm.Barrier()
            run.advance_to(self.ts, n)
            done += n
        return float(self.comm.allreduce(run.seconds - before, MPI.MAX)) / done

    def flops(self) -> float:
        """Operations that PETSc counts in one step, over all ranks. Collective."""
        self.rewind()
        few, many = min(1, self.run.steps), min(11, self.run.steps)
        self.run.advance_to(self.ts, few)
        before = PETSc.Log.getFlops()
        self.run.advance_to(self.ts, many)
        return float(self.comm.allreduce(PETSc.Log.getFlops() - before)) / max(many - few, 1)

    def destroy(self) -> None:
        """Free the PETSc objects. Collective."""
        self.ts.destroy()
        self.run.midpoint.destroy()
