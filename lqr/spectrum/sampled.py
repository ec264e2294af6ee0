"""Spectral radius of a loop with sampled, held and delayed input; a continuous-time certificate does not cover it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.reduced import midpoint_map
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.lowrank.shifts import frequency_estimate
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.operators import modes_couple
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, FEW, ModalLoop, SampledRadius
from softgrasp.lqr.spectrum.tail import TailBound, tail_modes

SAFE = 0.5  # small gain below which the modes left out are harmless; the rest covers what lies between grid points
GRID = 1000  # points on the upper half of the unit circle, and these around every eigenvalue, in its distances from it:
AROUND = np.array([0.0, 0.3, 0.7, 1.0, 1.5, 2.5, 5.0, 12.0, 40.0])
FREQUENCIES = 400  # of the modes left out, between the last one kept and the highest of the mesh
DOUBLINGS, BISECTIONS = 24, 6  # of the rate, when a stable one is sought: to 16 million times, then to a percent


@dataclass(frozen=True)
class Sampling:
    """The instants of a loop."""

    dt: float  # time step of the midpoint rule [s]
    every: int = 0  # steps of one tick, with a held input; 0: the law at the midpoint of every step
    delay: int = 0  # ticks from a sample to the load that it commands

    @classmethod
    def of(cls, actuation: Actuation, dt: float) -> Sampling:
        """The instants of an actuation. Raises ControlError: the tick is no multiple of dt."""
        return cls(dt, actuation.ticks(dt), actuation.delay)


@dataclass(frozen=True)
class StableRate:
    """A rate at which a loop is stable."""

    rate: float  # rate of the loop [Hz]
    steps: int  # number of time steps until the end of the scene at this rate
    radius: float  # spectral radius from tick to tick at this rate


@dataclass(frozen=True)
class _Parts:
    """x' = A x + B u, u = k x on the modes kept, and the modes left out."""

    A: Array  # state matrix, (N, N)
    B: Array  # input matrix, (N, n_s)
    k: Array  # gain, (n_s, N)
    exact: bool  # whether all modes are kept
    rest: _Rest | None = None  # modes left out; None where no bound on them is known
    reason: str = ""  # why the radius is not certified; empty when it is


@dataclass(frozen=True)
class _Rest:
    """Bound on the modes left out."""

    size: float  # product |gain| |force| over all modes left out
    omega: Array  # sampled frequencies of their range [1/s], (F,)
    twice: Array  # damping 2 delta = alpha + beta omega^2 at these frequencies [1/s], (F,)
    drag: float  # mass-proportional damping alpha where it acts in space, else 0 [1/s]


