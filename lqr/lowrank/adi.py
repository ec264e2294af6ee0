"""Low-rank ADI in real arithmetic for the Lyapunov equation of one Newton step."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, Complex, on_root
from softgrasp.lqr.lowrank.adjoint import (
    AdjointRhs,
    AdjointSolution,
    OpenSolution,
    closed_adjoint,
    mass_rhs,
    open_adjoints,
)
from softgrasp.lqr.lowrank.compress import compress, gram
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import ShiftedTissue
from softgrasp.lqr.lowrank.shifts import WINDOW, ShiftQueue
from softgrasp.lqr.plant.block import Block

SQUEEZE = 480  # columns of Z from which it is compressed on the way: memory of a large scene
SHARE = 0.02  # of the tolerance that one compression on the way may use up
GROWTH = 1e6  # of the residual against its start: the closed loop of the given gain is unstable


class FactorColumns:
    """Growing factor Z in costate form, compressed when it gets wide.

    Args:
        allowed: change of the Riccati residual by one compression on the way, 2-norm.
        limit: number of columns from which it is compressed.
    """

    def __init__(self, plant: Plant, allowed: float, limit: int = SQUEEZE) -> None:
        self.plant, self.allowed, self.limit = plant, allowed, limit
        self.count = self.compressed_to = self.appended = 0
        # rows side by side in memory: what the sparse products want
        self.hand, self.tall = np.empty((2 * plant.n_s, limit)), np.empty((2 * plant.n_local, limit))
        self.widths: list[int] = []

    def append(self, block: Block) -> None:
        """Append columns. Collective."""
        k = block.columns
        if self.count + k > max(self.limit, 2 * self.compressed_to):
            self.squeeze()
        if self.count + k > self.hand.shape[1]:
            room = max(self.count + k, min(2 * self.hand.shape[1], max(self.limit, 2 * self.compressed_to)))
            self.hand = self._grown(self.hand, room)
            self.tall = self._grown(self.tall, room)
        self.hand[:, self.count : self.count + k] = block.hand
        self.tall[:, self.count : self.count + k] = block.tall
        self.count += k
        self.appended += k
        self.widths.append(k)

    def _grown(self, old: Array, room: int) -> Array:
        """An array of ``room`` columns with those in use."""
        new = np.empty((len(old), room))
        new[:, : self.count] = old[:, : self.count]
        return new

    @property
    def block(self) -> Block:
        """All columns (views)."""
        return Block(self.hand[:, : self.count], self.tall[:, : self.count])

    def recent(self) -> Block:
        """Columns of the last :data:`softgrasp.lqr.lowrank.shifts.WINDOW` blocks (views)."""
        first = self.count - min(sum(self.widths[-WINDOW:]), self.count)
        return Block(self.hand[:, first : self.count], self.tall[:, first : self.count])

    def squeeze(self) -> None:
        """Compress; the blocks the next shifts come from stay as they are. Collective."""
        keep = min(sum(self.widths[-WINDOW:]), self.count)
        old, new = self.block[: self.count - keep], self.recent()
        if old.columns == 0:
            return
        small = compress(self.plant, old, self.allowed)
        r = small.columns
        hand, tall = new.hand.copy(), new.tall.copy()
        self.hand[:, :r], self.tall[:, :r] = small.hand, small.tall
        self.hand[:, r : r + keep], self.tall[:, r : r + keep] = hand, tall
        self.count = self.compressed_to = r + keep
        self.widths = self.widths[-WINDOW:]


@dataclass
class LowRankSweep:
    """State of a sweep of solves, of ADI or RADI."""

    state: AdjointRhs  # [K', W, ...] with the gain K' and the residual factor W
    Z: FactorColumns  # factor of X ~ Z Z'
    steps: int = 0  # number of solves so far
    waiting: list[OpenSolution] = field(default_factory=list)  # of the next shifts, solved with beside the last one
    # time by stage [s]
    seconds: dict[str, float] = field(default_factory=lambda: {"shifts": 0.0, "small": 0.0, "products": 0.0})

    @property
    def W(self) -> AdjointRhs:
        """Residual factor (views)."""
        return self.state[self.Z.plant.inputs :]

    @property
    def gain(self) -> AdjointRhs:
        """K' (views)."""
        return self.state[: self.Z.plant.inputs]

    def solve(self, tissue: ShiftedTissue, queue: ShiftQueue) -> tuple[complex, AdjointSolution]:
        """Next shift p, and solution V of (A - B K + p E)'V = W. Collective."""
        begin, plant, m = time.perf_counter(), self.Z.plant, self.Z.plant.inputs
        if queue.short(self.steps):
            queue.refill(plant, self.Z.recent(), self.W.block, self.gain)
        p, ahead = queue.next()
        self.seconds["shifts"] += time.perf_counter() - begin
        self.steps += 1
        right = self.state[: m + self.W.columns]
        if not self.waiting:
            self.waiting = open_adjoints(plant, tissue, [p, *ahead], right)
        return p, closed_adjoint(plant, self.waiting.pop(0), right)

    def advance(self, V: AdjointSolution, coefficients: Complex, Z: Block, small: Array) -> None:
        """W <- W + E'Z small for Z = Re(V c), and K' and dK' likewise. Collective."""
        self.state = self.state.plus(mass_rhs(self.Z.plant, Z), small)
        for i, solution in enumerate(self.waiting):
            self.waiting[i] = solution.moved(V, coefficients, small[:, : solution.b.shape[1]])


