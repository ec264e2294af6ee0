"""Midpoint steps of a run by PETSc TS, in segments; the forward run and the closed loop share it."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from softgrasp.fem.errors import SoftgraspError, SolverError
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState
from softgrasp.fem.run.states.snapshots import NoStore
from softgrasp.fem.run.velocity import EVERY, restore_velocity
from softgrasp.fem.solve.solvers import SolverUsed


class Stepped(ABC):
    """A run whose steps PETSc TS performs.

    Args:
        layout: sizes and ownership of the unknowns.
        dt: time step [s].
        steps: number of steps of the whole run [1].
        midpoint: factored midpoint step of the tissue.
        store: memory or file that receives the states.
        solver: name of the linear solver, reason of its choice, and package.

    Attributes:
        state: state [z; v_z] of the tissue at the step ``reached`` [m; m/s].
        linear: whether the steps carry M v of a linear tissue.
        reached: number of the last step done [1].
        seconds: time of all steps by :meth:`advance_to`, without the checks [s].
        counted: number of these steps [1].
        checking: time of the checks [s].
        check_at: number of the step whose solve is checked next, -1 for none [1].
        residual: relative residual of the last solve that :meth:`check_step` checked [1].
    """

    def __init__(
        self,
        layout: BlockLayout,
        dt: float,
        steps: int,
        midpoint: TissueMidpoint,
        store: NoStore,
        solver: SolverUsed,
    ) -> None:
        self.layout, self.dt, self.steps = layout, dt, steps
        self.midpoint, self.store, self.solver = midpoint, store, solver
        self.state: TissueState = store.target(0)
        self.linear = midpoint.system.points is None and midpoint.system.frame is None
        self.reached = 0
        self.seconds, self.checking, self.counted = 0.0, 0.0, 0
        self.check_at, self.residual = -1, 0.0

    @abstractmethod
    def solve_step(self, n: int) -> None:
        """Set w and load of step n in ``midpoint``, and the hand's new state in its table. Collective."""

    @abstractmethod
    def record(self, n: int) -> None:
        """Store this rank's share of the outputs at step n."""

    def step(self, ts: Any) -> None:
        """One midpoint step, called by TS; the step number, not a summed time, picks the load. Collective."""
        n = self.reached
        self.solve_step(n)
        if n == self.check_at:
            begin = time.perf_counter()
            self.residual = self.midpoint.residual()
            self.checking += time.perf_counter() - begin
        new = self.store.target(n + 1)
        self.midpoint.advance(self.state, new)
        if (n + 1) % EVERY == 0 and self.linear:
            restore_velocity(self.midpoint, new)
        self.state = new
        self.reached = n + 1
        self.record(n + 1)

    def advance_to(self, ts: Any, step: int) -> None:
        """Let TS run up to a step number; its own time is set at the end. Collective.

        Raises SolverError: a solve failed; the message names solver, step and reason.
        """
        if step <= self.reached:
            return
        ts.setMaxSteps(step)
        before, checked = self.reached, self.checking
        begin = time.perf_counter()
        try:
            ts.solve()
        except PETSc.Error as error:
            cause = error.__cause__
            if cause is not None and not isinstance(cause, SoftgraspError):
                raise cause from error  # a bug, perhaps on this rank alone: the command must end all ranks
            if cause is None and self.midpoint.operators.whole and self.layout.comm.size > 1:
                raise  # of this rank alone, while the others step on: the command must end all ranks
            text = str(cause) if cause is not None else f"PETSc error {error.ierr}"
            t = (self.reached + 1) * self.dt
            raise SolverError(f"step {self.reached + 1} of {self.steps}, to t = {t:.6g} s: {text}") from error
        if self.reached != step:
            raise SolverError(
                f"{self.solver[0]}: TS stopped at step {self.reached} of {step} (reason {ts.getConvergedReason()})"
            )
        self.seconds += time.perf_counter() - begin - (self.checking - checked)
        self.counted += step - before
        ts.setTime(step * self.dt)

    def check_step(self, ts: Any, step: int) -> float:
        """Relative residual [1] of the solve of a step up to which TS runs. Collective.

        The residual needs the right-hand side, which the end of the step overwrites; so the check is part of the step,
        but not of its time. A step that is behind already is not checked again: the residual is that of the last check.
        Raises SolverError: a solve failed or missed its tolerance.
        """
        self.check_at = step - 1
        self.advance_to(ts, step)
        self.check_at = -1  # a run may be set back to its start
        return self.residual


def make_ts(run: Stepped) -> Any:
    """PETSc TS around a run. Collective.

    TS copies its solution before every step, for a rollback that is never needed here. Of z and v that would be a pass
    over memory, so the state stays with the run, and TS has one number a rank.
    """
    ts = PETSc.TS().createPython(run, comm=run.layout.comm)
    ts.setTimeStep(run.dt)
    ts.setMaxTime(1e300)  # stepping by time would make one step too many or change the last one
    ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
    counter = PETSc.Vec().createWithArray(np.zeros(1), comm=run.layout.comm)
    ts.setSolution(counter)
    counter.destroy()
    return ts
