"""Newton-Kleinman iteration with low-rank ADI, modal start, exact line search and restart files.

A restart is one file a rank, and a manifest written last with the SHA-256 of each.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.checksums import digest, read_arrays, read_manifest, remove_others, write_arrays, write_manifest
from softgrasp.fem.errors import CheckpointError, SolverError, raise_on_all_ranks
from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.shown import counted
from softgrasp.lqr.lowrank.adi import SHARE, AdiSweep, FactorColumns, adi_step, sweep_norms
from softgrasp.lqr.lowrank.adjoint import AdjointRhs, adjoint_rhs
from softgrasp.lqr.lowrank.compress import triangular
from softgrasp.lqr.lowrank.modal_start import ModalStart, modal_start
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import ShiftedTissue
from softgrasp.lqr.lowrank.shifts import ShiftQueue, shift_range
from softgrasp.lqr.lowrank.solver import STOP, Iterate, LowRankSolver
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import MODAL_KEY

FORMAT = 4
LINE_SEARCH = 0.5  # of the residual before: a Newton step that leaves more is shortened
SHORTEST = 1e-2  # step length


@dataclass
class Iteration:
    """State of Newton's method between two steps."""

    gain: AdjointRhs  # gain K_j', m columns
    step: int = 0  # number of finished Newton steps
    solves: int = 0  # number of tissue solves
    factor: tuple[Block, Array] | None = None  # (U, signs) with R_j = U diag(signs) U'; None before the first step
    achieved: float = np.inf  # relative Riccati residual of the last finished step
    # residual and shift of each solve, one dictionary each
    history: list[dict[str, float]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)  # time by stage [s]
    saved: float = field(default_factory=time.monotonic)  # clock at the start, or at the last restart file [s]


def fingerprint(plant: Plant) -> str:
    """Digest of the problem that this rank sees, to refuse a foreign restart file."""
    damping = plant.system.damping
    numbers = (plant.comm.size, plant.layout.n_e, plant.two_way, plant.drag_es, damping.alpha, damping.beta)
    matrices = (plant.system.M_ee, plant.system.K_ee, damping.matrix)
    entries = [None if A is None else A.getValuesCSR()[2] for A in matrices]
    return digest(np.array(numbers), *entries, plant.C_s, plant.C_z, plant.B, plant.M_s, plant.G, plant.B_z)


def _manifest(folder: Path) -> Path:
    return folder / "newton.json"


def save_state(folder: Path, plant: Plant, state: Iteration, sweep: AdiSweep) -> None:
    """Write everything a resumed run needs. Collective. Raises CheckpointError: the folder cannot be written."""
    keys = sorted(set.intersection(*map(set, state.history))) if state.history else []  # the last of a sweep has more
    entries: dict[str, Any] = {
        "fingerprint": np.array(fingerprint(plant)),
        "numbers": np.array([state.step, state.solves, sweep.steps]),
        "norms": np.array([state.achieved, sweep.first]),
        "widths": np.array(sweep.Z.widths),
        "Z_hand": sweep.Z.block.hand,
        "Z_tall": sweep.Z.block.tall,
        "compressed_to": np.array(sweep.Z.compressed_to),
        "appended": np.array(sweep.Z.appended),
        "history_keys": np.array(keys, dtype=str),
        "history": np.array([[entry[key] for key in keys] for entry in state.history]),
        "sweep_hand": sweep.state.hand,
        "sweep_rows": sweep.state.tall,
    }
    if state.factor is not None:
        U, signs = state.factor
        entries |= {"factor_hand": U.hand, "factor_tall": U.tall, "factor_signs": signs}
    comm = plant.comm
    name, sha256 = f"newton-solve{state.solves}-rank{comm.rank}.npz", ""
    with raise_on_all_ranks(comm):
        try:
            sha256 = write_arrays(folder / name, entries)
        except OSError as error:
            raise CheckpointError(f"{folder}: the restart file cannot be written ({error}); free the disk") from error
    files = comm.gather((name, sha256))
    with raise_on_all_ranks(comm):
        if files is not None:
            try:
                write_manifest(_manifest(folder), {"format": FORMAT, "ranks": comm.size, "files": files})
            except OSError as error:
                raise CheckpointError(f"{_manifest(folder)} cannot be written ({error}); free the disk") from error
            remove_others(folder, ["newton-*"], dict(files))


def load_state(folder: Path, plant: Plant, state: Iteration, tol: float) -> AdiSweep | None:
    """Put ``state`` back and return the sweep in progress; None without restart files. Collective.

    Raises CheckpointError: the files are damaged or belong to another problem, tolerance apart, or rank count.
    """
    comm, manifest = plant.comm, _manifest(folder)
    if not comm.bcast(manifest.exists()):
        return None
    sweep: AdiSweep | None = None
    advice = f"remove the folder {folder}"
    with raise_on_all_ranks(comm):
        entry = read_manifest(manifest, FORMAT, advice)
        foreign = f"{manifest} belongs to another control problem or rank count; {advice} or name another one"
        if entry["ranks"] != comm.size:
            raise CheckpointError(foreign)
        name, sha256 = entry["files"][comm.rank]
        data = read_arrays(folder / name, sha256, advice)
        if str(data["fingerprint"]) != fingerprint(plant):
            raise CheckpointError(foreign)
        sweep = _restore(plant, state, data, tol)
    return sweep


