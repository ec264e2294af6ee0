"""Full plant, observer and gain from tick to tick: is the loop stable, and what is its cost?

The reduced filter is stable on its own plant by design, which proves nothing for the modes that it leaves out. Here
all modes are kept, so that the spectrum is that of the whole loop, or of a large plant the lowest, with a bound on the
rest, see :mod:`softgrasp.lqr.observer.tail`. With the exact step of a tick, x+ = A x + B u + w,
s = C x + v,

    F = the map of [x; m; inputs and samples on their way] over a tick,   S = (F - I)(F + I)^{-1},

eigenvalues lambda = (1 + mu) / (1 - mu) of F from those of S, and the covariance X from

    S X + X S' = -(I - S) W (I - S)' / 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.lqr.dense.care import block_eigenvalues
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.loop.filter import Filter
from softgrasp.lqr.lowrank.compress import gram
from softgrasp.lqr.observer.sensors import Disturbance, Sensors
from softgrasp.lqr.observer.tail import Rest
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from softgrasp.lqr.spectrum.sampled import SAFE

FAST = 0.98  # of the pace with the state known
TURN = 1.0  # of the fastest mode in a step of Simpson's rule at most [rad]; its error there is a few 1e-4


@dataclass(frozen=True)
class Ticks:
    """The full plant in energy-scaled modes from tick to tick, with what is measured and what disturbs."""

    A: Array  # state a tick later, (n, n)
    B: Array  # state a tick later by a unit load held over the tick, (n, n_s)
    C: Array  # samples of the state, (p, n)
    W: Array  # factor of the covariance that a tick adds, (n, r)
    sd: Array  # standard deviation of the samples, (p,)
    y: Array  # outputs of the state, (o, n)
    period: float  # tick [s]


def make_ticks(
    problem: RiccatiProblem, loop: ModalLoop, sensors: Sensors, disturbance: Disturbance, period: float
) -> Ticks:
    """Exact step of all modes over a tick of ``period`` seconds. Collective."""
    comm, modes, factor = problem.layout.comm, loop.plant, disturbance.factor
    seen, moved = (total(comm, part) for part in sensors.of(modes.Phi))
    C = np.hstack([sensors.C.hand.T, seen / modes.omega, moved])
    loads = total(comm, modes.Phi.T @ factor.parts[3])
    force = np.vstack([factor.hand, np.zeros_like(loads), loads])

    def make() -> Ticks:
        n, m = loop.B.shape
        G = np.linalg.solve(modes.space.E, force)
        fastest = max(float(modes.omega.max()), float(np.abs(np.diag(modes.D)).max()))
        halvings = max(0, int(np.ceil(np.log2(fastest * period / TURN))))
        short = period / 2**halvings
        half = scipy.linalg.expm(short / 2 * np.vstack([np.hstack([loop.A, loop.B]), np.zeros((m, n + m))]))
        A, B = half[:n, :n], half[:n, n:]
        middle = A @ G
        W = np.sqrt(short / 6) * np.hstack([G, 2 * middle, A @ middle])  # Simpson's rule of the covariance
        A, B = A @ A, A @ B + B
        for _ in range(halvings):
            W = np.hstack([W, A @ W])
            if W.shape[1] > n:
                W = np.linalg.qr(W.T, mode="r").T
            A, B = A @ A, A @ B + B
        return Ticks(A, B, C, W, sensors.sd, modes.space.C, period)

    return on_root(comm, make)


@dataclass(frozen=True)
class Judged:
    """The full plant under an observer and a gain."""

    abscissa: float  # largest log |lambda| / period of the loop [1/s]
    abscissa_known: float  # largest log |lambda| / period under the optimal gain on the known state [1/s]
    cost: float  # J a second that the disturbances cause; infinite where the loop is not stable [1/s]
    cost_known: float  # least J a second, where the whole state is known [1/s]
    sd_outputs: Array  # standard deviation of the outputs from their target [m, rad], (o,)
    sd_inputs: Array  # standard deviation of the inputs from those that were planned [N, N m], (n_s,)
    sd_error: Array  # standard deviation of the estimate of the outputs [m, rad], (o,)
    covariance: Array  # of the full state in modes, (n, n); empty where the loop is not stable
    small_gain: float = 0.0  # of modes left out, below 1 where they leave the loop stable; 0 where all are kept

    @property
    def stable(self) -> bool:
        """Whether every eigenvalue of the whole loop is known to lie inside the unit circle."""
        return self.abscissa < 0 and self.small_gain < SAFE

    @property
    def fast(self) -> bool:
        """Whether the loop is stable and as fast as with the state known, within 2 %."""
        return self.stable and self.abscissa <= FAST * self.abscissa_known

    @property
    def excess(self) -> float:
        """Cost over the least one, less one [1]."""
        return self.cost / self.cost_known - 1


@dataclass(frozen=True)
class LoopMap:
    """The loop over a tick, states [x; m; inputs and samples on their way, newest first]."""

    F: Array  # states a tick later, (k, k)
    noise: Array  # factor of the covariance that a tick adds, of disturbance and samples, (k, r + p)
    estimate: Array  # estimated state of the controller as a function of these states, (N, k)
    direct: Array  # factor of what the samples of this tick add to x^, (N, p)


def loop_map(plant: Ticks, K: Array, own: Filter, lost: Array | None = None) -> LoopMap:
    """The loop of a plant under the gain K (n_s, N) on an estimate.

    ``lost``: flags of samples that never come, (p,).
    """
    (n, n_s), N, p, d = plant.B.shape, len(own.A), len(own.C), own.delay
    sizes = [n, N, *[n_s] * d, *[p] * d]
    one, ends = np.eye(sum(sizes)), np.cumsum(sizes)
    x, m, *held = (one[end - size : end] for end, size in zip(ends, sizes, strict=True))
    inputs, samples, now = held[:d], held[d:], plant.C @ x
    M = own.M if lost is None else np.where(lost, 0.0, own.M)
    corrected = m + M @ ((samples[-1] if d else now) - own.C @ m)
    estimate = corrected
    for u in reversed(inputs):  # oldest first
        estimate = own.A @ estimate + own.B @ u
    u = K @ estimate
    following = own.A @ corrected + own.B @ (inputs[-1] if d else u)
    rows = [plant.A @ x + plant.B @ u, following]
    if d:
        rows += [u, *inputs[:-1], now, *samples[:-1]]
    direct = np.zeros((N, p)) if d else M * plant.sd
    v = np.zeros((len(one), p))
    if d:
        v[ends[-1] - d * p : ends[-1] - (d - 1) * p] = np.diag(plant.sd)
    else:
        v[:n], v[n:] = plant.B @ K @ direct, (own.A + own.B @ K) @ direct
    w = np.vstack([plant.W, np.zeros((len(one) - n, plant.W.shape[1]))])
    return LoopMap(np.vstack(rows), np.hstack([w, v]), estimate, direct)


def judge(
    problem: RiccatiProblem,
    solution: RiccatiSolution,
    loop: ModalLoop,
    plant: Ticks,
    disturbance: Disturbance,
    controller: Controller,
    rest: Rest | None = None,
) -> Judged:
    """A controller with observer on the full plant. Collective.

    Args:
        solution: optimal gain, and its X for the least cost.
        loop: all modes, or the lowest, of which ``plant`` is the step.
        rest: bound of the modes that are not among them.
    """
    known = loop.gain(solution.gain.block)
    least = float(np.sum(gram(problem.layout.comm, solution.factor, disturbance.factor) ** 2))

    def evaluate() -> Judged:
        best = float(np.log(np.abs(np.linalg.eigvals(plant.A + plant.B @ known)).max())) / plant.period
        K, own = controller.K, controller.observer
        assert own is not None
        map_ = loop_map(plant, K, own)
        n, inverse = len(plant.A), np.linalg.inv(map_.F + np.eye(len(map_.F)))
        T, U = scipy.linalg.schur(inverse @ (map_.F - np.eye(len(map_.F))), output="real")
        abscissa = _abscissa(block_eigenvalues(T), plant.period)
        if not abscissa < 0:
            none, load = np.full(len(plant.y), np.inf), np.full(len(K), np.inf)
            return Judged(abscissa, best, np.inf, least, none, load, none, np.zeros((0, 0)))
        small_gain = 0.0
        if rest is not None:
            enter, direct = map_.noise[:, -len(plant.sd) :] / plant.sd, K @ map_.direct / plant.sd
            small_gain = rest.gain(map_.F, enter, K @ map_.estimate, direct)
        X = _covariance(T, U, np.sqrt(2.0) * inverse @ map_.noise)
        seen = np.hstack([plant.y, np.zeros((len(plant.y), len(X) - n))])
        error, at_once = seen - controller.plant.C @ map_.estimate, controller.plant.C @ map_.direct
        y, e, u = seen @ X @ seen.T, error @ X @ error.T + at_once @ at_once.T, K @ map_.estimate
        inputs = u @ X @ u.T + (K @ map_.direct) @ (K @ map_.direct).T
        cost = float(np.sum(problem.Q * y) + np.sum(problem.R * inputs))
        sd_y, sd_u, sd_e = (np.sqrt(np.maximum(np.diag(part), 0.0)) for part in (y, inputs, e))
        return Judged(abscissa, best, cost, least, sd_y, sd_u, sd_e, X[:n, :n], small_gain)

    return on_root(problem.layout.comm, evaluate)


def abscissa_without(plant: Ticks, controller: Controller, lost: Array) -> float:
    """Largest log |lambda| / period of the loop where samples (flags, (p,)) never come [1/s]. Not collective."""
    assert controller.observer is not None
    values = np.linalg.eigvals(loop_map(plant, controller.K, controller.observer, lost).F)
    return float(np.log(np.abs(values).max())) / plant.period


def slowest_mode(plant: Ticks, controller: Controller) -> int:
    """Number of the mode of the tissue with most energy in the slowest motion of the loop. Not collective."""
    assert controller.observer is not None
    values, vectors = np.linalg.eig(loop_map(plant, controller.K, controller.observer).F)
    n_s = plant.B.shape[1]
    slow = np.abs(vectors[2 * n_s : len(plant.A), int(np.abs(values).argmax())]) ** 2
    return int(slow.reshape(2, -1).sum(axis=0).argmax())


def _abscissa(mu: np.ndarray, period: float) -> float:
    """Log |(1 + mu) / (1 - mu)| / period of the largest, without cancellation near 1."""
    least = 4 * np.finfo(float).eps - 1  # of samples on their way, whose lambda is 0
    return float(np.log1p(np.maximum(4 * mu.real / np.abs(1 - mu) ** 2, least)).max()) / (2 * period)


def _covariance(T: Array, U: Array, factor: Array) -> Array:
    """X of S X + X S' = -factor factor' for S = U T U'."""
    (trsyl,) = scipy.linalg.get_lapack_funcs(("trsyl",), (T,))
    G = U.T @ factor
    X, scale, info = trsyl(T, T, -(G @ G.T), trana="N", tranb="T")
    if info < 0:
        raise ControlError(f"the Lyapunov equation of order {len(T)} was refused by LAPACK (info {info})")
    return np.asarray(U @ (X / scale) @ U.T)