@dataclass
class AdiSweep(LowRankSweep):
    """[K', W, dK'] of A_c'XE + E'XA_c = -W_0 W_0', A_c = A - B K, with dK = B'XE - K of the X so far."""

    first: float = 0.0  # residual ||W_0 W_0'||_2 at the start

    @property
    def W(self) -> AdjointRhs:
        """Residual factor, W W' the Lyapunov residual (views)."""
        return self.state[self.Z.plant.inputs : -self.Z.plant.inputs]

    @property
    def change(self) -> AdjointRhs:
        """Change of the gain, dK' (views)."""
        return self.state[-self.Z.plant.inputs :]

    @property
    def new(self) -> AdjointRhs:
        """New gain (B'XE)' of the X so far."""
        return self.gain.plus(self.change, np.eye(self.Z.plant.inputs))


def real_columns(p: complex, q: int) -> tuple[Complex, float]:
    """Coefficients c of the real columns Z = Re(V c) of a shift or its conjugate pair, and g in W <- W + g E'Z_1.

    p = a + ib, g = 2 sqrt(-a), d = a/b: Z = [g (Re V + d Im V), g sqrt(d^2 + 1) Im V] [BKS13], Z_1 its first q columns.
    """
    one = np.eye(q, dtype=complex)
    if p.imag == 0:
        g = float(np.sqrt(-2 * p.real))
        return np.asarray(g * one), g
    g, d = float(2 * np.sqrt(-p.real)), p.real / p.imag
    return np.hstack([g * (1 - 1j * d) * one, -1j * g * np.sqrt(d * d + 1) * one]), g


def adi_step(plant: Plant, tissue: ShiftedTissue, sweep: AdiSweep, queue: ShiftQueue) -> complex:
    """One solve, two real blocks of columns for a pair. Collective. Returns the shift."""
    q, m = sweep.W.columns, plant.inputs
    p, V = sweep.solve(tissue, queue)
    begin = time.perf_counter()
    coefficients, g = real_columns(p, q)
    Z = V.real(coefficients)
    small = np.zeros((Z.columns, q + 2 * m))
    np.fill_diagonal(small[:q, m : m + q], g)
    small[:, m + q :] = plant.inputs_of(Z)
    sweep.advance(V, coefficients, Z, small)
    sweep.Z.append(Z)
    sweep.seconds["products"] += time.perf_counter() - begin
    return p


def sweep_norms(plant: Plant, sweep: AdiSweep) -> tuple[float, float]:
    """||W W'||_2 of the Lyapunov and ||W W' - dK' dK||_2 of the Riccati residual, dK = K_new - K. Collective.

    Raises SolverError: the residual grows without bound: the closed loop of the gain is unstable.
    """
    begin = time.perf_counter()
    q, both = sweep.W.columns, sweep.state[plant.inputs :].block  # [W, dK']
    products = gram(plant.comm, both, both)
    # the eigenvalues of U S U' that are not zero are those of S U'U
    signed = products.copy()
    signed[q:] *= -1

    def norms() -> tuple[float, float]:
        if not np.isfinite(products).all():
            return np.inf, np.inf
        # LAPACK itself: the checks of the wrappers cost more than matrices of this order
        real, imag, _, _, failed = scipy.linalg.lapack.dgeev(signed, compute_vl=0, compute_vr=0)
        values, _, failed_too = scipy.linalg.lapack.dsyev(products[:q, :q], compute_v=0)
        if failed or failed_too:
            return np.inf, np.inf
        return float(values[-1]), float(np.hypot(real, imag).max())

    lyapunov, riccati = on_root(plant.comm, norms)  # the same bits on every rank: they decide when all stop
    sweep.first = max(sweep.first, lyapunov) if sweep.steps <= 1 else sweep.first
    if not (np.isfinite(lyapunov) and lyapunov <= GROWTH * sweep.first):
        raise SolverError(
            f"ADI diverges after {sweep.steps} solves (residual {lyapunov:.1e}): the start gain does not stabilise "
            "the plant; use the method radi, which needs no start, or add damping"
        )
    sweep.seconds["small"] += time.perf_counter() - begin
    return lyapunov, riccati
