"""What the modes beyond the known ones answer to a held acceleration: runs of the full plant, with proved errors.

After a step of the acceleration the tissue goes to its static answer -K^{-1}G a, and what is left of the way is a free
motion of the full plant. With the known modes taken out, X = K^{-1}G - sum_m phi_m g_m / omega_m^2,

    z(t) = -X a + zeta(t) a,    M zeta'' + D zeta' + K zeta = 0,    zeta(0) = X,    zeta'(0) = 0.

One run for every column of X: five solves with M + gamma h D + (gamma h)^2 K a step, the L-stable rule
x_{n+1} = sum_i c_i (1 - gamma h A)^{-i} x_n of order 5 [HW96], with short steps first. Every mode m of the run follows
the same scalar function of omega_m, f_h instead of f, so that at a node j

    |c_j'(zeta_h - zeta)| <= |c_j|_{K^{-1}} |X|_K max over omega of |f_h - f|,

both norms without the known modes; chords between two instants, and what follows the last one, are bounded the same
way. Frequencies are a fine grid from the last known one to the highest of the mesh; what is between two of them,
rounding and the residual of the known modes are not bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, factorial

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, rows_on_all, times_columns, total
from softgrasp.fem.solve.solvers import make_solver
from softgrasp.fem.solve.stiffness import static_columns, static_solver
from softgrasp.fem.system import dynamic_stiffness
from softgrasp.lqr.constrained.tissue import ModalTissue, Surface, poles
from softgrasp.lqr.lowrank.shifts import frequency_estimate
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.modal_loop import LOWEST_MODES
from softgrasp.lqr.spectrum.tail import schur_mass, tail_modes

PREFIX = "softgrasp_pulse_"
GAMMA, ORDER = 0.2780538410, 5  # of the rule: with it the error of order 5 vanishes too [HW96, table IV.6.4]
STEPS = 256  # of equal length that an interval would have
SAME, HALVINGS = 8, 8  # steps of one length before it is doubled, so many times, from the start on
FORGOTTEN = 1e-4  # of the free motion: it is bounded then, no longer run
MOST_INTERVALS = 20  # that are run
FREQUENCIES = 1000  # between the last known mode and the highest one
INSIDE = 7  # places between two instants where the distance from a chord is taken
TOGETHER = 64  # rows of nodes behind one factor


@dataclass(frozen=True)
class Rest:
    """Pulse responses of the modes beyond the known ones on the nodes, with bounds of their errors."""

    instants: Array  # of an interval, 0 to Delta [s], (I + 1,)
    moved: Array  # zeta of unit accelerations at the instants of intervals 0, .., K - 1, (K, I + 1, nodes, d, n_s)
    size: Array  # |c_j|_{K^{-1}} |X|_K, (nodes, d, n_s)
    steps: Array  # max |f_h - f| at the instants, summed over intervals, (I + 1,)
    chords: Array  # largest distance of f from its chord between two instants, summed over intervals, (I,)
    later: float  # bound on the sum of |f| over all later intervals

    def kernel(self, i: int) -> Array:
        """w(s_i) of pulses 0, .., K intervals ago, (nodes, d, n_s, K + 1)."""
        zeta = np.moveaxis(self.moved[:, i], 0, -1)
        begin = self.moved[0, 0][..., None]
        return np.concatenate([zeta[..., :1] - begin, np.diff(zeta, axis=-1), -zeta[..., -1:]], axis=-1)

    def error(self, i: int) -> Array:
        """Bound on what sum_k |w_k(s_i)| errs by the run's own steps and by all that follows it, (nodes, d, n_s)."""
        return np.asarray(2 * self.size * (self.steps[i] + self.later))

    def between(self, i: int) -> Array:
        """Bound on how far sum_k |w_k| exceeds its chord between instants i and i + 1, (nodes, d, n_s)."""
        return np.asarray(2 * self.size * self.chords[i])


def known_tissue(problem: RiccatiProblem, surface: Surface) -> tuple[ModalTissue, Array]:
    """The lowest modes, then the rest of the static answers K^{-1} G as modes of their own. Collective.

    Returns it with its shapes, local rows (n_local, k + n_s); two-way it is the tissue about the centre of mass.

    Raises SolverError: a mode does not converge, or a solve failed.
    """
    system, comm = problem.system, problem.layout.comm
    omega, Phi = tail_modes(problem, min(LOWEST_MODES, problem.layout.n_e - problem.layout.n_s))
    g = total(comm, Phi.T @ system.G)
    X = static_columns(system, np.asfortranarray(system.G)) - Phi @ (g / omega[:, None] ** 2)
    M, K = (total(comm, X.T @ part) for part in (schur_mass(problem, X), times_columns(system.K_ee, X)))
    squares, T = scipy.linalg.eigh((K + K.T) / 2, (M + M.T) / 2)
    V = np.hstack([Phi, X @ T])
    seen = np.zeros((len(surface.nodes), problem.layout.dimension, V.shape[1]))
    seen[: surface.free] = rows_on_all(comm, V[surface.rows])
    g, c, hand = total(comm, V.T @ system.G), total(comm, problem.C_z.T @ V), None
    if system.two_way:
        hand = -np.linalg.solve(problem.M_s, g.T)
        seen, c = seen + hand, c + problem.C_s @ hand
    damping = system.damping
    omega = np.concatenate([omega, np.sqrt(squares)])
    return ModalTissue(omega, damping.alpha, damping.beta, g, seen, c, None, None, len(g) - len(squares), hand,
                       surface.rigid), V  # fmt: skip