def _restore(plant: Plant, state: Iteration, data: dict[str, Array], tol: float) -> AdiSweep:
    state.step, state.solves, steps = (int(value) for value in data["numbers"])
    state.achieved, first = (float(value) for value in data["norms"])
    keys = [str(key) for key in data["history_keys"]]
    state.history = [dict(zip(keys, map(float, row), strict=True)) for row in data["history"]]
    if "factor_signs" in data:
        state.factor = (Block(data["factor_hand"], data["factor_tall"]), data["factor_signs"])
    Z = FactorColumns(plant, SHARE * tol * plant.scale)
    Z.hand, Z.tall = np.ascontiguousarray(data["Z_hand"]), np.ascontiguousarray(data["Z_tall"])
    Z.count, Z.compressed_to = Z.hand.shape[1], int(data["compressed_to"])
    Z.appended = int(data["appended"])
    Z.widths = [int(width) for width in data["widths"]]
    sweep = AdiSweep(AdjointRhs(data["sweep_hand"], data["sweep_rows"]), Z, steps, first=first)
    state.gain = sweep.gain
    return sweep


@dataclass(frozen=True, kw_only=True)
class NewtonADI(LowRankSolver[ModalStart]):
    """Newton's method with low-rank ADI.

    Step j solves (A - B K_j)'XE + E'X(A - B K_j) = -[C', K_j'][C', K_j']' [K68] by ADI in real arithmetic [BKS13] with
    the residual factor W [BKS13b]; K_{j+1} = B'XE. The Riccati residual W W' - dK'dK is known at every solve [BHSW16],
    so the last sweep stops as soon as it is small. K_0 and the first shifts come from the modal problem, which
    stabilises one-way plants with proportional damping for every damping > 0 and usually leaves one Newton step.

    Assumptions: tissue damping > 0; (E, A, B) stabilisable, (E, A, C) detectable.
    """

    method = "newton_adi"
    max_iterations: int = 15  # bound on the Newton steps
    max_solves: int = 1000  # bound on the solves of one sweep
    modes: int | None = None  # number of modes of the start; 0: the hand alone, None: by the damping
    checkpoint: Path | None = None  # folder for restart files, one per rank; an existing one is resumed
    checkpoint_every: int = 25  # solves between two restart files
    checkpoint_after: float = 10.0  # time from the start, or the last restart file, before the next one [s]

    def prepare(self, plant: Plant) -> ModalStart:
        """Gain K_0 and first shifts. Collective."""
        return modal_start(plant, self.modes)

    def iterate(self, plant: Plant, tissue: ShiftedTissue, start: ModalStart) -> Iterate:
        """Newton steps until the Riccati residual is small. Collective."""
        first = ShiftQueue.start(shift_range(plant, start.poles), start.poles)
        right = adjoint_rhs(plant, tissue, Block.join([plant.outputs(), start.gain]), first.pending)
        p = plant.C_s.shape[0]
        outputs, state = right[:p], Iteration(right[p:])
        shifts = list(first.pending)
        sweep: AdiSweep | None = load_state(self.checkpoint, plant, state, self.tol) if self.checkpoint else None
        while True:
            if sweep is None:
                K = state.gain
                W = AdjointRhs.join([K, outputs, K, AdjointRhs(-K.hand, -K.tall)])  # [K', W_0, dK'], W_0 = [C', K']
                sweep = AdiSweep(W, FactorColumns(plant, SHARE * self.tol * plant.scale))
            queue = replace(first, pending=shifts[sweep.steps :])  # a resumed sweep has used some
            quadratic = min(0.1 * state.achieved, 0.9 * state.achieved**2) if np.isfinite(state.achieved) else 0.0
            state.achieved = self._sweep(plant, tissue, sweep, state, queue, max(0.1 * self.tol, quadratic))
            state.step += 1
            for key, value in sweep.seconds.items():
                state.seconds[key] = state.seconds.get(key, 0.0) + value
            if state.achieved <= STOP * self.tol:
                break
            if state.step >= self.max_iterations:
                raise SolverError(
                    f"newton_adi: relative residual {state.achieved:.1e} after {state.step} Newton steps and "
                    f"{state.solves} solves, tolerance {self.tol:.0e}; allow more iterations, more modes in the start, "
                    "or use radi"
                )
            _advance(plant, sweep, state)
            sweep = None
        counts = {"newton_steps": state.step, "adi_steps": state.solves, "solves": state.solves}
        counts["columns"] = sweep.Z.appended
        about = f"low rank, {counted(state.step, 'Newton step')}, {tissue.about}"
        return Iterate(sweep.Z.block, sweep.new.block, about, state.history, counts, state.seconds)

    def _sweep(
        self, plant: Plant, tissue: ShiftedTissue, sweep: AdiSweep, state: Iteration, queue: ShiftQueue, forcing: float
    ) -> float:
        """One Lyapunov equation. Returns the relative Riccati residual."""
        relative = np.inf
        while sweep.steps < self.max_solves:
            p = adi_step(plant, tissue, sweep, queue)
            lyapunov, relative = (value / plant.scale for value in sweep_norms(plant, sweep))
            state.solves += 1
            entry = {"newton": float(state.step + 1), "solve": float(state.solves)}
            entry |= {"shift_re": p.real, "shift_im": p.imag, "lyapunov": lyapunov, "residual": relative}
            self.record(state.history, entry)
            if relative <= STOP * self.tol or lyapunov <= forcing:
                return relative
            if self.checkpoint is not None and sweep.steps % self.checkpoint_every == 0:
                self._save(self.checkpoint, plant, state, sweep)
        raise SolverError(
            f"newton_adi: relative residual {relative:.1e} after {self.max_solves} solves of one sweep, tolerance "
            f"{self.tol:.0e}; add damping, or use {MODAL_KEY}, which leaves the high modes alone"
        )

    def _save(self, folder: Path, plant: Plant, state: Iteration, sweep: AdiSweep) -> None:
        """Write a restart file unless the last one, or the start, is too near. Collective."""
        if plant.comm.bcast(time.monotonic() - state.saved >= self.checkpoint_after):
            save_state(folder, plant, state, sweep)
            state.saved = time.monotonic()


