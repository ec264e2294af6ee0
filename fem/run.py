"""PETSc TS runs the midpoint step, in segments: between them come progress, frames, checkpoints and interrupts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

from fem.build import Model
from fem.drive import Drive, Force, ForceDrive, TableDrive
from fem.errors import SolverError
from fem.midpoint import TissueMidpoint, TissueState, state_on
from fem.motion import driven_table, force_values, motion_table
from fem.outputs import Output, make_outputs
from fem.petsc import Array, PETSc, total
from fem.snapshots import Snapshots, memory_check, snapshot_steps
from fem.solvers import choose_solver, make_solver
from fem.system import BlockSystem

Observer = Callable[[int, "Run"], None]
"""Called between segments with the step number just reached; collective, may raise to end the run."""


@dataclass(frozen=True)
class Trajectory:
    """What a run returns.

    Attributes:
        times: time grid [s], shape (steps + 1,).
        q_s, v_s: hand, shape (steps + 1, n_s), on every rank.
        outputs: named outputs [m], shape (steps + 1, components), on every rank.
        output_names: one per component.
        snapshots: stored states, or None.
        final: local [z; v_z] at the end.
        energy_drift: |E_N - E_0 - work + dissipated| over the largest energy seen, dimensionless.
        residuals: relative residual of the first and the last solve.
        solver: name and reason.
        seconds: stages of the run.
    """

    times: Array
    q_s: Array
    v_s: Array
    outputs: Array
    output_names: tuple[str, ...]
    snapshots: Snapshots | None
    final: Array
    energy_drift: float
    residuals: tuple[float, float]
    solver: tuple[str, str]
    seconds: dict[str, float] = field(default_factory=dict)


class Run:
    """One run in progress: the TS context and what it carries.

    Args:
        model: the model.
        force: feedback force on the hand; None takes the scene's motion.
    """

    def __init__(self, model: Model, force: Force | None = None) -> None:
        scene, system = model.scene, model.system
        self.model = model
        self.steps, self.end = scene.time.steps, scene.time_end
        self.dt = self.end / self.steps
        self.solver = choose_solver(system.layout, scene.time.solver)
        self.stored = (
            snapshot_steps(self.steps, scene.output.every) if scene.output.snapshots == "memory" else np.zeros(0, int)
        )
        memory_check(system, len(self.stored))
        with model.watch.stage("factor"):
            self.midpoint = TissueMidpoint(system, self.dt, self.solver[0], scene.time.rtol)
        n = system.layout.n_local
        self.work = state_on(np.zeros(2 * n), system)
        self.Z = np.zeros((2 * n, len(self.stored)), order="F")
        self.columns: dict[int, TissueState] = {
            int(step): state_on(self.Z[:, j], system) for j, step in enumerate(self.stored)
        }
        self.state = self.columns.get(0, self.work)
        self.outputs: tuple[Output, ...] = make_outputs(scene, system)
        self.local_outputs = np.zeros((self.steps + 1, sum(o.size for o in self.outputs)))
        self.drive: Drive = self._make_drive(force)
        self.reached = 0
        self.peak_energy = 0.0

    def _make_drive(self, force: Force | None) -> Drive:
        scene, system = self.model.scene, self.model.system
        n_s = system.layout.n_s
        zero = np.zeros(n_s)
        if force is not None:
            return ForceDrive(system, force, self.midpoint, self.steps, zero, zero)
        if scene.motion.drive == "motion":
            return TableDrive(system, motion_table(scene, n_s))
        u = force_values(scene, n_s, system.M_hand)
        if system.two_way:
            return ForceDrive(system, lambda n, t, q, v: u[n], self.midpoint, self.steps, zero, zero)
        if system.hand_weight and system.gravity is not None:
            u = u + system.M_hand @ system.gravity
        return TableDrive(system, driven_table(system.M_hand, u, self.dt, zero, zero))

    def solveStep(self, ts: Any, t: float, x: Any) -> None:  # noqa: N802 (the name PETSc calls)
        """One midpoint step; the step number, not the summed time, picks the load. Collective."""
        n = self.reached
        self.drive.solve(n, self.midpoint, self.state)
        new = self.columns.get(n + 1, self.work)
        self.midpoint.advance(self.state, new)
        self.state = new
        self.reached = n + 1
        self.record(n + 1)

    def record(self, n: int) -> None:
        """Store this rank's share of the outputs at step n. Not collective."""
        row, at = self.local_outputs[n], 0
        for output in self.outputs:
            row[at : at + output.size] = output.local(self.state.array)
            at += output.size

    def start(self) -> None:
        """Initial state: at rest, or in equilibrium under gravity. Collective."""
        scene, system = self.model.scene, self.model.system
        if scene.time.start == "equilibrium" and system.gravity is not None:
            with self.model.watch.stage("equilibrium"):
                self.state.z.array_w[:] = equilibrium(system, self.solver[0], scene.time.rtol)
        self.midpoint.start(self.state)
        self.record(0)
        self.initial_energy = self.midpoint.energy(self.state)
        self.peak_energy = abs(self.initial_energy)

    def advance_to(self, ts: Any, x: Any, step: int) -> None:
        """Let TS run up to a step number. Collective.

        Raises:
            SolverError: a solve failed; the message names solver, step and reason.
        """
        if step <= self.reached:
            return
        ts.setMaxSteps(step)
        try:
            ts.solve(x)
        except PETSc.Error as error:
            cause = error.__cause__
            text = str(cause) if isinstance(cause, SolverError) else f"PETSc error {error.ierr} ({cause})"
            raise SolverError(f"step {self.reached + 1} of {self.steps}: {text}") from error
        if self.reached != step:
            raise SolverError(
                f"{self.solver[0]}: TS stopped at step {self.reached} of {step} (reason {ts.getConvergedReason()})"
            )
        if self.state is not self.work:
            self.work.array[:] = self.state.array  # the TS solution is current between segments
            x.stateIncrease()
        energy = self.midpoint.energy(self.state)
        if not np.isfinite(energy):
            raise SolverError(
                f"{self.solver[0]}: the energy is not finite at step {step}; check material, dt and force"
            )
        self.peak_energy = max(self.peak_energy, abs(energy))

    def drift(self) -> float:
        """Energy that neither load nor damping explains, over the largest energy seen. Collective."""
        work, lost = self.midpoint.balance()
        defect = self.midpoint.energy(self.state) - self.initial_energy - work + lost
        scale = max(self.peak_energy, abs(work), abs(lost))
        return abs(defect) / scale if scale > 0 else 0.0

    def trajectory(self, residuals: tuple[float, float]) -> Trajectory:
        """Gather the small results; the tissue stays distributed. Collective."""
        system, outputs = self.model.system, self.outputs
        comm = system.layout.comm
        y = total(comm, self.local_outputs)
        y += self.drive.q @ np.vstack([o.C_s for o in outputs]).T
        names = tuple(f"{o.name}_{'xyz'[i] if o.size <= 3 else i + 1}" for o in outputs for i in range(o.size))
        times = self.end * np.arange(self.steps + 1) / self.steps
        snapshots = None
        if len(self.stored):
            snapshots = Snapshots(
                system.layout,
                self.stored,
                times[self.stored],
                self.drive.q[self.stored].T.copy(),
                self.drive.v[self.stored].T.copy(),
                self.Z,
            )
        return Trajectory(
            times=times,
            q_s=self.drive.q,
            v_s=self.drive.v,
            outputs=y,
            output_names=names,
            snapshots=snapshots,
            final=self.state.array.copy(),
            energy_drift=self.drift(),
            residuals=residuals,
            solver=self.solver,
            seconds=dict(self.model.watch.seconds),
        )


