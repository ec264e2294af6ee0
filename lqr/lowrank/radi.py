"""RADI: low-rank Riccati iteration from X_0 = 0, the independent second opinion on Newton-ADI."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, on_root
from softgrasp.lqr.lowrank.adi import GROWTH, SHARE, FactorColumns, LowRankSweep, Progress
from softgrasp.lqr.lowrank.adjoint import Right, Solution, make_right, mass_right
from softgrasp.lqr.lowrank.compress import gram
from softgrasp.lqr.lowrank.modal_start import modal_start
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import ShiftedTissue, make_shifted
from softgrasp.lqr.lowrank.shifts import ShiftQueue, shift_range
from softgrasp.lqr.lowrank.solution import STOP, Iterate, make_solution
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import MODAL_KEY
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution


def radi_columns(plant: Plant, s: complex, V: Solution) -> tuple[Block, Array, Array, float]:
    """Real columns V_1 of the update X += V_1 Y^{-1} V_1', with Y, V_1'B and the factor of W [BBKS18].

    s real: V_1 = sqrt(-2s) V, Y = I - V_1'B B'V_1 / (2s). s complex: V_1 = sqrt(-2 Re s) [Re V, Im V] and the Y of the
    pair. Collective.
    """
    q = V.columns
    one = np.eye(q)
    c = float(np.sqrt(-2 * s.real))
    if s.imag == 0:
        columns = V.real(np.asarray(c * one, dtype=complex))
        V_B = plant.inputs_of(columns)
        return columns, one - V_B @ V_B.T / (2 * s.real), V_B, c
    columns = V.real(np.asarray(c * np.hstack([one, -1j * one]), dtype=complex))
    V_B = plant.inputs_of(columns)
    real, imag = V_B[:q], V_B[q:]
    a, b = s.real / abs(s), s.imag / abs(s)
    F_1 = np.vstack([-a * real - b * imag, b * real - a * imag])
    F_3 = np.vstack([b * one, a * one])
    Y = np.diag(np.repeat([1.0, 0.5], q)) - (F_1 @ F_1.T + V_B @ V_B.T) / (4 * s.real) - F_3 @ F_3.T / 2
    return columns, Y, V_B, c


def radi_step(plant: Plant, tissue: ShiftedTissue, state: LowRankSweep, queue: ShiftQueue) -> complex:
    """One solve with p + m right-hand sides; W, K and Z are updated. Collective. Returns the shift.

    Raises SolverError: Y is not positive definite: rounding has destroyed the step.
    """
    q = state.W.columns
    s, V = state.solve(tissue, queue)
    begin = time.perf_counter()
    columns, Y, V_B, c = radi_columns(plant, s, V)
    try:
        inverse = on_root(plant.comm, lambda: np.linalg.inv(np.linalg.cholesky((Y + Y.T) / 2)))
    except np.linalg.LinAlgError as error:
        raise SolverError(f"radi: the step at the shift {s:.4g} is not definite; use newton_adi") from error
    weight = inverse.T @ inverse
    state.state = state.state.plus(mass_right(plant, columns), np.hstack([weight @ V_B, c * weight[:, :q]]))
    state.Z.append(columns.times(inverse.T))
    state.seconds["products"] += time.perf_counter() - begin
    return s


@dataclass(frozen=True)
class RADI:
    """Solve A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 for X = Z Z' by RADI [BBKS18] from X_0 = 0.

    Each step is one solve (A - B K + s E)'V = W with the p columns of the residual factor, Res(X_k) = W W'. No
    stabilising start is needed; the modal problem gives shifts only. X_k grows monotonically to the stabilising
    solution when the plant is stabilisable and detectable.
    """

    tol: float = 1e-10  # bound on the true relative residual, 2-norm, hand-relative coordinates
    max_iterations: int = 1500  # bound on the solves
    tissue: str = "auto"  # gathered, distributed or auto, see softgrasp.lqr.lowrank.shifted
    progress: Progress | None = None  # called on every rank after each solve with the history entry

    def solve(self, problem: RiccatiProblem) -> RiccatiSolution:
        """Run to the tolerance. Collective. The problem is not changed.

        Raises:
            ControlError: weights or data are refused, no damping, not stabilisable or not detectable.
            SolverError: not converged within the bound, or the true residual misses the tolerance.
        """
        begin = time.perf_counter()
        plant = Plant(problem)
        start = modal_start(plant)
        poles = start.poles
        after_start = time.perf_counter()
        tissue = make_shifted(plant.system, self.tissue)
        try:
            W = make_right(plant, tissue, plant.outputs())
            gain = Right(np.zeros((len(W.hand), plant.inputs)), np.zeros((len(W.rows), plant.inputs)))
            state = LowRankSweep(Right.join([gain, W]), FactorColumns(plant, SHARE * self.tol * plant.scale))
            state.seconds["start"] = after_start - begin
            queue = ShiftQueue.start(shift_range(plant, poles), poles)
            history = self._iterate(plant, tissue, state, queue)
            state.seconds |= tissue.seconds
            counts = {"newton_steps": 0, "adi_steps": state.steps, "solves": state.steps}
            counts |= {"factorisations": tissue.factors, "columns": state.Z.appended}
            about = f"low rank from X = 0, {tissue.name} tissue solves"
            columns = state.Z.block, state.gain.block
            iterate = Iterate(*columns, "radi", about, self.tol, history, counts, state.seconds)
            return make_solution(plant, iterate, begin)
        finally:
            tissue.destroy()

    def _iterate(
        self, plant: Plant, tissue: ShiftedTissue, state: LowRankSweep, queue: ShiftQueue
    ) -> list[dict[str, float]]:
        relative, history = 1.0, list[dict[str, float]]()
        while state.steps < self.max_iterations:
            s = radi_step(plant, tissue, state, queue)
            begin = time.perf_counter()
            products = gram(plant.comm, state.W.block, state.W.block)
            # the same bits on every rank: they decide when all stop
            relative = on_root(plant.comm, partial(np.linalg.norm, products, 2)) / plant.scale
            state.seconds["small"] += time.perf_counter() - begin
            entry = {"solve": float(state.steps), "shift_re": s.real, "shift_im": s.imag, "residual": relative}
            history.append(entry)
            if self.progress is not None:
                self.progress(entry)
            if relative <= STOP * self.tol:
                return history
            if not relative <= GROWTH:
                break
        raise SolverError(
            f"radi: relative residual {relative:.1e} after {state.steps} solves, tolerance {self.tol:.0e}; add "
            f"damping, or use {MODAL_KEY}, which leaves the high modes alone"
        )
