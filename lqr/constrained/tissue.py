"""The tissue of a one-way plant in all its modes, and in a few shapes: static answers to the hand, then modes by cost.

One-way the tissue hears the hand through its acceleration a = M_s^{-1} (u - u_bar) alone, in full and in reduced form:

    eta'' + 2 delta eta' + omega^2 eta = -g a,    y_j = Y_j + q_s - q_bar + S_j eta

for the place y_j of node j, Y_j at the target, eta = 0 in equilibrium, 2 delta = alpha + beta omega^2. With a hand that
turns, by small angles, R_j (q_s - q_bar) stands for its displacement.

A hand that feels the tissue, M_s q_s'' + G'z'' = u, is the same plant about the centre of mass r = q_s + M_s^{-1} G'z,

    r'' = M_s^{-1} (u - u_bar),    (M_ee - G M_s^{-1} G') z'' + D z' + K z = -G r'',

with the modes of this smaller mass: r stands for q_s, the hand is at q_s = r + S_hand eta, S_hand = -M_s^{-1} G'Phi,
and every S_j contains S_hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, on_root, rows_on_all
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, ModalLoop

UNDAMPED = 1e-300  # [1/s]: a decay that stands for none
INDEPENDENT = 1e-8  # of a column: what the others leave of it is rounding below


@dataclass(frozen=True)
class ModalTissue:
    """eta'' + (alpha + beta omega^2) eta' + omega^2 eta = -g a."""

    omega: Array  # natural frequencies [1/s], ascending, (k,)
    alpha: float  # mass-proportional damping [1/s]
    beta: float  # stiffness-proportional damping [s]
    g: Array  # coupling to the hand, (k, n_s)
    seen: Array  # S, displacement of the nodes in each mode, (nodes, d, k)
    c: Array  # outputs of the modes, (p, k)
    of: Array | None = None  # of a reduced one, its shapes by the modes of the full one, (n, k)
    same: NDArray[np.int64] | None = None  # of a reduced one, number of the same mode of the full one, else -1, (k,)
    lowest: int | None = None  # number of modes where they are not all: static answers K^{-1} G follow them; else None
    hand: Array | None = None  # S_hand of a hand that feels the tissue, (n_s, k); else None
    rigid: Array | None = None  # R_j, motion of the nodes with a hand that turns, (nodes, d, n_s); else None

    @property
    def delta(self) -> Array:
        """Decay of every mode without feedback [1/s], (k,)."""
        return np.asarray((self.alpha + self.beta * self.omega**2) / 2)

    def reduced(self, k: int, grid: float) -> ModalTissue:
        """K^{-1} G and the modes that the bound of what is left out would feel most, as k modes of their own.

        The static shapes make the answer to a constant acceleration exact. Modes come in the order
        max_j |S_j| |g| / omega^2 (1 + |1 - e^{p grid}| / (1 - e^{-delta grid})), the l1 norm of an answer to pulses of
        length ``grid`` [s] at the node that moves most.

        Raises ControlError: there are no k shapes.
        """
        n, n_s = self.g.shape
        if not n_s < k <= n:
            raise ControlError(f"a plan needs {n_s + 1} to {n} shapes of the tissue, not {k}")
        slow = poles(self.omega, self.delta)[0]
        passed = np.abs(1 - np.exp(slow * grid)) / -np.expm1(np.minimum(slow.real, -UNDAMPED) * grid)
        lost = np.linalg.norm(self.seen, axis=1).max(axis=0) * np.linalg.norm(self.g, axis=1) * (1 + passed)
        kept = np.sort(np.argsort((-lost / self.omega**2)[: self.lowest], kind="stable")[: k - n_s])
        shapes = static_shapes(self.omega, self.g, kept)
        squares, T = np.linalg.eigh(shapes.T @ (self.omega[:, None] ** 2 * shapes))
        omega, V = np.concatenate([self.omega[kept], np.sqrt(squares)]), np.hstack([np.eye(n)[:, kept], shapes @ T])
        order, same = np.argsort(omega, kind="stable"), np.append(kept, np.full(len(squares), -1))
        V = V[:, order]
        hand = None if self.hand is None else self.hand @ V
        return ModalTissue(
            omega[order], self.alpha, self.beta, V.T @ self.g, self.seen @ V, self.c @ V, V, same[order], None, hand,
            self.rigid,
        )  # fmt: skip

    @property
    def relative(self) -> Array:
        """Displacement of the nodes from the hand in each mode, (nodes, d, k)."""
        return self.seen if self.hand is None else self.seen - self.hand

    def answer(self, a: Array, grid: float, parts: int) -> Array:
        """Amplitudes eta at the instants of all intervals under accelerations held from rest, (H, parts + 1, k).

        ``a``: acceleration u - u_bar over M_s of every interval [m/s2], (H, n_s).
        """
        p, m, _ = poles(self.omega, self.delta)
        s = grid * np.arange(parts + 1)[:, None] / parts
        slow, fast = np.exp(p * s), np.exp(m * s)
        eta, rate = np.zeros(len(p)), np.zeros(len(p))
        result = np.empty((len(a), parts + 1, len(p)))
        for k, static in enumerate(-(a @ self.g.T) / self.omega**2):
            first = (rate - m * (eta - static)) / (p - m)  # eta - static = first e^{ps} + second e^{ms}
            second = eta - static - first
            result[k] = (first * slow + second * fast).real + static
            eta, rate = result[k, -1], (p * first * slow[-1] + m * second * fast[-1]).real
        return result


