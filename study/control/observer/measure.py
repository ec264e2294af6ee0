"""Design the observer of a scene and time its tick. Collective."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem.model.build import Stopwatch
from softgrasp.fem.petsc import Array, rows_on_all
from softgrasp.lqr.design.feedback import Design
from softgrasp.lqr.design.observer import ObservedControl, observe
from softgrasp.lqr.loop.controller import Controller
from softgrasp.study.control.observer.result import ObservedStudy
from softgrasp.study.shell.timing import repeated

TICKS = 100  # tens of ticks behind the time of one


def observed_study(design: Design, watch: Stopwatch) -> ObservedStudy:
    """Observer, judgement and time of a tick. Collective. Raises ControlError: see :func:`observe`."""
    found, comm = observe(design, watch), design.problem.layout.comm
    tick = comm.bcast(_tick_seconds(found.controller))
    return ObservedStudy(found, tick, _nodes(design, found), design.problem.names)


def _tick_seconds(controller: Controller) -> float:
    """Median seconds of a tick of ten with all samples."""
    own = controller.observer
    assert own is not None
    at_rest, y = np.zeros(controller.n_s), np.zeros(own.others)
    ten = repeated(MPI.COMM_SELF, lambda: [controller.step(at_rest, at_rest, y) for _ in range(10)], TICKS)
    controller.reset()
    return float(np.median(ten)) / 10


def _nodes(design: Design, found: ObservedControl) -> Array | None:
    """Least, median and largest deviation of a node of the tissue by the full filter. Collective."""
    if found.full is None:
        return None
    layout = design.problem.layout
    sd = np.linalg.norm(rows_on_all(layout.comm, found.full.sd.reshape(-1, layout.dimension)), axis=1)
    return np.array([sd.min(), np.median(sd), sd.max()])
