"""Shifts of ADI and RADI: closed-loop poles of the modal problem, then clipped Ritz values in the energy product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from mpi4py import MPI

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.lowrank.adjoint import AdjointRhs
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.block import Block

WINDOW = 10  # blocks of Z whose Ritz values give the next shifts
EARLY = 1  # shifts still to come when the next are chosen: another core or rank can factor ahead meanwhile
BATCH = 8  # solves between two projections
LOWEST = 1e-2  # of the smallest closed-loop frequency: a Ritz value nearer to the hand's zero poles is spurious
HIGHEST = 10.0  # of the largest frequency
SHARP = 0.05  # damping ratio below which a mode needs a shift of its own; others share the Ritz values
FLAT = 1e-7  # a pair this near to the real axis is a double real shift to rounding of 1 / Im p
AXIS = 1e-9  # a shift keeps at least this share of its modulus away from the imaginary axis


@dataclass(frozen=True)
class ShiftRange:
    """Moduli that a shift may have [1/s]."""

    low: float  # smallest modulus [1/s]
    high: float  # largest modulus [1/s]

    def clip(self, values: np.ndarray) -> np.ndarray:
        """Nearest admissible shifts in the left half plane, Im >= 0, (k,)."""
        size = np.abs(values)
        usable = np.isfinite(size) & (size > 0)
        values, size = np.where(usable, values, -self.low), np.where(usable, size, self.low)
        factor = np.clip(size, self.low, self.high) / size
        real, imag = -np.abs(values.real) * factor, np.abs(values.imag) * factor
        flat = imag <= FLAT * size * factor
        real = np.where(flat, real, np.minimum(real, -AXIS * size * factor))
        return np.asarray(real + 1j * np.where(flat, 0.0, imag))


def frequency_estimate(system: BlockSystem) -> float:
    """Highest frequency [1/s], omega_max^2 >= max K_ii / M_ii, to a factor of 4 for Lagrange elements. Collective."""
    K, M = system.K_ee.getDiagonal(), system.M_ee.getDiagonal()
    local = float((K.array_r / M.array_r).max(initial=0.0))
    K.destroy()
    M.destroy()
    return float(np.sqrt(system.layout.comm.allreduce(local, op=MPI.MAX)))


def shift_range(plant: Plant, poles: np.ndarray) -> ShiftRange:
    """Range between the slowest pole of the modal problem and the fastest tissue mode. Collective."""
    largest = frequency_estimate(plant.system)
    slowest = float(np.min(np.abs(poles))) if len(poles) else 1e-3 * largest
    return ShiftRange(LOWEST * slowest, HIGHEST * max(largest, plant.system.damping.beta * largest**2))


def ritz_pairs(plant: Plant, V: Block, W: Block, gain: AdjointRhs | None) -> tuple[np.ndarray, Array]:
    """Ritz values of (A - B K)' on span E'V in the energy inner product, and how much of the residual lies on each.

    H^{-1}, H = blkdiag(1, M_s, K_ee, M_ee): without feedback the plant is dissipative in this product, so no Ritz value
    is unstable. Collective.

    ``V``: columns of Z, costate form; ``W``: residual factor; ``gain``: K', None for K = 0.

    Returns the values, and the norm of the component of W along each Ritz vector.
    """
    empty = Block(np.zeros((2 * plant.n_s, 0)), np.zeros((2 * plant.n_local, 0)))
    F, G, seen, X_part = energy_products(plant, V, W, empty if gain is None else gain.block)
    if gain is not None:
        F -= X_part @ plant.inputs_of(V).T
    return on_root(plant.comm, lambda: _pencil_pairs(F, G, seen))


def energy_products(plant: Plant, V: Block, W: Block, X: Block) -> tuple[Array, Array, Array, Array]:
    """V'H^{-1} times A'V, E'V, W and X, from one product each with K_ee, M_ee and the matrix of the damping.

    On the tissue V'H^{-1}E'V = a'K a + b'M b and V'H^{-1}A'V = b'K a - (b'K a)' - b'D b. Collective.
    """
    k, (a_s, b_s, a, b) = V.columns, V.parts
    both = np.hstack([a, b])
    stiff, a, b = plant.stiff(both), both[:, :k], both[:, k:]
    kinetic, (power, G_K) = b.T @ plant.mass(b), np.split(b.T @ stiff, 2, axis=1)
    damping = plant.system.damping
    resisted = damping.alpha * kinetic + damping.beta * G_K
    if plant.viscous is not None:
        resisted += b.T @ plant.viscous(b)
    parts = [
        power - power.T - resisted,
        a.T @ stiff[:, :k] + kinetic,
        V.tall.T @ W.tall,
        V.tall.T @ X.tall,
        b.T @ plant.G,
    ]
    widths = np.cumsum([k, k, W.columns, X.columns])
    F, G, seen, X_part, coupling = np.split(total(plant.comm, np.hstack(parts)), widths, axis=1)
    E_hand = plant.M_s @ b_s + coupling.T
    A_hand = a_s - plant.drag_es * coupling.T - plant.drag_hand * (plant.system.M_rigid @ b_s)
    if plant.two_way:  # the hand's share in the rows of the tissue
        F, G = F - plant.drag_hand * coupling @ b_s, G + coupling @ b_s
    # H^{-1} E'V: two-way the mass blocks of hand and tissue invert together
    test_q, test_v = a_s, b_s if plant.two_way else np.linalg.solve(plant.M_s, E_hand)
    test = np.vstack([test_q, test_v])
    F += test_v.T @ A_hand
    G += test_q.T @ a_s + test_v.T @ E_hand
    return F, G, seen + test.T @ W.hand, X_part + test.T @ X.hand


def _pencil_pairs(F: Array, G: Array, W: Array) -> tuple[np.ndarray, Array]:
    """Eigenvalues of (F, G) on the numerical range of the symmetric part of G, and components of W."""
    scale = np.sqrt(np.maximum(np.diag(G), 1e-300))
    G, F, W = G / scale / scale[:, None], F / scale / scale[:, None], W / scale[:, None]
    sizes, vectors = np.linalg.eigh((G + G.T) / 2)
    keep = sizes > 1e-12 * sizes[-1]  # of the Gram matrix: columns independent to 1e-6
    basis = vectors[:, keep] / np.sqrt(sizes[keep])
    values, ritz = np.linalg.eig(basis.T @ F @ basis)
    return values, np.linalg.norm(np.linalg.solve(ritz, basis.T @ W), axis=1)


def choose_shifts(candidates: np.ndarray, weights: Array, count: int, planned: Sequence[complex] = ()) -> list[complex]:
    """Greedy choice: the candidate where most of the residual is left, after the shifts chosen before it.

    Like the min-max choice of [P00], with the components of the residual in place of 1: a pole whose residual is
    already annihilated is not used again, one that the outputs hardly see is used late.

    Args:
        candidates: admissible values, Re < 0, Im >= 0.
        weights: size of the residual at each.
        count: number of shifts; a complex one counts for its pair.
        planned: shifts that will be used before them.
    """
    size = np.log(np.maximum(weights, 1e-300))

    def left(p: complex) -> Array:
        factor = np.abs((candidates - np.conj(p)) / (candidates + p))
        if p.imag:
            factor = factor * np.abs((candidates - p) / (candidates + np.conj(p)))
        return np.asarray(np.log(np.maximum(factor, 1e-300)))

    for p in planned:
        size = size + left(p)
    chosen: list[complex] = []
    while len(chosen) < min(count, len(candidates)):
        p = complex(candidates[int(np.argmax(size))])
        size = size + left(p)
        chosen.append(p)
    return chosen


@dataclass
class ShiftQueue:
    """The next shifts of one sweep."""

    limits: ShiftRange  # admissible moduli
    pending: list[complex] = field(default_factory=list)  # shifts not used yet, next one first [1/s]

    @classmethod
    def start(cls, limits: ShiftRange, poles: Sequence[complex] | np.ndarray) -> ShiftQueue:
        """The hand's and the lightly damped poles in their order, clipped, doubles removed."""
        pending: list[complex] = []
        for i, p in enumerate(limits.clip(np.asarray(poles, dtype=complex)).tolist()):
            important = i < 4 or -p.real < SHARP * abs(p)
            if important and all(abs(p - q) > 1e-3 * abs(p.real) for q in pending):
                pending.append(p)
        return cls(limits, pending)

    def short(self, steps: int) -> bool:
        """Whether more shifts are due after so many steps."""
        return not self.pending or (steps > 0 and len(self.pending) <= EARLY)

    def refill(self, plant: Plant, recent: Block, W: Block, gain: AdjointRhs | None) -> None:
        """Ritz values of the recent blocks, clipped and chosen. Collective."""
        values, sizes = ritz_pairs(plant, recent, W, gain)
        upper = values.imag >= 0
        clipped = self.limits.clip(values[upper])
        weights = sizes[upper] * np.abs(clipped)  # from the energy norm to the 2-norm of the residual
        self.pending += on_root(plant.comm, partial(choose_shifts, clipped, weights, BATCH, self.pending))

    def next(self) -> tuple[complex, list[complex]]:
        """The next shift and those after it."""
        return self.pending.pop(0), self.pending[:]
