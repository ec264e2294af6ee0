"""The full-order plant under feedback, run by PETSc TS with the midpoint step of the forward run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from mpi4py import MPI

from softgrasp.fem.columns import Columns, hand_of
from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.hand import HandStep
from softgrasp.fem.run.ledger import Ledger
from softgrasp.fem.run.make import make_midpoint, make_store
from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.run.states.trajectory import FullOrderRun
from softgrasp.fem.run.stepping import Stepped, make_ts
from softgrasp.fem.shown import Card, Shown, amount, counted, drawn, listed
from softgrasp.fem.solve.solvers import Reproducible, SolverUsed, choose_solver
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.cost import accumulated_cost
from softgrasp.lqr.loop.drive import FiniteDrive, GainDrive, HeldDrive, ImplicitDrive, LoopDrive
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import Target, hand_target, rest

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model
    from softgrasp.fem.run.contact.general import Contact
    from softgrasp.fem.run.contact.record import ContactRecord
    from softgrasp.fem.strain.newton import NewtonFigures
    from softgrasp.lqr.loop.touching import TouchingDrive

CHUNKS = 50  # segments of a run without frames: progress, and the check that the numbers are finite


@dataclass(frozen=True)
class LoopOptions:
    """Snapshots, observers and the end of a run."""

    snapshots: Literal["none", "memory", "hdf5"] = "none"  # storage of the states
    every: int = 1  # steps between two snapshots
    directory: Path = Path("out")  # folder of snapshots in HDF5
    frames: Sequence[int] = ()  # steps at which ``frame`` is called
    # observer of ``run.state``, ``run.drive.q``, ``run.drive.v``, ``run.reached`` and ``run.dt``, as in a forward run
    frame: Callable[[Any], None] | None = None
    progress: Callable[[Any], None] | None = None  # observer of ``run.reached`` and ``run.steps``, between segments
    most: float = np.inf  # cost J at which the run stops as divergent
    touching: bool = False  # whether the tissue meets the obstacles of the loop's scene


@dataclass(frozen=True, repr=False)
class LoopTrajectory(Shown, FullOrderRun):
    """Result of a closed-loop run; small arrays are on every rank."""

    LOAD: ClassVar[str] = "inputs"
    """Field of the force on the hand."""
    times: Array
    """Time grid [s], (steps + 1,)."""
    q_s: Array
    """Displacement of the hand [m, rad], (steps + 1, n_s)."""
    v_s: Array
    """Velocity of the hand [m/s, rad/s], (steps + 1, n_s)."""
    inputs: Array
    """Input u of each step [N, N m], (steps, n_s)."""
    outputs: Array
    """y = C_s q_s + C_z' z [m, rad], (steps + 1, p)."""
    outputs_rigid: Array
    """C_s q_s, the outputs without deformation [m, rad], (steps + 1, p)."""
    columns: Columns
    """Label and unit of each output, p."""
    energy: Array
    """Energy of the tissue relative to the hand at each time, as of a forward run [J], (steps + 1,)."""
    dissipated: Array
    """Energy dissipated by damping up to each time [J], (steps + 1,)."""
    cost: Array
    """Cost J up to each grid point, (steps + 1,)."""
    final: PlantState
    """State at the end."""
    snapshots: Snapshots | None
    """Stored states; None where none were requested."""
    saturated: float
    """Share of the steps with an input at its limit."""
    residuals: tuple[float, float]
    """Relative residuals of the first and the last solve."""
    solver: SolverUsed
    """Name, package and reason of the linear solver."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time of "factor" (with the responses) and "steps" on the slowest rank [s]."""
    newton: NewtonFigures | None = None
    """Convergence of the steps of finite strain; None where the steps are linear."""
    energy_drift: float = 0.0
    """Energy at the end that neither loads, contact nor damping explain, over the largest energy or work [1]."""
    contact: ContactRecord | None = None
    """Forces and gaps of obstacles; None in a run that meets none."""

    def card(self) -> Card:
        """Steps, cost, where the hand ends, saturation."""
        hand = hand_of(self.q_s.shape[1], self.output_names)
        rows = (
            ("time", f"{counted(len(self.times) - 1, 'step')} to {amount(self.times[-1], 's')}"),
            ("outputs", listed(self.output_names)),
            ("cost", amount(self.cost[-1])),
            ("hand at the end", listed(amount(x, c.unit) for x, c in zip(self.q_s[-1], hand, strict=True))),
            ("steps at a limit", f"{100 * self.saturated:.3g} %"),
        )
        return Card("Trajectory of the closed loop", rows)

    @property
    def attributes(self) -> dict[str, Any]:
        """Cost and share of the steps with an input at its limit."""
        return {"cost": float(self.cost[-1]), "saturated": self.saturated}

    def plot(self) -> Any:
        """Outputs and inputs over time, as ``matplotlib`` figure."""
        return drawn("loop", self)