def static_shapes(omega: Array, g: Array, kept: NDArray[np.int64]) -> Array:
    """What modes leave of K^{-1} G: orthonormal columns of amplitudes, those of rounding left out, (n, <= n_s).

    Args:
        omega: natural frequencies [1/s], (n,).
        g: coupling to the hand, (n, n_s).
        kept: numbers of the modes.
    """
    static = g / omega[:, None] ** 2
    static = static / np.linalg.norm(static, axis=0)
    static[kept] = 0.0
    shapes = np.zeros((len(omega), 0))
    for column in static.T:
        for _ in range(2):
            column = column - shapes @ (shapes.T @ column)
        size = np.linalg.norm(column)
        if size > INDEPENDENT:
            shapes = np.column_stack([shapes, column / size])
    return shapes


def poles(omega: Array, delta: Array) -> tuple[np.ndarray, np.ndarray, NDArray[np.bool_]]:
    """The roots p and m of every mode, p the slower one, and which modes are overdamped."""
    gap = delta**2 - omega**2
    # equal roots are moved apart by less than rounding sees
    gap = np.where(np.abs(gap) < 1e-12 * omega**2, -1e-12 * omega**2, gap)
    root = np.sqrt(gap.astype(complex))
    return -delta + root, -delta - root, gap > 0


@dataclass(frozen=True)
class Surface:
    """Nodes on the boundary of the body: those of the tissue, rank by rank, then those that the hand holds."""

    rows: NDArray[np.int64]  # local tissue dofs of the free ones of this rank, (here, d)
    first: int  # number among all free ones of the first of this rank
    free: int  # number of free ones
    nodes: Array  # places in the undeformed body [m], (nodes, d)
    kept: NDArray[np.int64] | None = None  # numbers of those that keep gaps, ascending; None: all
    rigid: Array | None = None  # R_j, motion of the nodes with a hand that turns, (nodes, d, n_s); else None

    def keeping(self) -> Surface:
        """The nodes that keep gaps, as a surface of their own."""
        if self.kept is None:
            return self
        here = self.kept[(self.kept >= self.first) & (self.kept < self.first + len(self.rows))] - self.first
        first, free = (int(np.searchsorted(self.kept, number)) for number in (self.first, self.free))
        rigid = None if self.rigid is None else self.rigid[self.kept]
        return Surface(self.rows[here], first, free, self.nodes[self.kept], None, rigid)

    def with_hand(self, q_s: Array) -> Array:
        """Displacement of the nodes with the hand alone, q_s (.., n_s), (.., nodes or 1, d)."""
        if self.rigid is None:
            return np.asarray(q_s[..., None, :])
        return np.asarray(np.einsum("jds,...s->...jd", self.rigid, q_s))

    @property
    def arms(self) -> Array:
        """Distances of the nodes from the point about which the hand turns [m], (nodes,); zero where it does not."""
        d = self.nodes.shape[1]
        if self.rigid is None:
            return np.zeros(len(self.nodes))
        return np.asarray(np.sqrt((self.rigid[:, :, d:] ** 2).sum(axis=(1, 2)) / (d - 1)))

    def of(self, body: Array) -> Array:
        """The nodes that keep gaps, of places of all, (.., nodes, d)."""
        return body if self.kept is None else body[..., self.kept, :]