def run_rest(problem: RiccatiProblem, surface: Surface, known: ModalTissue, V: Array, grid: float) -> Rest:
    """The free motion of what is beyond the known modes, until it is forgotten. Collective.

    Args:
        known: lowest modes and static answers, see :func:`known_tissue`.
        V: its shapes, local rows.
        grid: length of an interval Delta [s].

    Raises SolverError: a solve failed.
    """
    comm, k = problem.layout.comm, known.lowest
    assert k is not None
    X = V[:, k:] @ (known.g[k:] / known.omega[k:, None] ** 2)
    blocks = [(grid * h, steps) for h, steps in _blocks()]
    fastest = max(4 * frequency_estimate(problem.system), 2 * known.omega[-1])  # estimated within a factor of 4
    omega = np.geomspace(known.omega[k - 1], fastest, FREQUENCIES)
    scalar = _Scalar(omega, (known.alpha + known.beta * omega**2) / 2)
    count = next((i for i in range(1, MOST_INTERVALS) if scalar.size(i * grid) < FORGOTTEN), MOST_INTERVALS)
    energy = total(comm, np.einsum("ij,ij->j", X, times_columns(problem.system.K_ee, X)))
    size = _node_sizes(problem, surface, known, k)[..., None] * np.sqrt(np.maximum(energy, 0.0))
    moved = _run(problem, surface, X, blocks, count)
    steps, chords = scalar.errors(blocks, count)
    instants = np.concatenate([[0.0], np.cumsum([h for h, steps in blocks for _ in range(steps)])])
    return Rest(instants, moved, size, steps, chords, scalar.later(count * grid, grid))


def _blocks() -> list[tuple[float, int]]:
    """Steps of an interval of length 1, short ones first: their length and their number."""
    short = [(2.0 ** (i - HALVINGS) / STEPS, SAME) for i in range(HALVINGS)]
    return [(short[0][0], SAME), *short, (1 / STEPS, STEPS - SAME)]


def _weights() -> Array:
    """c_1, .., c_5 of e^z = sum_i c_i (1 - gamma z)^{-i} + O(z^6)."""
    i, j = np.arange(1, ORDER + 1), range(ORDER)
    powers = np.array([[comb(a + b - 1, b) * GAMMA**b for a in i.tolist()] for b in j])
    return np.asarray(np.linalg.solve(powers, [1 / factorial(b) for b in j]))


class _Scalar:
    """f'' + 2 delta f' + omega^2 f = 0, f(0) = 1, f'(0) = 0, of many frequencies, exactly and by the rule of a run."""

    def __init__(self, omega: Array, delta: Array) -> None:
        self.omega, self.delta = omega, delta
        self.p, self.m, _ = poles(omega, delta)

    def exact(self, t: Array) -> Array:
        """Values of f at times (..,), (.., frequencies)."""
        t = t[..., None]
        both = self.p * np.exp(self.m * t) - self.m * np.exp(self.p * t)
        return np.asarray((both / (self.p - self.m)).real)

    def size(self, t: float) -> float:
        """Bound on |f| from a time on."""
        return float(np.max((np.abs(self.p) + np.abs(self.m)) / np.abs(self.p - self.m) * np.exp(self.p.real * t)))

    def later(self, t: float, grid: float) -> float:
        """Bound on sum_k |f(t + k grid + s)| for every s >= 0; infinite where nothing is damped."""
        first = (np.abs(self.p) + np.abs(self.m)) / np.abs(self.p - self.m) * np.exp(self.p.real * t)
        with np.errstate(divide="ignore"):
            return float(np.max(first / -np.expm1(self.p.real * grid)))

    def errors(self, blocks: list[tuple[float, int]], count: int) -> tuple[Array, Array]:
        """Of the rule at the instants, and of chords between them, summed over ``count`` intervals."""
        z, v = np.ones(len(self.omega)), np.zeros(len(self.omega))
        square, twice, t = self.omega**2, 2 * self.delta, 0.0
        steps, chords = [], []
        weights = _weights()
        for h, number in blocks * count:
            s = 1 / (GAMMA * h)
            for _ in range(number):
                a, b = z, v
                z, v = np.zeros_like(z), np.zeros_like(v)
                for c in weights:
                    moved = (s * b + s * (s + twice) * a) / (s * s + s * twice + square)
                    a, b = moved, s * (moved - a)
                    z, v = z + c * a, v + c * b
                between = self.exact(t + h * np.linspace(0, 1, INSIDE + 2))
                share = np.linspace(0, 1, INSIDE + 2)[:, None]
                chords.append(float(np.abs(between - (1 - share) * between[0] - share * between[-1]).max()))
                t += h
                steps.append(float(np.abs(between[-1] - z).max()))
        each = len(steps) // count
        at_end = np.array(steps).reshape(count, each)
        begins = np.concatenate([[0.0], at_end[:-1, -1]])
        both = np.column_stack([begins, at_end]).sum(axis=0)
        return both, np.array(chords).reshape(count, each).sum(axis=0)