class ClosedLoop:
    """E x' = A x + B u + F g under u = u_bar + K (x - x_bar), in hand-relative coordinates.

    The matrix of the midpoint step [HLW06] is factored once, here; gains, targets and actuation change with the run.

    Args:
        problem: plant, outputs and weights.
        dt: time step [s].
        solver: cholesky, mumps, cg, stars or auto.
        rtol: relative residual at which cg or stars ends a step [1]; None for 1e-8 with cg, 1e-4 with stars.
        reproducible: see :func:`softgrasp.fem.solve.solvers.factor_on_every_rank`.
        scene: model of the same mesh and hand with ``effects.obstacles``, which the tissue meets in runs with
            ``touching``; None for none.

    Raises:
        ControlError: dt is not a positive number.
        SolverError: the factorisation fails.

    >>> import softgrasp as sg
    >>> problem = sg.problem(sg.build("paper_lqr", ["tissue.cells=[2, 4]"]))
    >>> move = sg.ClosedLoop(problem, dt=0.5).run(sg.solve(problem).gain, target=[5.0, 3.0], steps=600)
    >>> bool(abs(move.q_s[-1] - [5, 3]).max() < 0.01)
    True
    """

    def __init__(
        self,
        problem: RiccatiProblem,
        dt: float,
        solver: str = "auto",
        rtol: float | None = None,
        reproducible: Reproducible = "auto",
        scene: Model | None = None,
    ) -> None:
        if not (np.isfinite(dt) and dt > 0):
            raise ControlError(f"dt = {dt} s must be a positive number")
        self.problem, self.dt, self.scene = problem, dt, scene
        # its responses are columns of a factor
        name, reason = choose_solver(problem.layout, solver, contrast=problem.system.contrast, direct=True)
        begin = time.perf_counter()
        self.midpoint = make_midpoint(problem.system, dt, name, rtol, reproducible, scene is not None)
        self.solver = self.midpoint.solver.used(reason)
        try:
            self.plant = HandStep(problem.system, self.midpoint, responses=True)
        except Exception:
            self.midpoint.destroy()
            raise
        self.factor_seconds = problem.layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX)

    def run(
        self,
        gain: Gain,
        target: Target | Sequence[float] | Array,
        steps: int,
        actuation: Actuation | None = None,
        start: PlantState | None = None,
        options: LoopOptions | None = None,
    ) -> LoopTrajectory:
        """Run for some steps of the implicit midpoint rule. Collective.

        Args:
            gain: u = u_bar + K (x - x_bar).
            target: where the loop goes, or the displacement of the hand there, see
                :func:`softgrasp.lqr.plant.target.hand_target`.
            actuation: sampling, delay, limits; default none of them.
            start: x(0); default at rest with the hand at 0, in equilibrium under gravity.
            options: snapshots, observers and the end of the run.

        Raises:
            ControlError: the target or the actuation does not fit, or the implicit input of a step is singular.
            SolverError: a solve failed, the loop diverged, or its cost leaves the bound; the message names the time.
        """
        actuation, options = actuation or Actuation(), options or LoopOptions()
        if not isinstance(target, Target):
            target = hand_target(self.problem, np.asarray(target, dtype=np.float64))
        implicit = ImplicitDrive if self.problem.system.points is None else FiniteDrive
        kind = HeldDrive if actuation.ticks(self.dt) else implicit
        drive: GainDrive = kind(self.plant, gain, target, actuation, steps)
        start = start or rest(self.problem.system)
        if not options.touching:
            run = LoopRun(self, drive, start, steps, options, target)
            run.execute()
            return run.trajectory(actuation)
        from softgrasp.lqr.loop.touching import touching_drive  # only scenes with contact pay for it

        touching = touching_drive(self.scene, drive, steps)
        try:
            run = LoopRun(self, touching, touching.settled(start), steps, options, target)
            run.execute()
            return run.trajectory(actuation)
        finally:
            touching.release()

    def of_differences(self) -> ClosedLoop:
        """The same factor for differences of two states, which feel no gravity; no own loads act. Collective."""
        system = replace(self.problem.system, gravity=None, hand_weight=False)
        result = copy(self)
        result.problem, result.plant = replace(self.problem, system=system), HandStep(system, self.midpoint, True)
        return result

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.midpoint.destroy()