def equilibrium(system: BlockSystem, solver: str, rtol: float) -> Array:
    """Static displacement relative to the hand, K_ee z = G g; local rows. Collective.

    Raises:
        SolverError: the stiffness is singular or the residual too large.
    """
    load = system.K_ee.createVecLeft()
    z = system.K_ee.createVecRight()
    load.array_w[:] = 0.0 if system.gravity is None else system.G @ system.gravity
    static = make_solver(system.K_ee.copy(), solver, system.layout, "softgrasp_static_", rtol)  # type: ignore[arg-type]
    static.solve(load, z)
    static.check(load, z, "the static equilibrium")
    result = z.array_r.copy()
    static.destroy()
    load.destroy()
    z.destroy()
    return np.asarray(result)


def make_ts(run: Run) -> tuple[Any, Any]:
    """PETSc TS around a run, and its solution vector [z; v] on the work array. Collective."""
    layout = run.model.system.layout
    ts = PETSc.TS().createPython(run, comm=layout.comm)
    ts.setTimeStep(run.dt)
    ts.setMaxTime(1e300)  # stepping by time would take one step too many or change the last one
    ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
    x = PETSc.Vec().createWithArray(run.work.array, size=(2 * layout.n_local, 2 * layout.n_e), comm=layout.comm)
    ts.setSolution(x)
    return ts, x


def simulate(model: Model, observer: Observer | None = None, force: Force | None = None) -> Trajectory:
    """Run a scene from its start to its end. Collective.

    Args:
        model: from :func:`fem.build.build`.
        observer: called about five times a second and at the end.
        force: feedback force on the hand instead of the scene's motion.

    Raises:
        SolverError: a solve failed or missed its tolerance.
        ResourceError: the snapshots do not fit.
    """
    run = Run(model, force)
    run.start()
    ts, x = make_ts(run)
    comm: MPI.Intracomm = model.system.layout.comm
    try:
        begin = time.perf_counter()
        run.advance_to(ts, x, 1)
        first = run.midpoint.residual()
        chunk = comm.bcast(int(np.clip(0.2 / max(time.perf_counter() - begin, 1e-6), 1, 10_000)))
        with model.watch.stage("steps"):
            while run.reached < run.steps:
                run.advance_to(ts, x, min(run.steps, run.reached + chunk))
                if observer is not None:
                    observer(run.reached, run)
        last = run.midpoint.residual()
        return run.trajectory((first, last))
    finally:
        ts.destroy()
        run.midpoint.destroy()
