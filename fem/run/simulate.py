"""PETSc TS runs the midpoint step, in segments; between them come progress, frames, checkpoints and interrupts."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.checksums import AGAIN
from softgrasp.fem.errors import (
    CheckpointError,
    Interrupted,
    Paused,
    ResourceError,
    SceneError,
    SolverError,
    raise_on_all_ranks,
)
from softgrasp.fem.model.build import Model, checked_model
from softgrasp.fem.model.memory import solver_of
from softgrasp.fem.model.outputs import Output, make_outputs
from softgrasp.fem.owned import locked
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.interrupt import interruptible
from softgrasp.fem.run.ledger import Ledger
from softgrasp.fem.run.make import make_midpoint, make_store
from softgrasp.fem.run.motion import Force, ForceDrive, TableDrive, force_taken, force_values, free_table
from softgrasp.fem.run.states.checkpoint import RestartState, read_checkpoint, write_checkpoint
from softgrasp.fem.run.states.frames import boundaries, output_recorders
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.run.stepping import Stepped, make_ts
from softgrasp.fem.solve.statics import equilibrium
from softgrasp.fem.solve.stiffness import resting_solves, static_solver

if TYPE_CHECKING:
    from softgrasp.fem.run.contact.general import Contact
    from softgrasp.fem.run.contact.step import ContactDrive
    from softgrasp.fem.run.frame.drive import TurningDrive

Observer = Callable[["Run"], None]
"""Called between segments and at every frame; collective, may raise to end the run."""


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that are no keys of the scene."""

    directory: Path = Path("out")  # folder of restart files and streamed snapshots
    resume: bool = False  # whether to continue from the restart file in ``directory``
    until: int | None = None  # number of the step after which to write a restart file and stop; None runs to the end
    progress: Observer | None = None  # call with the :class:`Run` about five times a second
    frame: Observer | None = None  # call with the run at the start, the end and ``output.frames`` steps between
    begin: Observer | None = None  # call with the run before the first step, after a restart file was read
    keep: Observer | None = None  # call with the run before every restart file, to add files to :attr:`Run.beside`
    settle: Callable[[float], None] | None = None  # call with the share of its digits that an iterated equilibrium has
    few: int | None = None  # number of states kept in memory with output.snapshots = "auto" [1]; None keeps all


