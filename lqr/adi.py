"""Low-rank ADI in real arithmetic for the Lyapunov equation of one Newton step."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fem.errors import SolverError
from fem.petsc import Array
from lqr.adjoint import Right, Solution, closed_adjoint
from lqr.compress import compress, gram
from lqr.plant import Block, Plant
from lqr.shifted import ShiftedTissue
from lqr.shifts import WINDOW, ShiftQueue
from reduction.engines import on_root

Progress = Callable[[dict[str, float]], None]
SQUEEZE = 480  # columns of Z from which it is compressed on the way: memory of a large scene
SHARE = 0.02  # of the tolerance that one compression on the way may use up
GROWTH = 1e6  # of the residual against its start: the closed loop of the given gain is unstable


class Columns:
    """Z as it grows, in costate form; compressed when it gets wide.

    Args:
        plant: the plant.
        allowed: what a compression on the way may change in the Riccati residual.
        limit: columns from which it is compressed.
    """

    def __init__(self, plant: Plant, allowed: float, limit: int = SQUEEZE) -> None:
        self.plant, self.allowed, self.limit = plant, allowed, limit
        self.count = self.compressed_to = self.appended = 0
        # rows side by side in memory: what the sparse products want
        self.hand, self.tall = np.empty((2 * plant.n_s, 64)), np.empty((2 * plant.n_local, 64))
        self.widths: list[int] = []

    def append(self, block: Block) -> None:
        """Add columns. Collective."""
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
        new = np.empty((len(old), room))
        new[:, : self.count] = old[:, : self.count]
        return new

    @property
    def block(self) -> Block:
        """All columns (views)."""
        return Block(self.hand[:, : self.count], self.tall[:, : self.count])

    def recent(self) -> Block:
        """Columns of the last :data:`lqr.shifts.WINDOW` blocks (views)."""
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
class Sweep:
    """State of one ADI sweep for A_c'XE + E'XA_c = -W_0 W_0', A_c = A - B K.

    Attributes:
        gain: K' of the sweep.
        W: residual factor, W W' is the Lyapunov residual.
        new: (B'XE)' of the X found so far.
        Z: its factor.
        steps: solves so far.
        first: ||W_0 W_0'||.
    """

    gain: Right
    W: Right
    new: Right
    Z: Columns
    steps: int = 0
    first: float = 0.0
    seconds: dict[str, float] = field(default_factory=lambda: {"shifts": 0.0, "small": 0.0, "products": 0.0})


def zero_like(right: Right) -> Right:
    """A right-hand side of zeros. Not collective."""
    block = Block(np.zeros_like(right.block.hand), np.zeros_like(right.block.tall))
    return Right(block, np.zeros_like(right.a))


def start_sweep(plant: Plant, outputs: Right, gain: Right, tol: float) -> Sweep:
    """W_0 = [C', K']. Not collective."""
    return Sweep(gain, Right.join([outputs, gain]), zero_like(gain), Columns(plant, SHARE * tol * plant.scale))


def real_columns(p: complex, V: Solution) -> tuple[Block, Array]:
    """Real columns of Z for a shift (or its conjugate pair), and W <- W + E'Z small.

    p = a + ib, g = 2 sqrt(-a), d = a/b: Z = [g (Re V + d Im V), g sqrt(d^2 + 1) Im V] [BKS13]. Not collective.
    """
    q = V.hand.shape[1]
    one, zero = np.eye(q), np.zeros((q, q))
    if p.imag == 0:
        g = np.sqrt(-2 * p.real)
        return V.parts(g * one, zero), g * one
    g, d = 2 * np.sqrt(-p.real), p.real / p.imag
    Z = V.parts(np.hstack([g * one, zero]), np.hstack([g * d * one, g * np.sqrt(d * d + 1) * one]))
    return Z, np.vstack([g * one, zero])


def adi_step(plant: Plant, tissue: ShiftedTissue, sweep: Sweep, queue: ShiftQueue) -> complex:
    """One solve, two real blocks of columns for a pair. Collective. Returns the shift."""
    begin = time.perf_counter()
    if not queue.pending:
        queue.refill(plant, sweep.Z.recent(), sweep.W.block, sweep.gain)
    p, ahead = queue.next()
    middle = time.perf_counter()
    V = closed_adjoint(plant, tissue, p, sweep.W, sweep.gain, ahead)
    last = time.perf_counter()
    Z, small = real_columns(p, V)
    E_Z = plant.mass_adjoint(Z)
    a = Z.tall[: plant.n_local]
    sweep.W = sweep.W.plus(E_Z, a, small)
    sweep.new = sweep.new.plus(E_Z, a, plant.felt(Z))
    sweep.Z.append(Z)
    sweep.steps += 1
    sweep.seconds["shifts"] += middle - begin
    sweep.seconds["products"] += time.perf_counter() - last
    return p


def sweep_norms(plant: Plant, sweep: Sweep) -> tuple[float, float]:
    """||W W'||_2 of the Lyapunov and ||W W' - dK' dK||_2 of the Riccati residual, dK = K_new - K. Collective.

    Raises:
        SolverError: the residual grows without bound: the closed loop of the gain is unstable.
    """
    begin = time.perf_counter()
    W = sweep.W.block
    change = Block(sweep.new.block.hand - sweep.gain.block.hand, sweep.new.block.tall - sweep.gain.block.tall)
    q, both = W.columns, Block.join([W, change])
    products = gram(plant.comm, both, both)
    # the eigenvalues of U S U' that are not zero are those of S U'U
    signs = np.concatenate([np.ones(q), -np.ones(change.columns)])

    def norms() -> tuple[float, float]:
        riccati = float(np.abs(np.linalg.eigvals(signs[:, None] * products)).max())
        return float(np.linalg.eigvalsh(products[:q, :q])[-1]), riccati

    lyapunov, riccati = on_root(plant.comm, norms)  # the same bits on every rank: they decide when all stop
    sweep.first = max(sweep.first, lyapunov) if sweep.steps <= 1 else sweep.first
    if not lyapunov <= GROWTH * sweep.first:
        raise SolverError(
            f"ADI diverges after {sweep.steps} solves (residual {lyapunov:.1e}): the start gain does not stabilise "
            "the plant; use the method radi, which needs no start, or add damping"
        )
    sweep.seconds["small"] += time.perf_counter() - begin
    return lyapunov, riccati
