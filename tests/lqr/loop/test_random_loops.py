"""Bounds of the excess cost of loops as they run, against plain simulations to rest: random gains, rates and limits.

The simulation shares nothing with the bound: dense matrices written in the helpers, one product a step, in absolute
coordinates under gravity, until what is to come no longer counts; what is left is from a dense Riccati solution.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.linalg

from softgrasp.lqr.design.orders import with_bounds
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.gap import Course
from softgrasp.lqr.plant.target import Target, hand_target, rest
from softgrasp.lqr.reduced.riccati import GainReport
from tests.helpers.loop import CASES, Setup, setup

Array = np.ndarray
LOG = logging.getLogger(__name__)
FASTEST = 1000.0  # Hz
LONGEST = 1 << 21  # steps of a simulation


@dataclass
class RandomLoop:
    """A loop with its bound and its cost."""

    text: str
    proved: float
    at_most: float
    true: float


def step_matrices(case: Setup, dt: float) -> tuple[Array, Array, Array]:
    """x+ = F x + G u + h of the midpoint rule."""
    left = case.E - dt / 2 * case.A
    n, m = case.B.shape
    both = np.linalg.solve(left, np.column_stack([case.E + dt / 2 * case.A, dt * case.B, dt * case.f]))
    return both[:, :n], both[:, n : n + m], both[:, -1]


def radius(case: Setup, rate: float, delay: int) -> float:
    """Of the held loop from tick to tick, by the matrix exponential."""
    n, m = case.B.shape
    A, B = np.split(np.linalg.solve(case.E, np.hstack([case.A, case.B])), [n], axis=1)
    moved = scipy.linalg.expm(np.block([[A, B], [np.zeros((m, n + m))]]) / rate)
    T = np.zeros((n + delay * m,) * 2)
    if delay == 0:
        T = moved[:n, :n] + moved[:n, n:] @ case.K
    else:
        T[:n, : n + m] = moved[:n]
        T[n : n + (delay - 1) * m, n + m :] = np.eye((delay - 1) * m)
        T[n + (delay - 1) * m :, :n] = case.K
    return float(np.abs(np.linalg.eigvals(T)).max())


def stable_limit(case: Setup, delay: int) -> float:
    """A rate from where the loop is stable [Hz], by a scan from above and a bisection."""
    high = FASTEST
    while radius(case, high / 2, delay) < 1 and high > 1e-3:
        high /= 2
    low = high / 2
    for _ in range(12):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if radius(case, middle, delay) < 1 else (middle, high)
    return float(high)


def simulate(case: Setup, target: Target, law: Actuation, dt: float) -> tuple[float, float]:
    """Cost of the loop without end, and its largest input; the same for a law at the midpoint, without limits."""
    F, G, h = step_matrices(case, dt)
    x_bar, K = case.full(target.state), case.K
    y_bar, m = case.C @ x_bar, len(K)
    bound = np.full(m, np.inf) if law.limits is None else np.broadcast_to(np.asarray(law.limits, float), (m,))
    every, x = law.ticks(dt), case.full(rest(case.problem.system))
    V = case.E.T @ case.X @ case.E
    first, cost, largest = float((x - x_bar) @ V @ (x - x_bar)), 0.0, 0.0
    waiting = [np.clip(target.u, -bound, bound)] * law.delay
    for n in range(LONGEST):
        if n % every == 0:
            waiting.append(np.clip(target.u + K @ (x - x_bar), -bound, bound))
            u = waiting.pop(0)
            left = float((x - x_bar) @ V @ (x - x_bar))
            if left < 1e-11 * first:  # far below the excess of every loop that is drawn
                return cost + left, largest
        new = F @ x + G @ u + h
        y, d = case.C @ (x + new) / 2 - y_bar, u - target.u
        cost += dt * float(y @ case.problem.Q @ y + d @ case.problem.R @ d)
        largest, x = max(largest, float(np.abs(d).max())), new
    raise AssertionError(f"{law} does not come to rest in {LONGEST} steps of {dt} s")


def draw(rng: np.random.Generator) -> RandomLoop:
    """One loop: plant, gain, rate between twice the stable limit and 1 kHz, delay, limit met, not met or none."""
    name = str(rng.choice(list(CASES)))
    case, n_s = setup(name), setup(name).problem.layout.n_s
    case = replace(case, K=case.K * (1 + rng.choice([0.0, 0.05, 0.2]) * rng.standard_normal(case.K.shape)))
    delay = int(rng.integers(3))
    if not radius(case, FASTEST, delay) < 1:  # the gain itself does not stabilise
        return draw(rng)
    slowest = min(2 * stable_limit(case, delay), FASTEST)
    rate = float(np.exp(rng.uniform(np.log(slowest), np.log(FASTEST))))
    every = int(rng.choice([1, 2, 4])) if rate < 100 else 1
    dt = 1 / rate / every
    target = hand_target(case.problem, rng.uniform(-1, 1, n_s))
    law = Actuation(rate, delay)
    if not radius(case, rate, delay) < 1:  # stable limits need not be intervals
        return draw(rng)
    kind = str(rng.choice(["no limit", "met", "not met"]))
    true, largest = simulate(case, target, law, dt)
    if kind != "no limit":
        share = rng.uniform(0.3, 0.9) if kind == "met" else rng.uniform(1.1, 3.0)
        law = replace(law, limits=float(np.abs(target.u).max() + share * largest))
        true, _ = simulate(case, target, law, dt)
    start = (rest(case.problem.system) - target.state).block
    x = case.full(rest(case.problem.system)) - case.full(target.state)
    optimal = float(x @ case.E.T @ case.X @ case.E @ x)
    hand = np.vstack([np.eye(n_s, 2 * n_s, n_s), np.linalg.solve(case.problem.M_s, case.K[:, : 2 * n_s])])
    steps = int(np.ceil(6 / -np.linalg.eigvals(hand).real.max() / dt))  # as softgrasp.lqr.design.duration plans
    report = GainReport("drawn", 4, abscissa_full=-1.0, gain=case.gain)
    course = Course(start, dt, steps, law, target.u)
    (found,) = with_bounds(case.problem, setup(name).solution, [report], course)
    text = f"{name}, {rate:.4g} Hz ({rate / slowest * 2:.3g} stable limits), {every} steps, {delay} ticks, {kind}"
    return RandomLoop(text, found.cost_excess_proved, found.cost_excess_at_most, true / optimal - 1)


SLOW = [pytest.param(seed, 10, marks=pytest.mark.slow) for seed in range(100, 120)]


@pytest.mark.serial
@pytest.mark.parametrize(("seed", "count"), [(7, 3), *SLOW])
def test_no_random_loop_costs_more_than_its_bound(seed: int, count: int) -> None:
    """``-m slow --log-cli-level=info`` runs 200 of them and shows each."""
    rng, ratios = np.random.default_rng(seed), []
    for _ in range(count):
        loop = draw(rng)
        ratios.append(loop.at_most / loop.true)
        LOG.info("bound / true %.6f: true %.3e, proved %.3e; %s", ratios[-1], loop.true, loop.proved, loop.text)
        # the dense X behind ``true`` has eight digits, its simulation stops at 1e-11
        assert loop.at_most >= loop.true * (1 - 1e-6) - 1e-9, loop
        assert loop.proved <= loop.true * (1 + 1e-6) + 1e-9, loop  # what is proved to the end is no more than it costs
    assert np.median(ratios) <= 3