class Run(Stepped):
    """One forward run in progress.

    ``force``: feedback force on the hand; None for the scene's motion.

    Attributes:
        name: identifier in the names of the files of this run and of those that it resumes; unique.
        begun: number of the step at which this run was started or resumed [1].
        legs: number of the step at which each of the resumed runs began, this one last.
        beside: SHA-256 of each further file in the checkpoint's folder, by name; that of rank 0 is written.
    """

    def __init__(self, model: Model, options: RunOptions, force: Force | None = None) -> None:
        scene, system = model.scene, model.system
        self.model, self.end, self.settle = model, scene.time_end, options.settle
        dt, (name, reason) = self.end / scene.time.steps, solver_of(scene, system.layout)
        with model.watch.stage("factor"):
            grid = scene.time
            midpoint = make_midpoint(system, dt, name, grid.rtol, grid.reproducible, scene.effects.obstacles)
        self.name: str = system.layout.comm.bcast(secrets.token_hex(6))
        kept, fresh = scene.output, None if options.resume else self.name
        store = make_store(system, kept.snapshots, scene.time.steps, kept.every, options.directory, fresh, options.few)
        super().__init__(system.layout, dt, scene.time.steps, midpoint, store, midpoint.solver.used(reason))
        self.outputs: tuple[Output, ...] = make_outputs(scene, system)
        self.local_outputs = np.zeros((self.steps + 1, sum(o.size for o in self.outputs)))
        self.points, self.regions = output_recorders(self.outputs, self.local_outputs)
        self.drive: TableDrive | ForceDrive | ContactDrive | TurningDrive
        self.turning: TurningDrive | None = None
        self.contact: Contact | None = None
        if system.frame is not None:
            from softgrasp.fem.run.frame.drive import make_turning_drive  # only such scenes pay for it

            self.drive = self.turning = make_turning_drive(system, scene, midpoint, force)
        elif scene.effects.obstacles:
            from softgrasp.fem.run.contact.step import make_contact  # only scenes with contact pay for it

            self.drive, self.contact = make_contact(model, midpoint, self._make_drive(force), self.steps)
            self.contact.table.film(store.steps)
        else:
            self.drive = self._make_drive(force)
        self.ledger = Ledger(midpoint, self.drive.c, self.contact)
        self.milestones = set(np.linspace(0, self.steps, 11).round().astype(int).tolist())
        self.residual_first = self.residual_last = 0.0
        self.begun, self.legs = 0, [0]
        self.beside: dict[str, str] = {}

    def _make_drive(self, force: Force | None) -> TableDrive | ForceDrive:
        scene, system = self.model.scene, self.model.system
        if force is None and (scene.motion.drive == "motion" or not system.two_way):
            return TableDrive(system, *free_table(system, scene, self.dt))
        zero = np.zeros(system.layout.n_s)
        if force is not None:
            return ForceDrive(system, force, self.midpoint, self.steps, zero, zero)
        u = force_values(scene, len(zero), system.M_hand)
        return ForceDrive(system, lambda n, t, q, v: u[n], self.midpoint, self.steps, zero, zero)

    def solve_step(self, n: int) -> None:
        """Load of the hand's motion, or its force, and one solve. Collective."""
        self.drive.solve(n, self.midpoint, self.state)

    def record(self, n: int) -> None:
        """Store this rank's share of the outputs at step n, and of what changes the energy."""
        self.ledger.record(n)
        z = self.state.array
        for rows, share in self.points:
            share[n] = z[rows]
        for dofs, share in self.regions:
            share[n] = z[dofs].sum(axis=0)

    def start(self) -> None:
        """Initial state: undeformed, or in equilibrium. Collective."""
        if self.model.scene.time.start == "equilibrium":
            with self.model.watch.stage("equilibrium"):
                self.state.z.array_w[:] = self._equilibrium()
        self.midpoint.start(self.state)
        if self.contact is not None:
            self.contact.start(self.state, self.drive.q[0])
        self.record(0)
        self.ledger.start(self.state)
        self.watch_energy()

    def _equilibrium(self) -> Array:
        """Static displacement against the hand, (n_local,) [m]. Collective."""
        time, system = self.model.scene.time, self.model.system
        if self.contact is not None:
            from softgrasp.fem.run.contact.rest import resting  # only scenes with contact pay for it

            return resting(self.contact, self.drive.q[0], time)
        if self.turning is not None:
            system = self.turning.as_it_hangs()
        solves = resting_solves(system.layout.n_e, system.layout.dimension)
        return equilibrium(system, static_solver(system, time.solver, solves), time, self.settle)

    def take(self, ts: Any, step: int, check: bool = False) -> None:
        """Step up to a number, and see that the forces on the way were finite. Collective.

        Raises SolverError: a solve failed or missed its tolerance, or a force is not finite.
        """
        before = self.reached
        try:
            if check:
                self.residual_last = self.check_step(ts, step)
            else:
                self.advance_to(ts, step)
        except SolverError:
            self._check_force(before)  # which may be why
            raise
        self._check_force(before)

    def _check_force(self, begin: int) -> None:
        with raise_on_all_ranks(self.layout.comm):  # a callable may differ between the ranks
            self.drive.check(begin, self.reached + 1)

    def force(self) -> Array:
        """Force on the hand in each step, see :class:`Trajectory`. Collective."""
        if self.drive.u is not None:
            return self.drive.u
        pulls = self.ledger.pulls
        pulls = pulls if self.midpoint.operators.whole else total(self.layout.comm, pulls)
        if self.turning is not None:
            return self.turning.wrench(pulls)
        kicks, hand = (0.0, 0.0) if self.contact is None else (self.contact.table.kick, self.contact.table.hand)
        return force_taken(self.model.system, pulls[1:], self.drive.v, self.drive.c, self.dt, kicks) - hand

    def watch_energy(self) -> None:
        """Stop a run whose energy is no longer finite. Collective."""
        if not np.isfinite(self.midpoint.energy(self.state)):
            raise SolverError(
                f"{self.solver[0]}: the energy is not finite at step {self.reached}; check material, dt and force"
            )

    def restart_state(self) -> RestartState:
        """State of this rank for a restart; views, not copies."""
        midpoint, ledger, n = self.midpoint, self.ledger, self.reached
        return RestartState(
            run=self.name,
            step=n,
            legs=self.legs,
            beside=self.beside,
            state=self.state.array,
            low=midpoint.operators.leave(midpoint.low.array_r),
            r=midpoint.operators.leave(midpoint.r.array_r),
            pending=midpoint.pending,
            hand_q=self.drive.q[: n + 1],
            hand_v=self.drive.v[: n + 1],
            outputs=self.local_outputs[: n + 1],
            snapshots=self.store.kept(n),
            loads=self.drive.c[:n],
            pulls=ledger.pulls[: n + 1],
            taken=None if ledger.taken is None else ledger.taken[: n + 1],
            energies=np.array([midpoint.dissipated, ledger.first]),
            residual_first=self.residual_first,
            forces=None if self.drive.u is None else self.drive.u[:n],
            **midpoint.restart_arrays(),
        )

    def restore(self, saved: RestartState) -> None:
        """Go back to where a run was stopped. Collective.

        Raises CheckpointError: the state is of another mesh numbering, or the streamed snapshots do not fit to it.
        """
        n, midpoint, ledger = saved.step, self.midpoint, self.ledger
        with raise_on_all_ranks(self.layout.comm):
            self.store.restore(saved.snapshots, n, saved.run)
            if len(saved.r) != len(midpoint.r_array):
                raise CheckpointError(
                    f"the restart file contains {len(saved.r)} rows of the right-hand side, this run "
                    f"{len(midpoint.r_array)}; {AGAIN}"
                )
        self.name, self.beside = saved.run, saved.beside
        self.state = self.store.target(n)
        self.state.array[:] = saved.state
        midpoint.low.array_w[:] = midpoint.operators.enter(saved.low)
        midpoint.r.array_w[:] = midpoint.operators.enter(saved.r)
        midpoint.pending = saved.pending
        self.drive.q[: n + 1], self.drive.v[: n + 1] = saved.hand_q, saved.hand_v
        self.local_outputs[: n + 1], ledger.pulls[: n + 1] = saved.outputs, saved.pulls
        self.drive.c[:n] = saved.loads
        if ledger.taken is not None and saved.taken is not None:
            ledger.taken[: n + 1] = saved.taken
        if self.drive.u is not None and saved.forces is not None:
            self.drive.u[:n] = saved.forces
        midpoint.dissipated, ledger.first = saved.energies[:2].tolist()
        self.residual_first, self.reached, self.begun = saved.residual_first, n, n
        self.legs = [*(leg for leg in saved.legs if leg < n), n]
        for vector in (self.state.z, self.state.v, midpoint.r):
            vector.stateIncrease()
        if self.turning is not None:
            self.turning.adopt(n, midpoint)
        midpoint.adopt(self.state)
        if self.contact is not None:
            self.contact.start(self.state, self.drive.q[n], n)
        midpoint.restore(saved.solver_rows, saved.solver_numbers)

    def trajectory(self) -> Trajectory:
        """Gather the small results; the tissue stays distributed. Collective."""
        outputs, comm = self.outputs, self.layout.comm
        rigid = self.drive.q @ np.vstack([o.C_s for o in outputs]).T
        y = total(comm, self.local_outputs * np.concatenate([np.full(o.size, o.weight) for o in outputs]))
        rigid, y = (rigid, rigid + y) if self.turning is None else self.turning.world(outputs, rigid, y)
        times = self.end * np.arange(self.steps + 1) / self.steps
        snapshots = self.store.finish(times, self.drive.q, self.drive.v)
        energy, dissipated = self.ledger.over_time()
        spent = comm.allreduce(self.seconds, MPI.MAX)
        seconds = {**self.model.watch.seconds, "steps": spent, "per_step": spent / max(self.counted, 1)}
        return Trajectory(
            times=times,
            q_s=self.drive.q,
            v_s=self.drive.v,
            outputs=y,
            outputs_rigid=rigid,
            columns=tuple(column for o in outputs for column in o.columns),
            snapshots=snapshots,
            energy=energy,
            dissipated=dissipated,
            final=self.state.array.copy(),
            energy_drift=self.ledger.drift(self.state, self.reached),
            residuals=(self.residual_first, self.residual_last),
            solve_error=self.midpoint.solve_error(),
            solver=self.solver,
            seconds=seconds,
            steps_timed=self.counted,
            force=self.force(),
            newton=self.midpoint.figures(),
            contact=None if self.contact is None else self.contact.record(),
        )