def _advance(plant: Plant, sweep: AdiSweep, state: Iteration) -> None:
    """K_{j+1} = K_j + t (K_new - K_j): the full step unless the residual hardly falls."""
    change, t = sweep.change.block, 1.0
    if state.factor is not None:
        best, before, after = best_step(plant.comm, state.factor, sweep.W.block, change)
        if after > LINE_SEARCH * before:
            t = best
            state.achieved = np.inf  # it was that of the full step, which is rejected
    state.history[-1]["step_length"] = t
    state.factor = mixed_residual(state.factor, sweep.W.block, change, t)
    state.gain = sweep.gain.plus(sweep.change, t * np.eye(plant.inputs))


def best_step(comm: MPI.Intracomm, old: tuple[Block, Array], W: Block, change: Block) -> tuple[float, float, float]:
    """Minimise ||(1 - t) R_j + t W W' - t^2 dK'dK||_F over t in (0, 1] [BB98].

    Residual of X_j + t (X_new - X_j), exactly. Collective; chosen on one rank.

    Args:
        old: (U, signs) with R_j = U diag(signs) U'.
        W: residual factor of the Lyapunov equation.
        change: dK' = K_new' - K_j'.

    Returns t, ||R_j||_F and the norm at t = 1.
    """
    U, signs = old
    r = triangular(comm, Block.join([U, W, change]))
    return on_root(comm, lambda: _least(r, signs, U.columns, U.columns + W.columns))


def _least(r: Array, signs: Array, u: int, w: int) -> tuple[float, float, float]:
    """The same from the triangular factor r of [U, W, dK'], U the columns before u and W those before w."""
    R_old = (r[:, :u] * signs) @ r[:, :u].T
    lyapunov, quadratic = r[:, u:w] @ r[:, u:w].T, r[:, w:] @ r[:, w:].T
    # R(t) = R_old + t (lyapunov - R_old) - t^2 quadratic; ||R(t)||^2 is a quartic
    terms = (R_old, lyapunov - R_old, -quadratic)
    product = [[float(np.sum(a * b)) for b in terms] for a in terms]
    (aa, ab, ac), (_, bb, bc), (_, _, cc) = product
    quartic = np.polynomial.Polynomial([aa, 2 * ab, bb + 2 * ac, 2 * bc, cc])
    roots = quartic.deriv().roots()
    real = [float(np.real(t)) for t in roots if abs(np.imag(t)) < 1e-8]
    inside = [t for t in real if SHORTEST <= t <= 1]
    t = min([*inside, 1.0, SHORTEST], key=lambda s: float(quartic(s)))
    return t, float(np.sqrt(max(aa, 0.0))), float(np.sqrt(max(float(quartic(1.0)), 0.0)))


def mixed_residual(old: tuple[Block, Array] | None, W: Block, change: Block, t: float) -> tuple[Block, Array]:
    """(U, signs) of (1 - t) R_j + t W W' - t^2 dK'dK."""
    parts = [W.times(np.sqrt(t) * np.eye(W.columns)), change.times(t * np.eye(change.columns))]
    signs = [np.ones(W.columns), -np.ones(change.columns)]
    if t < 1 and old is not None:
        U, weights = old
        parts.append(U.times(np.sqrt(1 - t) * np.eye(U.columns)))
        signs.append(weights)
    return Block.join(parts), np.concatenate(signs)