def midpoint_radius(poles: np.ndarray, dt: float) -> float:
    """Largest |(1 + s dt/2) / (1 - s dt/2)| over closed-loop poles s: the law inside the step.

    Below 1 exactly where every Re s < 0, for every dt.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.abs((1 + poles * dt / 2) / (1 - poles * dt / 2))
    return float(np.max(np.where(np.isnan(moved), np.inf, moved), initial=0.0))


def tick(A: Array, B: Array, law: Sampling) -> tuple[Array, Array]:
    """A_d = Phi^k, B_d = (I + Phi + ... + Phi^{k-1}) Gamma of k midpoint steps under one input.

    Phi = (I - dt/2 A)^{-1} (I + dt/2 A), Gamma = dt (I - dt/2 A)^{-1} B.
    """
    n, m = B.shape[-2:]
    step = np.zeros((*A.shape[:-2], n + m, n + m))
    step[..., :n, :] = midpoint_map(np.eye(n), A, B, law.dt)
    step[..., n:, n:] = np.eye(m)
    moved = np.linalg.matrix_power(step, law.every)
    return moved[..., :n, :n], moved[..., :n, n:]


class SampledLoop:
    """The plant from tick to tick: x+ = A_d x + B_d w_1, w_1+ = w_2, .., w_delay+ = K x, or x+ = (A_d + B_d K) x.

    Small plants keep all modes. A large one whose damping decouples its modes (one-way those of the clamped tissue,
    two-way those with the hand floating) keeps the lowest. With L the loop of the modes kept and D(z) that of the rest,
    the whole loop has as many eigenvalues outside the unit circle as the kept one, if

        max over |z| = 1 of  |(I - L(z))^{-1}| |D(z)| < 1   (Rouche; D is analytic outside, its modes are damped).

    |(I - L)^{-1}| is evaluated on a grid that resolves every eigenvalue by its distance from the circle; |D| is
    bounded mode by mode in the energy norm and summed by Cauchy-Schwarz as in
    :class:`softgrasp.lqr.spectrum.tail.TailBound`. Where this fails, all modes are used, up to
    :data:`softgrasp.lqr.spectrum.modal_loop.DENSE_LIMIT`. Rounding, the mesh of the grids and the residual of the modes
    are not bounded.

    Args:
        problem: a plant with a hand.
        loop: its modes, when they are there already.
        modes: how many a large plant keeps.
    """

    def __init__(self, problem: RiccatiProblem, loop: ModalLoop | None = None, modes: int = FEW) -> None:
        self.problem, self.comm = problem, problem.layout.comm
        self.n_e = problem.layout.n_e
        self.kept = min(modes, self.n_e)
        self.coupled = modes_couple(problem.system)
        self.loop = loop
        self.lowest: tuple[Array, Array] | None = None

    def radius_of(self, K: Block, law: Sampling) -> SampledRadius:
        """Radius of a held loop under a gain, transposed, hand-relative. Collective."""
        answer = self._radius(self._parts(K), law)
        if answer.certified or self.n_e > DENSE_LIMIT:
            return answer
        self.modes(whole=True)
        return self._radius(self._parts(K), law)

    def of_modes(self, K: Block, loop: ModalLoop, law: Sampling) -> SampledRadius:
        """Radius on the modes that a loop keeps; certified where they are all. Collective."""
        parts = _Parts(loop.A, loop.B, loop.gain(K), loop.complete, reason="" if loop.complete else "not examined")
        return self._radius(parts, law)

    def stable_rate(self, K: Block, law: Sampling, end: float, most: float = 1.0) -> StableRate | None:
        """About the lowest rate above the own one with a stable loop; None when there is none. Collective.

        Args:
            K: gain, transposed, hand-relative.
            law: with the rate that is too low; its time step is kept where it fits.
            end: of the scene [s], a whole number of ticks.
            most: bound on the radius; a little more than 1 where modes without damping may stay on the circle.
        """
        parts = self._parts(K)

        def at(rate: float) -> tuple[StableRate, bool]:
            ticks = max(1, int(np.ceil(rate * end * (1 - 1e-9))))
            every = max(1, int(np.ceil(end / ticks / law.dt * (1 - 1e-9))))
            answer = self._radius(parts, replace(law, dt=end / ticks / every, every=every))
            return StableRate(ticks / end, ticks * every, answer.value), answer.certified and answer.value < most

        low = 1 / (law.dt * law.every)
        for _ in range(DOUBLINGS):
            high, stable = at(2 * low)
            if stable:
                break
            low *= 2
        else:
            return None
        for _ in range(BISECTIONS):
            middle, stable = at(np.sqrt(low * high.rate))
            if middle.rate >= high.rate:
                break
            low, high = (low, middle) if stable else (middle.rate, high)
        return high

    def controller(self, K: Controller, law: Sampling) -> SampledRadius:
        """Radius of the plant under a controller that carries its own tissue, driven by the measured hand. Collective.

        y+ = step y + accelerated (v+ - v) + dragged (v+ + v) runs beside the plant. One-way the hand does not feel the
        plant's own tissue, so that hand and y decide alone and the small plant of the controller is exact.

        ``K``: as it would be saved; ``law``: instants of the plant; one tick is the controller's period.
        """
        loop = self.modes() if self.problem.system.two_way else None
        if loop is None:
            A, B = np.split(np.linalg.solve(K.plant.E, np.hstack([K.plant.A, K.plant.B])), [len(K.plant.A)], axis=1)
        else:
            A, B = loop.A, loop.B
        return replace(on_root(self.comm, lambda: _carried(A, B, K, law)), exact=loop is None or loop.complete)

    def modes(self, whole: bool = False) -> ModalLoop:
        """All modes where ``whole`` or where they have to be and fit, else the lowest; kept for later. Collective."""
        whole = whole or self.n_e <= self.kept or (self.coupled and self.n_e <= DENSE_LIMIT)
        if self.loop is None or (whole and not self.loop.complete):
            self.loop = ModalLoop(self.problem, DENSE_LIMIT if whole else self.kept)
        return self.loop

    def _parts(self, K: Block) -> _Parts:
        """Modes kept and gain on them. Collective."""
        whole = self.loop is not None and self.loop.complete
        if whole or self.coupled or self.n_e <= self.kept:
            loop, reason = self.modes(), ""
            if not loop.complete:
                reason = f"damping couples the modes, and {self.n_e} are too many to use all"
            return _Parts(loop.A, loop.B, loop.gain(K), loop.complete, reason=reason)
        if self.lowest is None:
            self.lowest = tail_modes(self.problem, self.kept)
        tail = TailBound(self.problem, K, self.lowest)
        n_s, M_s, omega = self.problem.layout.n_s, self.problem.M_s, tail.omega
        K_z, K_v, force = tail.parts
        ends = np.cumsum([0, n_s, n_s, len(omega), len(omega)]).tolist()
        s, v, z, w = (slice(a, b) for a, b in pairwise(ends))
        twice = tail.alpha + tail.beta * omega**2
        A = np.zeros((2 * (n_s + len(omega)),) * 2)
        B = np.zeros((len(A), n_s))
        A[s, v], A[z, w], A[w, z], A[w, w] = np.eye(n_s), np.diag(omega), -np.diag(omega), -np.diag(twice)
        A[w, v] = -tail.drag * force @ M_s
        B[v], B[w] = np.linalg.inv(M_s), -force
        k = np.hstack([K.hand.T, (K_z / omega[:, None]).T, K_v.T])
        fastest = 4 * frequency_estimate(self.problem.system)  # estimated within a factor of 4
        left_out = np.geomspace(omega[-1], max(fastest, 2 * omega[-1]), FREQUENCIES)
        size = float(np.hypot(tail.rest_z / omega[-1], tail.rest_v) * tail.rest_force)
        return _Parts(A, B, k, False, _Rest(size, left_out, tail.alpha + tail.beta * left_out**2, tail.drag))

    def _radius(self, parts: _Parts, law: Sampling) -> SampledRadius:
        return on_root(self.comm, lambda: _conclude(parts, law))


def _conclude(parts: _Parts, law: Sampling) -> SampledRadius:
    """Eigenvalues of the modes kept, and the bound on the rest."""
    A_d, B_d = tick(parts.A, parts.B, law)
    m = B_d.shape[1]
    T = _late(A_d, B_d, parts.k, law.delay)
    enter, leave = B_d, parts.k
    if law.delay:
        enter, leave = np.eye(len(T), m, m - len(T)), np.eye(m, len(T), len(A_d))
    if not np.isfinite(T).all():
        return SampledRadius(np.inf)
    if parts.rest is None:
        return SampledRadius(float(np.abs(np.linalg.eigvals(T)).max()), parts.exact, parts.exact, parts.reason)
    values, vectors = np.linalg.eig(T)
    size, reason = float(np.abs(values).max()), ""
    if not np.linalg.cond(vectors) < 1e10:  # rounding of the peak: six digits
        reason = "the eigenvectors of the sampled loop are too near to each other for a bound on the modes left out"
    else:
        gain = _small_gain(values, (leave @ vectors, np.linalg.solve(vectors, enter)), parts.rest, law)
        if not gain < SAFE:
            reason = f"the gain reaches modes that were left out: the small gain is {gain:.2g}, not below {SAFE:g}"
    return SampledRadius(size, not reason, False, reason)


def _late(A: Array, B: Array, k: Array, delay: int) -> Array:
    """[x, w_1, .., w_delay] from tick to tick, the commands under way behind the state."""
    n, m = B.shape
    if not delay:
        return np.asarray(A + B @ k)
    T = np.eye(n + delay * m, k=m)  # w_i+ = w_{i+1}
    T[:n], T[-m:] = 0.0, 0.0
    T[:n, :n], T[:n, n : n + m], T[-m:, :n] = A, B, k
    return T


def _small_gain(values: np.ndarray, ends: tuple[np.ndarray, np.ndarray], rest: _Rest, law: Sampling) -> float:
    """Max over |z| = 1 of |(I - L)^{-1}| |D|."""
    away = np.maximum(np.abs(1 - np.abs(values)), 1e-12)
    angles = np.angle(values)[:, None] + away[:, None] * np.concatenate([-AROUND, AROUND])
    grid = np.concatenate([np.linspace(0.5 / GRID, 1.0, GRID) * np.pi, np.abs(angles.ravel())])
    z = np.exp(1j * np.unique(grid[(grid > 1e-9) & (grid <= np.pi)]))
    products = ends[0].T[:, :, None] * ends[1][:, None, :]
    peak = np.tensordot(1 / (z[:, None] - values), products, axes=1)
    if not law.delay:
        peak = peak + np.eye(peak.shape[-1])
    constant, ramp = _responses(rest, law)
    length = law.dt * law.every
    drag = constant * (1 + rest.drag * length / np.abs(z - 1)) + ramp * rest.drag * length
    return float(np.max(np.linalg.norm(peak, 2, axis=(1, 2)) * rest.size * drag))


def _responses(rest: _Rest, law: Sampling) -> tuple[float, float]:
    """Max over the modes left out and |z| >= 1 of |(zI - M)^{-1} b|, M = Phi^k, b = sum Phi^j Gamma, energy norm.

    Both |b| (max |1/(1-rho)| + c / ((1-rho_1)(1-rho_2))), c the departure of M from normality, and the sum over its two
    eigenvectors bound it. The second number is the same for any input within a tick, |b| <= k |Gamma|.
    """
    omega, twice = rest.omega, rest.twice
    A = np.zeros((len(omega), 2, 2))
    A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = omega, -omega, -twice
    B = np.zeros((len(omega), 2, 1))
    B[:, 1] = 1.0
    inner, push = np.split(midpoint_map(np.eye(2), A, B, law.dt), [2], axis=-1)
    M, b = tick(A, B, law)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        values, vectors = np.linalg.eig(inner)
        rho = np.abs(values) ** law.every
        gap = 1 - rho
        departure = np.sqrt(np.maximum(np.sum(M**2, axis=(1, 2)) - np.sum(rho**2, axis=1), 0.0))
        resolvent = 1 / gap.min(axis=1) + departure / gap.prod(axis=1)
        size = np.linalg.norm(b[..., 0], axis=1)
        (p, q), (r, s) = vectors.transpose(1, 2, 0)
        b_1, b_2 = b[:, 0, 0], b[:, 1, 0]
        det = p * s - q * r
        split = np.abs((s * b_1 - q * b_2) / det) / gap[:, 0] + np.abs((p * b_2 - r * b_1) / det) / gap[:, 1]
        constant = np.fmin(size * resolvent, split)
        ramp = law.every * np.linalg.norm(push[..., 0], axis=1) * resolvent
    fine = (gap > 0).all(axis=1)
    return tuple(float(np.max(np.where(fine & np.isfinite(x), x, np.inf))) for x in (constant, ramp))  # type: ignore[return-value]


def _carried(A: Array, B: Array, K: Controller, law: Sampling) -> SampledRadius:
    """Plant x, tissue y of the controller, and the command under way."""
    n_s, n = K.n_s, len(A)
    A_d, B_d = tick(A, B, law)
    step, accelerated, dragged, _ = K.model
    drag = np.zeros_like(accelerated) if dragged is None else dragged
    hand = np.eye(2 * n_s, n)
    C_v = hand[n_s:]
    gain = np.hstack([K.K[:, : 2 * n_s] @ hand, K.K[:, 2 * n_s :]])
    moved = (accelerated + drag) @ C_v  # what an increment of x+ does to y+
    free = np.block([[A_d, np.zeros((n, len(step)))], [moved @ A_d - (accelerated - drag) @ C_v, step]])
    push = np.vstack([B_d, moved @ B_d])
    T = _late(free, push, gain, law.delay)
    return SampledRadius(float(np.abs(np.linalg.eigvals(T)).max()))