def make_surface(layout: BlockLayout, free: np.ndarray, held: np.ndarray) -> Surface:
    """From the flags of this rank's free and held nodes. Collective."""
    d, comm, chosen = layout.dimension, layout.comm, np.flatnonzero(free)
    counts = comm.allgather(len(chosen))
    here = layout.held[held] if len(layout.held) else np.zeros((0, d))
    nodes = np.vstack([rows_on_all(comm, layout.nodes[chosen]), rows_on_all(comm, here)])
    rows = chosen[:, None] * d + np.arange(d)
    return Surface(rows, sum(counts[: comm.rank]), sum(counts), nodes)


def modal_tissue(problem: RiccatiProblem, surface: Surface, loop: ModalLoop | None = None) -> ModalTissue:
    """All modes of the tissue of a plant, of ``loop`` where they are known. Collective.

    Raises ControlError: the plant has no plan, see :func:`require_plannable`.
    """
    system, layout = problem.system, problem.layout
    d = layout.dimension
    require_plannable(problem)
    plant = (loop or ModalLoop(problem, DENSE_LIMIT)).plant
    seen = np.zeros((len(surface.nodes), d, len(plant.omega)))
    seen[: surface.free] = rows_on_all(layout.comm, plant.Phi[surface.rows])
    tissue = ModalTissue(
        plant.omega, system.damping.alpha, system.damping.beta, plant.g, seen, plant.c, rigid=surface.rigid
    )
    return on_root(layout.comm, lambda: _about_centre(problem, tissue)) if system.two_way else tissue


def _about_centre(problem: RiccatiProblem, tissue: ModalTissue) -> ModalTissue:
    """The tissue of a hand that feels it, in the modes of M_ee - G M_s^{-1} G'."""
    moved = np.linalg.solve(problem.M_s, tissue.g.T)  # M_s^{-1} G'Phi, (n_s, n)
    squares, V = scipy.linalg.eigh(np.diag(tissue.omega**2), np.eye(len(tissue.omega)) - tissue.g @ moved)
    hand = -moved @ V
    seen, c = tissue.seen @ V + hand, tissue.c @ V + problem.C_s @ hand
    return ModalTissue(np.sqrt(squares), 0.0, tissue.beta, V.T @ tissue.g, seen, c, hand=hand)


def require_plannable(problem: RiccatiProblem) -> None:
    """Raises ControlError: the plant has no plan, whatever its gain."""
    reason = _not_planned(problem)
    if reason:
        raise ControlError(f"a plan past obstacles is made for {reason}")


def _not_planned(problem: RiccatiProblem) -> str:
    """What a plan needs and this plant has not; empty where it has all."""
    system, layout = problem.system, problem.layout
    if layout.order != 1:
        return f"elements of order 1, whose edges stay straight; this scene has order {layout.order}"
    if layout.n_s != layout.dimension and system.two_way:
        return "a hand that does not turn, or does not feel the tissue; leave out effects.rotation or effects.reaction"
    if system.two_way and system.damping.alpha:
        return "a hand that feels the tissue only with Kelvin-Voigt damping; set effects.damping.alpha to zero"
    if system.points is not None:
        return "the linear plant; leave out effects.finite_strain"
    if system.own_load is not None:
        return "tissue under gravity alone; leave out the terms that add a load"
    if system.damping.matrix is not None or system.damping.drag:
        return "damping that is the same in all layers and acts against the hand"
    return ""
