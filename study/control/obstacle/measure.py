"""Plan past the obstacles of a scene, run it on the full plant, and time its quadratic program."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Model, Stopwatch, on_root
from softgrasp.lqr import ControlError, Design, Notify, Plan, control_of, plan_control, quadratic_program
from softgrasp.lqr.design.constrained import run_plan_finite
from softgrasp.lqr.program.least_distance import nearest
from softgrasp.study.control.obstacle.result import PlannedStudy
from softgrasp.study.shell import repeated

if TYPE_CHECKING:
    from softgrasp.lqr.design.observer import ObservedControl

SOLUTIONS = 10  # of the quadratic program without a guess, behind its times
NEIGHBOURS = 100  # programs near to it that are solved from its rows
MOVED = 1e-3  # by which their gaps and limits differ from it, at most [m, N, m/s]


def planned_study(
    design: Design, model: Model, watch: Stopwatch, notify: Notify, observed: ObservedControl | None = None
) -> PlannedStudy:
    """Plan, runs and times; ``model`` may have finite strain. Collective.

    Raises ControlError, SolverError: see :func:`plan_control`.
    """
    given = control_of(design.model).constraints
    assert given is not None
    finite, margin = None, 0.0
    planned = plan_control(design, watch, notify, observed)
    if model.system.points is not None:
        with watch.stage("plan at finite strain"):
            finite = run_plan_finite(design, model, planned)
        if given.finite_strain:
            if finite.reason:
                raise ControlError(
                    f"the error of the linear plant cannot be measured: {finite.reason}; leave out "
                    "control.constraints.finite_strain"
                )
            margin = finite.error
            planned = plan_control(design, watch, notify, observed, estimated=margin)
            with watch.stage("plan at finite strain"):
                finite = run_plan_finite(design, model, planned)
    rows, cold, warm = on_root(design.problem.layout.comm, lambda: times(planned.plan))
    tick = 1 / control_of(design.model).loop.rate
    return PlannedStudy(planned, design.gain_check.optimal, rows, cold, warm, tick, finite, margin)


def times(plan: Plan) -> tuple[int, tuple[float, ...], tuple[float, ...]]:
    """Rows of the last quadratic program, and seconds cold and of programs nearby from its active rows.

    No seconds where it is soft.
    """
    G, h = quadratic_program(plan)
    if plan.depth > 0:
        return len(h), (float("nan"),), (float("nan"),)
    cold = repeated(MPI.COMM_SELF, lambda: nearest(G, h), SOLUTIONS)
    generator = np.random.default_rng(0)
    near = (h + MOVED * generator.random(len(h)) for _ in range(NEIGHBOURS))  # more room: every one has a solution
    warm = repeated(MPI.COMM_SELF, lambda: nearest(G, next(near), plan.active), NEIGHBOURS)
    return len(h), tuple(np.asarray(cold).tolist()), tuple(np.asarray(warm).tolist())