class LoopRun(Stepped):
    """One closed-loop run in progress: the TS context, with the fields that observers of a forward run read."""

    def __init__(
        self,
        loop: ClosedLoop,
        drive: LoopDrive | TouchingDrive,
        start: PlantState,
        steps: int,
        options: LoopOptions,
        target: Target,
    ) -> None:
        if steps < 1:
            raise ControlError(f"steps = {steps} must be at least 1")
        problem = loop.problem
        store = make_store(problem.system, options.snapshots, steps, options.every, options.directory, "")
        super().__init__(problem.layout, loop.dt, steps, loop.midpoint, store, loop.solver)
        self.loop, self.problem, self.drive, self.options, self.target = loop, problem, drive, options, target
        n = problem.layout.n_local
        self.state.z.array_w[:] = start.z
        self.state.v.array_w[:] = start.v_z
        drive.q[0], drive.v[0] = start.q_s, start.v_s
        self.rows = np.flatnonzero(problem.C_z.any(axis=1)) if n else np.zeros(0, dtype=int)
        self.C_rows = np.ascontiguousarray(problem.C_z[self.rows].T)
        self.seen = np.zeros((steps + 1, len(self.rows)))
        self.residual_first = self.residual_last = 0.0
        self.paid, self.paid_until = 0.0, 0
        self.midpoint.dissipated = 0.0
        self.contact: Contact | None = getattr(drive, "contact", None)
        self.midpoint.start(self.state)
        if self.contact is not None:
            self.contact.table.film(store.steps)
            self.contact.start(self.state, drive.q[0])
        # two microseconds a step
        self.ledger = Ledger(self.midpoint, np.zeros((steps, problem.layout.n_s)), self.contact)
        self.ledger.start(self.state)
        self.record(0)

    def solve_step(self, n: int) -> None:
        """Feedback and one solve. Collective."""
        self.drive.solve(n, self.state)

    def record(self, n: int) -> None:
        """Keep the entries of z that this rank gives to the outputs, and its share of work and loss."""
        if len(self.rows):
            self.seen[n] = self.state.array[self.rows]
        if n:
            self.ledger.loads[n - 1] = self.midpoint.c
            self.ledger.record(n)

    def execute(self) -> None:
        """Let TS run to the last step, in segments. Collective.

        Raises SolverError: a solve failed, the state is no longer finite, or the cost leaves its bound.
        """
        frames = {int(n) for n in self.options.frames} if self.options.frame is not None else set()
        ends = set(np.linspace(0, self.steps, min(CHUNKS, self.steps) + 1).round().astype(int).tolist())
        boundaries = sorted(n for n in ends | frames | {1} if 0 < n <= self.steps)
        ts = make_ts(self)
        try:
            if self.options.frame is not None and 0 in frames:
                self.options.frame(self)
            for end in boundaries:
                while self.reached < end:
                    before = self.reached
                    goal = min(end, self.store.limit(self.reached))
                    if goal in (1, self.steps):
                        self.residual_last = self.check_step(ts, goal)
                    else:
                        self.advance_to(ts, goal)
                    self.store.flush(self.reached)
                    if self.contact is not None:
                        self.contact.check_hand(self.drive.q, before, self.reached + 1)
                    if goal == 1:
                        self.residual_first = self.residual_last
                self._check_finite()
                self._check_cost()
                if self.options.frame is not None and end in frames:
                    self.options.frame(self)
                if self.options.progress is not None:
                    self.options.progress(self)
        finally:
            ts.destroy()

    def _check_finite(self) -> None:
        n = self.reached
        # far above any state of use, far below overflow of the squares in cost and energy
        size = max(float(np.abs(self.drive.q[n]).max()), float(np.abs(self.state.array).max(initial=0.0)))
        fine = bool(np.isfinite(size)) and size < 1e100
        if not self.problem.layout.comm.allreduce(fine, MPI.LAND):
            raise SolverError(
                f"the closed loop diverged before t = {n * self.dt:.6g} s; this gain does not stabilise the plant "
                "at this rate, delay and limit"
            )

    def _check_cost(self) -> None:
        if not np.isfinite(self.options.most):
            return
        part = float(self._cost(self._outputs(self.paid_until, self.reached), self.paid_until)[-1])
        self.paid += self.problem.layout.comm.bcast(part)  # the same bits on every rank: they decide when all stop
        self.paid_until = self.reached
        if not self.paid <= self.options.most:
            raise SolverError(
                f"the closed loop diverges: at t = {self.reached * self.dt:.6g} s its cost is {self.paid:.3g}, and no "
                f"loop that works has more than {self.options.most:.3g}; raise control.loop.rate or the limit, leave "
                "out the delay, or lower control.Q"
            )

    def _outputs(self, first: int, last: int) -> Array:
        """At the grid points from first to last. Collective."""
        part = slice(first, last + 1)
        rigid = self.drive.q[part] @ self.problem.C_s.T
        return np.asarray(rigid + total(self.problem.layout.comm, self.seen[part] @ self.C_rows.T))

    def _cost(self, outputs: Array, first: int) -> Array:
        """From the grid point ``first`` on, as far as there are outputs."""
        u = self.drive.u[first : first + len(outputs) - 1] - self.target.u
        return accumulated_cost(outputs - self.target.y, u, self.problem.Q, self.problem.R, self.dt)

    def trajectory(self, actuation: Actuation) -> LoopTrajectory:
        """Gather the small results; the tissue stays distributed. Collective."""
        problem, drive = self.problem, self.drive
        comm, n = problem.layout.comm, problem.layout.n_local
        rigid, outputs = drive.q @ problem.C_s.T, self._outputs(0, self.steps)
        energy, dissipated = self.ledger.over_time()
        times, array = np.asarray(self.dt * np.arange(self.steps + 1), dtype=np.float64), self.state.array
        return LoopTrajectory(
            times=times,
            q_s=drive.q,
            v_s=drive.v,
            inputs=drive.u,
            outputs=outputs,
            outputs_rigid=rigid,
            columns=problem.columns,
            energy=energy,
            dissipated=dissipated,
            cost=self._cost(outputs, 0),
            final=PlantState(drive.q[-1].copy(), drive.v[-1].copy(), array[:n].copy(), array[n:].copy()),
            snapshots=self.store.finish(times, drive.q, drive.v),
            saturated=actuation.saturated(drive.u),
            residuals=(self.residual_first, self.residual_last),
            solver=self.solver,
            newton=self.midpoint.figures(),
            energy_drift=self.ledger.drift(self.state, self.steps),
            contact=None if self.contact is None else self.contact.record(),
            seconds={"factor": self.loop.factor_seconds, "steps": comm.allreduce(self.seconds, MPI.MAX)},
        )