class _Shifted:
    """(s^2 M + s D + K)^{-1} X of the tissue, two-way with the hand floating."""

    def __init__(self, problem: RiccatiProblem, s: float) -> None:
        system, layout = problem.system, problem.layout
        self.problem, self.s, self.comm = problem, s, layout.comm
        name = static_solver(system)
        self.solver = make_solver(dynamic_stiffness(system, s), name, layout, PREFIX, rtol=1e-12)
        if system.two_way:
            self.S_G = self.solver.columns(np.asfortranarray(system.G))
            self.small = np.linalg.inv(problem.M_s - s**2 * total(self.comm, system.G.T @ self.S_G))

    def columns(self, X: Array) -> Array:
        """Local rows. Collective."""
        Y, system = self.solver.columns(X), self.problem.system
        if system.two_way:
            Y = Y + self.s**2 * self.S_G @ (self.small @ total(self.comm, system.G.T @ Y))
        return Y


def _run(problem: RiccatiProblem, surface: Surface, X: Array, blocks: list[tuple[float, int]], count: int) -> Array:
    """Nodes under the free motion from X at the instants of intervals, (count, I + 1, nodes, d, n_s). Collective."""
    damping, K_ee = problem.system.damping, problem.system.K_ee
    Z, V, weights = np.asfortranarray(X), np.zeros_like(X, order="F"), _weights()
    seen, shown = [_seen(problem, surface, Z)], []
    for _ in range(count):
        for h, number in blocks:
            s = 1 / (GAMMA * h)
            shifted = _Shifted(problem, s)
            try:
                for _ in range(number):
                    A, B, Z, V = Z, V, np.zeros_like(Z), np.zeros_like(V)
                    for c in weights:
                        load = schur_mass(problem, s * B + s * (s + damping.alpha) * A)
                        load += s * damping.beta * times_columns(K_ee, A)
                        moved = shifted.columns(np.asfortranarray(load))
                        A, B = moved, s * (moved - A)
                        Z, V = Z + c * A, V + c * B
                    seen.append(_seen(problem, surface, Z))
            finally:
                shifted.solver.destroy()
        shown.append(np.array(seen))
        seen = seen[-1:]
    return np.array(shown)


def _seen(problem: RiccatiProblem, surface: Surface, Z: Array) -> Array:
    """Displacement of the nodes, two-way about the centre of mass, (nodes, d, n_s). Collective."""
    result = np.zeros((len(surface.nodes), problem.layout.dimension, Z.shape[1]))
    result[: surface.free] = rows_on_all(problem.layout.comm, Z[surface.rows])
    if problem.system.two_way:
        result -= np.linalg.solve(problem.M_s, total(problem.layout.comm, problem.system.G.T @ Z))
    return result


def _node_sizes(problem: RiccatiProblem, surface: Surface, known: ModalTissue, k: int) -> Array:
    """|c_j|_{K^{-1}} of every node without the known modes, (nodes, d). Collective."""
    layout, system = problem.layout, problem.system
    d, comm = layout.dimension, layout.comm
    push = system.G @ np.linalg.inv(problem.M_s) if system.two_way else np.zeros((layout.n_local, layout.n_s))
    squares = np.zeros((len(surface.nodes), d))
    held = np.repeat(np.arange(surface.free, len(surface.nodes)), d)[: d if system.two_way else 0]
    every = [(j, a) for j in range(surface.free) for a in range(d)] + [(j, a) for a, j in enumerate(held.tolist())]
    for begin in range(0, len(every), TOGETHER):
        some = every[begin : begin + TOGETHER]
        columns = np.zeros((layout.n_local, len(some)), order="F")
        for i, (j, a) in enumerate(some):
            columns[:, i] = -push[:, a]
            here = j - surface.first
            if 0 <= here < len(surface.rows):
                columns[surface.rows[here, a], i] += 1.0
        parts = total(comm, np.einsum("ij,ij->j", columns, static_columns(system, columns)))
        for (j, a), square in zip(some, parts, strict=True):
            squares[j, a] = square
    if len(held):
        squares[surface.free :] = squares[surface.free]
    squares -= np.sum((known.seen[:, :, :k] / known.omega[:k]) ** 2, axis=-1)
    return np.sqrt(np.maximum(squares, 0.0))
