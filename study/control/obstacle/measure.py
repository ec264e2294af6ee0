"""Plan past the obstacles of a scene, run it on the full plant, and time its quadratic program."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Stopwatch, on_root
from softgrasp.lqr import Design, Notify, Plan, plan_control, quadratic_program
from softgrasp.lqr.constrained.least_distance import nearest
from softgrasp.study.control.obstacle.result import PlannedStudy
from softgrasp.study.shell import repeated

SOLUTIONS = 10  # of the quadratic program, behind its times


def planned_study(design: Design, watch: Stopwatch, notify: Notify) -> PlannedStudy:
    """Plan, runs and times. Collective. Raises ControlError, SolverError: see :func:`plan_control`."""
    planned = plan_control(design, watch, notify)
    rows, cold, warm = on_root(design.problem.layout.comm, lambda: times(planned.plan))
    return PlannedStudy(planned, design.gain_check.optimal, rows, cold, warm)


def times(plan: Plan) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
    """Rows of the last quadratic program, and its seconds cold and from its own active rows; none where it is soft."""
    G, h = quadratic_program(plan)
    if plan.depth > 0:
        return len(h), (float("nan"),), (float("nan"),)
    cold = repeated(MPI.COMM_SELF, lambda: nearest(G, h), SOLUTIONS)
    warm = repeated(MPI.COMM_SELF, lambda: nearest(G, h, plan.active), SOLUTIONS)
    return len(h), tuple(np.asarray(cold).tolist()), tuple(np.asarray(warm).tolist())
