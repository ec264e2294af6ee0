"""Hard cases of vibration and feedback: a hand that shakes at the tissue's own frequency, loops that hold and wait."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.lqr.dense.modal import DenseRiccati, relative_space
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.gap import Course, duality_gaps
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from tests.hardcases.cases import Family, HardCase, Outcome, here, make, textbook
from tests.hardcases.riccati import problem_of

PER_PERIOD = 500  # steps


@dataclass(frozen=True)
class Shaken:
    """An undamped body whose hand shakes with acceleration cos(omega t) along x, omega its first frequency."""

    omega: float  # [1/s]
    periods: int  # of the run

    @property
    def dt(self) -> float:
        """Step [s]."""
        return 2 * math.pi / self.omega / PER_PERIOD

    @property
    def steps(self) -> int:
        """Number."""
        return self.periods * PER_PERIOD

    def error(self, x: float, v: float, pull: float) -> float:
        """Error of the mode (omega xi, xi') over its exact amplitude |pull| t / 2, of xi'' + omega^2 xi = -pull cos."""
        t = self.steps * self.dt
        swing = math.sin(self.omega * t), math.cos(self.omega * t)
        exact = -pull * np.array([t * swing[0] / 2, (swing[0] / self.omega + t * swing[1]) / 2])
        return float(np.linalg.norm([self.omega * x, v] - exact) / (abs(pull) * t / 2))


def _shaken_here(shaken: Shaken) -> float:
    scene = ("tissue.cells=[3, 6]", "motion={profile='hold', drive='force'}", "control=false")
    model = make("paper_forward", *scene, f"time={{steps={shaken.steps}, end={shaken.steps * shaken.dt!r}}}")
    system = model.system
    Phi, unit = lowest_modes(system, 1)[1][:, 0], np.eye(system.layout.n_s)[0]
    last = simulate(model, force=lambda n, t, q, v: system.M_hand @ unit * math.cos(shaken.omega * t)).final
    z, v = np.split(last, 2)
    M = system.M_ee
    left, right = M.createVecs()
    left.array_w[:] = Phi
    M.mult(left, right)
    return shaken.error(float(right.array_r @ z), float(right.array_r @ v), float(Phi @ system.G @ unit))


def _newmark(shaken: Shaken) -> Outcome:
    """xi'' = -omega^2 xi - cos(omega t) of the mode alone by Newmark's rule; in words by the implicit Euler rule."""
    dt, square = shaken.dt, shaken.omega**2
    x, v, a, x_e, v_e = 0.0, 0.0, -1.0, 0.0, 0.0
    for n in range(1, shaken.steps + 1):
        push = math.cos(shaken.omega * n * dt)
        x, v = x + dt * v + dt * dt / 4 * a, v + dt / 2 * a
        a = -(push + square * x) / (1 + dt * dt / 4 * square)
        x, v = x + dt * dt / 4 * a, v + dt / 2 * a
        v_e = (v_e - dt * (square * x_e + push)) / (1 + dt * dt * square)
        x_e += dt * v_e
    return Outcome(shaken.error(x, v, 1.0), f"implicit Euler {shaken.error(x_e, v_e, 1.0):.0e}")


def resonance_rows(quick: bool) -> Iterator[HardCase]:
    """One to a hundred periods at resonance, where the amplitude grows with time and errors of the frequency add up."""
    system = make("paper_forward", "tissue.cells=[3, 6]", "control=false").system
    omega = float(lowest_modes(system, 1)[0][0])
    for periods in (1, 10) if quick else (1, 3, 10, 30, 100):
        shaken = Shaken(omega, periods)
        small = (omega * shaken.dt) ** 2
        bound = small / 12 * omega * shaken.steps * shaken.dt + small
        reason = "the midpoint rule lowers a frequency by the share (omega dt)^2 / 12 [HLW06], which adds up"
        ways = here(_shaken_here, shaken), textbook(_newmark, shaken)
        yield HardCase(f"{periods:g} periods", periods, *ways, bound, reason)


# --- held loops


@dataclass(frozen=True)
class Held:
    """A loop under the optimal gain that samples, holds and is late."""

    problem: RiccatiProblem  # plant and weights
    tick: float  # between two samples [s]
    delay: int  # ticks from a sample to its load
    per_tick: int = 4  # steps
    ticks: int = 200  # number of ticks of the run

    @property
    def dt(self) -> float:
        """Step [s]."""
        return self.tick / self.per_tick

    @property
    def start(self) -> Array:
        """The hand at rest, 5 and 3 m from its target, the tissue undeformed, in hand-relative coordinates."""
        layout = self.problem.layout
        return np.concatenate([[-5.0, -3.0], np.zeros(layout.n_s + 2 * layout.n_e)])


def true_excess(held: Held) -> float:
    """J(u) / min J - 1 with dense matrices: the plain loop, x'E'XEx for what is to come, and for the least cost."""
    space, (x, dt) = relative_space(held.problem), (held.start, held.dt)
    assert space is not None
    E, A, B, C = space.E, space.A, space.B, space.C
    Q, R = held.problem.Q, held.problem.R
    X = scipy.linalg.solve_continuous_are(A, B, C.T @ Q @ C, R, e=E)
    K, least = -np.linalg.solve(R, B.T @ X @ E), float(x @ E.T @ X @ E @ x)
    left = scipy.linalg.lu_factor(E - dt / 2 * A)
    waiting, cost = [np.zeros(len(K))] * held.delay, 0.0
    for n in range(held.ticks * held.per_tick):
        if n % held.per_tick == 0:
            waiting.append(K @ x)
            u = waiting.pop(0)
        new = scipy.linalg.lu_solve(left, (E + dt / 2 * A) @ x + dt * (B @ u))
        y = C @ (x + new) / 2
        cost, x = cost + dt * float(y @ Q @ y + u @ R @ u), new
    return (cost + float(x @ E.T @ X @ E @ x)) / least - 1


def proved_excess(held: Held) -> float:
    """What is proved of the loop as it runs, with the optimal feedback after it."""
    solution, x = DenseRiccati().solve(held.problem), held.start[:, None]
    h = 2 * held.problem.layout.n_s
    course = Course(Block(x[:h], x[h:]), held.dt, held.ticks * held.per_tick, Actuation(1 / held.tick, held.delay))
    (gap,) = duality_gaps(held.problem, [solution.gain], course, solution)
    return gap.cost_excess_proved


def resampled_excess(held: Held) -> Outcome:
    """J / min J - 1 of the loop sampled and held for ever, by matrix exponentials over a tick and a Lyapunov equation.

    The state of a tick is [x, loads on their way]; x^+ = e^(F tick) x + int e^(F s) ds B u, and the cost of a tick is
    the integral of its output's square, both from one exponential [VL78]. In words what it says without sampling.
    """
    space, x = relative_space(held.problem), held.start
    assert space is not None
    A, B = np.linalg.solve(space.E, space.A), np.linalg.solve(space.E, space.B)
    H, R = space.C.T @ held.problem.Q @ space.C, held.problem.R
    X = scipy.linalg.solve_continuous_are(A, B, H, R)
    K, (n, m) = -np.linalg.solve(R, B.T @ X), B.shape
    F, W = np.zeros((n + m, n + m)), scipy.linalg.block_diag(H, R)
    F[:n] = np.hstack([A, B])
    big = scipy.linalg.expm(held.tick * np.block([[-F.T, W], [np.zeros_like(F), F]]))
    step = big[n + m :, n + m :]
    cost = step.T @ big[: n + m, n + m :]
    size = n + m * held.delay
    now = np.vstack([np.eye(n, size), np.eye(m, size, n) if held.delay else K])  # [x, load of this tick]
    new = np.vstack([step[:n] @ now, np.eye(m * held.delay, size, n + m)])
    if held.delay:
        new[-m:] = np.eye(m, n) @ np.zeros((n, size)) + K @ np.eye(n, size)
    P = scipy.linalg.solve_discrete_lyapunov(new.T, now.T @ cost @ now)
    start = np.concatenate([x, np.zeros(m * held.delay)])
    closed = scipy.linalg.solve_continuous_lyapunov((A + B @ K).T, -(H + K.T @ R @ K))
    least = float(x @ X @ x)
    return Outcome(float(start @ P @ start) / least - 1, f"unsampled {float(x @ closed @ x) / least - 1:.0e}")


def held_rows(quick: bool) -> Iterator[HardCase]:
    """The optimal gain sampled from a hundred times a second to once a second, up to two ticks late."""
    problem = problem_of()
    cases = [(0.01, 0), (0.1, 0), (0.1, 2), (0.5, 1), (1.0, 0)]
    for i, (tick, delay) in enumerate(cases[1::2] if quick else cases):
        held = Held(problem, tick, delay)
        truth = true_excess(held)
        name = f"{1 / tick:g} Hz, {delay} tick{'' if delay == 1 else 's'} late, true excess {100 * truth:.2g} %"
        ours = here(lambda: truth / proved_excess(held))  # noqa: B023  (at once)
        other = textbook(resampled_excess, held)
        theirs = other if other.value is None else Outcome(truth / other.value, other.text)
        reason = "the bound of weak duality must not lie below the excess of a plain dense loop"
        yield HardCase(name, i + 1, ours, theirs, 1.0 + 1e-6, reason + "; 1e-6 for two Riccati solutions")


FAMILIES = (
    Family("resonance", "A hand that shakes at the frequency of its tissue", "periods",
           "error of the mode / its amplitude", "Newmark's rule",
           "At resonance every period adds to the amplitude. Newmark's rule lowers the frequency as the midpoint rule "
           "does and is as good; a rule that damps by itself, as implicit Euler, never shows it.",
           resonance_rows),
    Family("held", "Cost of loops that hold and wait", "loop", "true excess cost / proved bound",
           "exponential of a tick and a discrete Lyapunov equation",
           "The optimal gain costs nothing more in continuous time; sampled and late it does. Dense matrices give it "
           "for a small loop without limits; the bound needs a run and its adjoint, of any size, with limits.",
           held_rows, axis="listed"),
)  # fmt: skip
