"""Newton-Kleinman iteration with low-rank ADI and modal start: the large-scale Riccati solver."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.lqr.lowrank.adi import SHARE, AdiSweep, FactorColumns, Progress, adi_step, sweep_norms
from softgrasp.lqr.lowrank.adjoint import Right, make_right
from softgrasp.lqr.lowrank.line_search import best_step, mixed_residual
from softgrasp.lqr.lowrank.modal_start import modal_start
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.restart import Iteration, load_state, save_state
from softgrasp.lqr.lowrank.shifted import ShiftedTissue, make_shifted
from softgrasp.lqr.lowrank.shifts import ShiftQueue, shift_range
from softgrasp.lqr.lowrank.solution import STOP, Iterate, make_solution
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import MODAL_KEY
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution

LINE_SEARCH = 0.5  # of the residual before: a Newton step that leaves more is shortened


@dataclass(frozen=True)
class NewtonADI:
    """Solve A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 for X = Z Z' by Newton's method with low-rank ADI.

    Step j solves (A - B K_j)'XE + E'X(A - B K_j) = -[C', K_j'][C', K_j']' [K68] by ADI in real arithmetic [BKS13] with
    the residual factor W [BKS13b]; K_{j+1} = B'XE. The Riccati residual W W' - dK'dK is known at every solve [BHSW16],
    so the last sweep stops as soon as it is small. K_0 and the first shifts come from the modal problem, which
    stabilises one-way plants with proportional damping for every damping > 0 and usually leaves one Newton step.

    Assumptions: tissue damping > 0; (E, A, B) stabilisable, (E, A, C) detectable.
    """

    tol: float = 1e-10  # bound on the true relative residual, 2-norm, hand-relative coordinates
    max_iterations: int = 15  # bound on the Newton steps
    max_solves: int = 1000  # bound on the solves of one sweep
    modes: int | None = None  # modes of the start; 0 starts from the hand alone, None chooses
    tissue: str = "auto"  # gathered, distributed or auto, see softgrasp.lqr.lowrank.shifted
    progress: Progress | None = None  # called on every rank after each solve with the history entry
    checkpoint: Path | None = None  # folder for restart files, one a rank; an existing one is resumed
    checkpoint_every: int = 25  # solves between two restart files

    def solve(self, problem: RiccatiProblem) -> RiccatiSolution:
        """Run to the tolerance. Collective. The problem is not changed.

        Raises:
            ControlError: weights or data are refused, no damping, not stabilisable or not detectable.
            SolverError: not converged within the bounds, or the true residual misses the tolerance.
            CheckpointError: the restart file belongs to another run.
        """
        begin = time.perf_counter()
        plant = Plant(problem)
        start = modal_start(plant, self.modes)
        after_start = time.perf_counter()
        tissue = make_shifted(plant.system, self.tissue)
        try:
            right = make_right(plant, tissue, Block.join([plant.outputs(), start.gain]))
            p = plant.C_s.shape[0]
            state = Iteration(right[p:])
            state.seconds["start"] = after_start - begin
            queue = ShiftQueue.start(shift_range(plant, start.poles), start.poles)
            sweep = self._iterate(plant, tissue, right[:p], state, queue)
            return self._finish(plant, tissue, sweep, state, begin)
        finally:
            tissue.destroy()

    def _iterate(
        self, plant: Plant, tissue: ShiftedTissue, outputs: Right, state: Iteration, first: ShiftQueue
    ) -> AdiSweep:
        """Newton steps until the Riccati residual is small."""
        shifts = list(first.pending)
        sweep: AdiSweep | None = load_state(self.checkpoint, plant, state, self.tol) if self.checkpoint else None
        while True:
            if sweep is None:
                K = state.gain
                W = Right.join([K, outputs, K, Right(-K.hand, -K.rows)])  # [K', W_0, dK'], W_0 = [C', K']
                sweep = AdiSweep(W, FactorColumns(plant, SHARE * self.tol * plant.scale))
            queue = replace(first, pending=shifts[sweep.steps :])  # a resumed sweep has used some
            quadratic = min(0.1 * state.achieved, 0.9 * state.achieved**2) if np.isfinite(state.achieved) else 0.0
            state.achieved = self._sweep(plant, tissue, sweep, state, queue, max(0.1 * self.tol, quadratic))
            state.step += 1
            for key, value in sweep.seconds.items():
                state.seconds[key] = state.seconds.get(key, 0.0) + value
            first.projections += queue.projections
            if state.achieved <= STOP * self.tol:
                return sweep
            if state.step >= self.max_iterations:
                raise SolverError(
                    f"newton_adi: relative residual {state.achieved:.1e} after {state.step} Newton steps and "
                    f"{state.solves} solves, tolerance {self.tol:.0e}; allow more iterations, more modes in the start, "
                    "or use radi"
                )
            self._advance(plant, sweep, state)
            sweep = None

    def _advance(self, plant: Plant, sweep: AdiSweep, state: Iteration) -> None:
        """K_{j+1} = K_j + t (K_new - K_j): the full step unless the residual hardly falls."""
        change, t = sweep.change.block, 1.0
        if state.factor is not None:
            best, before, after = best_step(plant.comm, state.factor, sweep.W.block, change)
            if after > LINE_SEARCH * before:
                t = best
                state.achieved = np.inf  # of the full step, which is not taken
        state.history[-1]["step_length"] = t
        state.factor = mixed_residual(state.factor, sweep.W.block, change, t)
        state.gain = sweep.gain.plus(sweep.change, t * np.eye(plant.inputs))

    def _sweep(
        self, plant: Plant, tissue: ShiftedTissue, sweep: AdiSweep, state: Iteration, queue: ShiftQueue, forcing: float
    ) -> float:
        """One Lyapunov equation. Returns the relative Riccati residual."""
        relative = np.inf
        while sweep.steps < self.max_solves:
            p = adi_step(plant, tissue, sweep, queue)
            lyapunov, riccati = (value / plant.scale for value in sweep_norms(plant, sweep))
            relative = riccati
            state.solves += 1
            entry = {
                "newton": float(state.step + 1),
                "solve": float(state.solves),
                "shift_re": p.real,
                "shift_im": p.imag,
                "lyapunov": lyapunov,
                "residual": riccati,
            }
            state.history.append(entry)
            if self.progress is not None:
                self.progress(entry)
            if riccati <= STOP * self.tol or lyapunov <= forcing:
                return relative
            if self.checkpoint is not None and sweep.steps % self.checkpoint_every == 0:
                save_state(self.checkpoint, plant, state, sweep)
        raise SolverError(
            f"newton_adi: relative residual {relative:.1e} after {self.max_solves} solves of one sweep, tolerance "
            f"{self.tol:.0e}; add damping, or use {MODAL_KEY}, which leaves the high modes alone"
        )

    def _finish(
        self, plant: Plant, tissue: ShiftedTissue, sweep: AdiSweep, state: Iteration, begin: float
    ) -> RiccatiSolution:
        """Compressed Z, its true residual and the bookkeeping."""
        state.seconds |= tissue.seconds
        counts = {"newton_steps": state.step, "adi_steps": state.solves, "solves": state.solves}
        counts |= {"factorisations": tissue.factors, "columns": sweep.Z.appended}
        about = f"low rank, {state.step} Newton steps, {tissue.name} tissue solves"
        iterate = Iterate(
            sweep.Z.block, sweep.new.block, "newton_adi", about, self.tol, state.history, counts, dict(state.seconds)
        )
        return make_solution(plant, iterate, begin)