def simulate(model: Model, options: RunOptions | None = None, force: Force | None = None) -> Trajectory:
    """Run a scene from its start to its end by the implicit midpoint rule [HLW06]. Collective.

    With z the displacement relative to the hand's rigid motion, s = 2 / dt, w = z_mid - z_n and h the load, one solve a
    step with one factor:

        (K + s D + s^2 M) w = h_mid - K z_n + s M v_n,    z_{n+1} = z_n + 2 w,    v_{n+1} = 2 s w - v_n.

    Args:
        model: from :func:`softgrasp.fem.model.build.build`.
        options: files, resume and observers.
        force: instead of the scene's motion, called as force(n, t_mid, q_s, v_s) for the force on the hand in step n,
            (n_s,) [N, N m]; q_s and v_s are the hand at the start of the step.

    Returns:
        The trajectory: times, hand and outputs on every rank, tissue states distributed.

    Raises:
        SolverError: a solve failed or missed its tolerance.
        ResourceError: the snapshots do not fit.
        CheckpointError: resume was requested and no fitting restart file is there.
        Interrupted: Ctrl-C or SIGTERM; Paused: ``until``; the message names the restart file.
        SceneError: another run has locked the folder into which this one would write.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=60"])
    >>> sg.simulate(model).energy_drift < 1e-12
    True
    """
    options, kept = options or RunOptions(), checked_model(model).scene.output
    if kept.snapshots != "hdf5" and not (kept.checkpoint_every or options.resume or options.until is not None):
        return _simulate(model, options, force)
    with locked(model.system.layout.comm, options.directory):
        return _simulate(model, options, force)


