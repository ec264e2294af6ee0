"""RADI: low-rank Riccati iteration from X_0 = 0, the independent second opinion on Newton-ADI."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, Complex, on_root
from softgrasp.lqr.lowrank.adi import GROWTH, SHARE, FactorColumns, LowRankSweep
from softgrasp.lqr.lowrank.adjoint import AdjointRhs, AdjointSolution, adjoint_rhs
from softgrasp.lqr.lowrank.compress import gram
from softgrasp.lqr.lowrank.modal_start import ModalStart, modal_start
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import ShiftedTissue
from softgrasp.lqr.lowrank.shifts import ShiftQueue, shift_range
from softgrasp.lqr.lowrank.solver import STOP, Iterate, LowRankSolver
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import MODAL_KEY


def radi_columns(plant: Plant, s: complex, V: AdjointSolution) -> tuple[Complex, Block, Array, Array, float]:
    """Weights of V_1, V_1, Y, V_1'B and c of X += V_1 Y^{-1} V_1', W += c E'V_1 (first q columns of Y^{-1}) [BBKS18].

    s real: V_1 = sqrt(-2s) V, Y = I - V_1'B B'V_1 / (2s). s complex: V_1 = sqrt(-2 Re s) [Re V, Im V] and the Y of the
    pair. Collective.
    """
    q = V.mix.shape[1]
    one = np.eye(q)
    c = float(np.sqrt(-2 * s.real))
    if s.imag == 0:
        coefficients = np.asarray(c * one, dtype=complex)
        columns = V.real(coefficients)
        V_B = plant.inputs_of(columns)
        return coefficients, columns, one - V_B @ V_B.T / (2 * s.real), V_B, c
    coefficients = np.asarray(c * np.hstack([one, -1j * one]), dtype=complex)
    columns = V.real(coefficients)
    V_B = plant.inputs_of(columns)
    real, imag = V_B[:q], V_B[q:]
    a, b = s.real / abs(s), s.imag / abs(s)
    F_1 = np.vstack([-a * real - b * imag, b * real - a * imag])
    F_3 = np.vstack([b * one, a * one])
    Y = np.diag(np.repeat([1.0, 0.5], q)) - (F_1 @ F_1.T + V_B @ V_B.T) / (4 * s.real) - F_3 @ F_3.T / 2
    return coefficients, columns, Y, V_B, c


def radi_step(plant: Plant, tissue: ShiftedTissue, sweep: LowRankSweep, queue: ShiftQueue) -> complex:
    """One solve with p + m right-hand sides; W, K and Z are updated. Collective. Returns the shift.

    Raises SolverError: Y is not positive definite: rounding has destroyed the step.
    """
    q = sweep.W.columns
    s, V = sweep.solve(tissue, queue)
    begin = time.perf_counter()
    coefficients, columns, Y, V_B, c = radi_columns(plant, s, V)
    try:
        inverse = on_root(plant.comm, lambda: np.linalg.inv(np.linalg.cholesky((Y + Y.T) / 2)))
    except np.linalg.LinAlgError as error:
        raise SolverError(f"radi: the step at the shift {s:.4g} is not definite; use newton_adi") from error
    weight = inverse.T @ inverse
    sweep.advance(V, coefficients, columns, np.hstack([weight @ V_B, c * weight[:, :q]]))
    sweep.Z.append(columns.times(inverse.T))
    sweep.seconds["products"] += time.perf_counter() - begin
    return s


@dataclass(frozen=True, kw_only=True)
class RADI(LowRankSolver[ModalStart]):
    """RADI [BBKS18] from X_0 = 0.

    Each step is one solve (A - B K + s E)'V = W with the p columns of the residual factor, Res(X_k) = W W'. No
    stabilising start is needed; the modal problem gives shifts only. X_k grows monotonically to the stabilising
    solution when the plant is stabilisable and detectable.
    """

    method = "radi"
    max_iterations: int = 1500  # bound on the solves

    def prepare(self, plant: Plant) -> ModalStart:
        """First shifts. Collective."""
        return modal_start(plant)

    def iterate(self, plant: Plant, tissue: ShiftedTissue, start: ModalStart) -> Iterate:
        """Steps until the residual is small. Collective."""
        queue = ShiftQueue.start(shift_range(plant, start.poles), start.poles)
        W = adjoint_rhs(plant, tissue, plant.outputs(), queue.pending)
        gain = AdjointRhs(np.zeros((len(W.hand), plant.inputs)), np.zeros((len(W.tall), plant.inputs)))
        sweep = LowRankSweep(AdjointRhs.join([gain, W]), FactorColumns(plant, SHARE * self.tol * plant.scale))
        relative, history = 1.0, list[dict[str, float]]()
        while sweep.steps < self.max_iterations and relative <= GROWTH:
            s = radi_step(plant, tissue, sweep, queue)
            begin = time.perf_counter()
            products = gram(plant.comm, sweep.W.block, sweep.W.block)
            # the same bits on every rank: they decide when all stop
            relative = on_root(plant.comm, partial(np.linalg.norm, products, 2)) / plant.scale
            sweep.seconds["small"] += time.perf_counter() - begin
            entry = {"solve": float(sweep.steps), "shift_re": s.real, "shift_im": s.imag, "residual": relative}
            self.record(history, entry)
            if relative <= STOP * self.tol:
                counts = {"adi_steps": sweep.steps, "solves": sweep.steps, "columns": sweep.Z.appended}
                about = f"low rank from X = 0, {tissue.about}"
                return Iterate(sweep.Z.block, sweep.gain.block, about, history, counts, sweep.seconds)
        raise SolverError(
            f"radi: relative residual {relative:.1e} after {sweep.steps} solves, tolerance {self.tol:.0e}; add "
            f"damping, or use {MODAL_KEY}, which leaves the high modes alone"
        )