def _simulate(model: Model, options: RunOptions, force: Force | None) -> Trajectory:
    run = Run(model, options, force)
    ts = make_ts(run)
    try:
        if options.resume:
            run.restore(read_checkpoint(model.scene, run.layout, options.directory / "checkpoint"))
            ts.setStepNumber(run.reached)
        else:
            run.start()
        if options.begin is not None:
            options.begin(run)
        with interruptible(run.layout.comm.rank == 0) as stop:
            _run_segments(run, ts, options, stop)
        return run.trajectory()
    finally:
        ts.destroy()
        run.midpoint.destroy()


def _frame(run: Run, options: RunOptions) -> str:
    """Store a frame; returns why there is no room for it, or an empty string. Collective."""
    try:
        if options.frame is not None:
            options.frame(run)
    except ResourceError as error:  # of all ranks
        if run.reached == run.steps:  # a run at its end has nothing to go on with
            raise
        return str(error)
    return ""


def _run_segments(run: Run, ts: Any, options: RunOptions, stop: list[bool]) -> None:
    comm: MPI.Intracomm = run.model.system.layout.comm
    if options.until is not None and options.until <= run.reached and run.reached < run.steps:
        raise SceneError(f"the run is at step {run.reached} already; --until must be larger, not {options.until}")
    body = run.model.scene, run.layout.n_e, run.milestones
    ends, frames, checkpoints = boundaries(*body, options.frame is not None, options.until)
    if options.frame is not None and run.reached == 0:
        options.frame(run)
    last, chunk = ends[-1], 1
    while run.reached < last:
        limit = next(b for b in ends if b > run.reached)
        begin, before = time.perf_counter(), run.reached
        goal = min(limit, run.reached + chunk, run.store.limit(run.reached))
        run.take(ts, goal, check=before == 0 or goal == run.steps)
        if before == 0:
            run.residual_first = run.residual_last
        pace = (time.perf_counter() - begin) / (run.reached - before)
        run.store.flush(run.reached)
        if run.reached in run.milestones:
            run.watch_energy()
        # rank 0 sets the pace, all agree whether a signal has arrived
        chunk = comm.bcast(int(np.clip(0.2 / max(pace, 1e-7), 1, 10_000)))
        full = _frame(run, options) if run.reached in frames else ""
        if options.progress is not None:
            options.progress(run)
        stopped = comm.allreduce(bool(stop), MPI.LOR)
        stopped = stopped and run.reached < run.steps  # at the end there is nothing left to stop
        if run.reached in checkpoints or stopped or full or (run.reached == last < run.steps):
            if options.keep is not None:
                options.keep(run)
            folder = options.directory / "checkpoint"
            manifest = write_checkpoint(run.restart_state(), run.model.scene, run.layout, folder)
            if full:
                raise ResourceError(f"{full}; {manifest} lets --resume go on from step {run.reached}")
            if stopped or run.reached == last:
                raise (Interrupted if stopped else Paused)(
                    f"stopped after step {run.reached} of {run.steps}; {manifest} lets --resume go on from there"
                )
