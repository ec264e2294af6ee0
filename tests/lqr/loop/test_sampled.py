"""Sampled loops: the radius from tick to tick against dense propagators, matrix exponentials and plain simulation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions
from softgrasp.lqr.loop.small import galerkin, m_orthonormal
from softgrasp.lqr.lowrank.plant import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.target import hand_target
from softgrasp.lqr.spectrum.sampled import SampledLoop, Sampling, _responses, _Rest, midpoint_radius
from tests.helpers.loop import CASES, Setup, aim, setup
from tests.helpers.models import local_rows

Array = np.ndarray
MODES = 12  # of about 30
LAWS = [Sampling(0.1, 1, False), Sampling(0.1, 1, True), Sampling(0.05, 8, True), Sampling(0.02, 20, False)]


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> Setup:
    return setup(request.param)


def block(case: Setup, K: Array) -> Block:
    """A dense gain, hand-relative, as the library holds it."""
    n_s, n, layout = case.problem.layout.n_s, case.problem.layout.n_e, case.problem.layout
    parts = (K[:, 2 * n_s : 2 * n_s + n], K[:, 2 * n_s + n :])
    return Block(K[:, : 2 * n_s].T.copy(), np.vstack([local_rows(layout, part.T.copy()) for part in parts]))


def ticked(case: Setup, law: Sampling) -> tuple[Array, Array]:
    """State and input matrix of one tick, step by step, from the matrices written in the helpers."""
    lu = scipy.linalg.lu_factor(case.E - law.dt / 2 * case.A)
    X, Y = np.eye(len(case.E)), np.zeros_like(case.B)
    for _ in range(law.every):
        X = scipy.linalg.lu_solve(lu, (case.E + law.dt / 2 * case.A) @ X)
        Y = scipy.linalg.lu_solve(lu, (case.E + law.dt / 2 * case.A) @ Y + law.dt * case.B)
    return X, Y


def radius(A_d: Array, B_d: Array, K: Array, delay: bool) -> float:
    T = np.block([[A_d, B_d], [K, np.zeros((len(K), len(K)))]]) if delay else A_d + B_d @ K
    return float(np.abs(np.linalg.eigvals(T)).max())


@pytest.mark.parametrize("law", LAWS, ids=str)
def test_radius_is_that_of_the_dense_propagator(case: Setup, law: Sampling) -> None:
    """All modes, and a few with a bound on the rest; gains that are stable and that are not."""
    A_d, B_d = ticked(case, law)
    whole, few = SampledLoop(case.problem), SampledLoop(case.problem, modes=MODES)
    sides = set()
    for factor in (0.1, 1.0, 12.0):
        K = block(case, factor * case.K)
        exact = radius(A_d, B_d, factor * case.K, law.delay)
        found = whole.radius_of(K, law)
        assert found.exact
        assert found.certified
        assert abs(found.value - exact) < 1e-9  # rounding of the eigenvalues of matrices with norms up to 1e3
        kept = few.radius_of(K, law)
        assert kept.certified, kept.reason
        assert (kept.value < 1) == (exact < 1)
        # the modes left out have a part of the gain, and where they decay slowest they are not in the value
        assert abs(kept.value - exact) < 1e-3 or kept.value < exact < 1
        sides.add(found.stable)
    assert sides == {True, False} or law.every == 1


def test_a_certificate_is_never_on_the_wrong_side() -> None:
    """Gains on modes that are left out, of all sizes: certified, refused, and judged by all modes where that fits."""
    case, law = setup("one_way"), Sampling(0.1, 2, True)
    A_d, B_d = ticked(case, law)
    n_s, n = case.problem.layout.n_s, case.problem.layout.n_e
    M, K_ee = case.E[2 * n_s + n :, 2 * n_s + n :], -case.A[2 * n_s + n :, 2 * n_s : 2 * n_s + n]
    Phi = scipy.linalg.eigh(K_ee, M)[1]
    seen = set()
    for mode in (MODES + 1, MODES + 6, n - 1):
        for size in (0.1, 10.0, 1e3, 1e5, 1e7):
            K = case.K.copy()
            K[:, 2 * n_s + n :] += size * np.outer(np.ones(n_s), M @ Phi[:, mode])
            exact = radius(A_d, B_d, K, True)
            few = SampledLoop(case.problem, modes=MODES)
            found = few._radius(few._parts(block(case, K)), law)
            if found.certified:
                assert (found.value < 1) == (exact < 1), (mode, size)
            seen.add((found.certified, exact < 1))
            again = few.radius_of(block(case, K), law)
            assert again.certified
            assert again.stable == (exact < 1), (mode, size)
    assert {(True, True), (False, True), (False, False)} <= seen


def test_the_bound_on_left_out_modes_holds() -> None:
    """|(zI - M)^{-1} b| on the circle by brute force: light, critical and overdamped modes, short and long ticks."""
    z = np.exp(1j * np.linspace(1e-4, np.pi, 4001))
    for omega in (0.5, 5.0, 60.0, 3000.0):
        for zeta in (1e-3, 0.3, 1.0, 4.0):
            for law in (Sampling(0.1, 1), Sampling(0.01, 7), Sampling(0.5, 2)):
                A = np.array([[0.0, omega], [-omega, -2 * zeta * omega]])
                one, load = np.eye(2), np.array([0.0, 1.0])
                step = np.linalg.solve(one - law.dt / 2 * A, one + law.dt / 2 * A)
                x, M = np.zeros(2), np.linalg.matrix_power(step, law.every)
                for _ in range(law.every):
                    x = step @ x + law.dt * np.linalg.solve(one - law.dt / 2 * A, load)
                answer = np.linalg.solve(z[:, None, None] * one - M, np.broadcast_to(x[:, None], (len(z), 2, 1)))
                peak = float(np.linalg.norm(answer, axis=1).max())
                rest = _Rest(1.0, np.array([omega]), np.array([2 * zeta * omega]), 0.0)
                assert peak <= _responses(rest, law)[0] * (1 + 1e-9), (omega, zeta, law)  # rounding


def test_radius_tends_to_that_of_the_exponential() -> None:
    """Many steps in a tick: the exact sampled plant, with order two."""
    case = setup("two_way")
    rate, push = np.linalg.solve(case.E, case.A), np.linalg.solve(case.E, case.B)
    n, m, tick = len(rate), push.shape[1], 0.4
    both = scipy.linalg.expm(tick * np.block([[rate, push], [np.zeros((m, n + m))]]))
    K = 12 * case.K
    exact = radius(both[:n, :n], both[:n, n:], K, True)
    assert exact > 1.05
    loop, steps = SampledLoop(case.problem), np.array([8, 16, 32])
    errors = [abs(loop.radius_of(block(case, K), Sampling(tick / k, int(k), True)).value - exact) for k in steps]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(order - 2) < 0.1, f"order {order:.3f} of {errors}, 2 expected"  # next term at 8 steps


def growth(samples: Array) -> float:
    """Largest root of the recursion of order four, two pairs, that the rows of samples (ticks, k) satisfy."""
    size = np.abs(samples).max(axis=1)[:, None]
    rows = [samples[j : len(samples) - 4 + j] / size[4:] for j in range(5)]
    a = np.linalg.lstsq(np.stack([r.ravel() for r in rows[:4]], axis=1), rows[4].ravel())[0]
    return float(np.abs(np.roots([1.0, *-a[::-1]])).max())


def scaled(gain: Gain, factor: float) -> Gain:
    return Gain(factor * gain.K_s, factor * gain.K_z, factor * gain.K_v)


def test_the_simulation_grows_by_the_radius() -> None:
    """What the closed loop of the library really does, and the cost at which it stops."""
    case = setup("two_way")
    law, gain = Actuation(rate=2.5, delay=True), scaled(case.gain, 12.0)
    found = SampledLoop(case.problem).radius_of(block(case, 12 * case.K), Sampling.of(law, 0.1))
    target, loop = hand_target(case.problem, aim(case)), ClosedLoop(case.problem, 0.1)
    run = loop.run(gain, target, 960, law)
    # after 100 ticks all but the two pairs of the hand are gone
    assert growth(run.inputs[400::4] - target.u) == pytest.approx(found.value, rel=1e-6)
    assert found.value > 1.05
    with pytest.raises(SolverError, match="no loop that works has more than 1e"):
        loop.run(gain, target, 960, law, options=LoopOptions(most=1e6))
    fine = loop.run(gain, target, 960, law, options=LoopOptions(most=2 * run.cost[-1]))
    assert (fine.cost == run.cost).all()
    loop.destroy()


@pytest.mark.parametrize("name", ["one_way", "two_way"])
@pytest.mark.parametrize("factor", [1.0, 12.0])
def test_a_controller_that_carries_its_tissue_is_judged_as_it_runs(name: str, factor: float) -> None:
    """Controller.step in a plain loop of the full plant: growth from tick to tick."""
    case, law = setup(name), Sampling(0.1, 4, True)
    problem, n_s = case.problem, case.problem.layout.n_s
    V = m_orthonormal(problem.system.M_ee, lowest_modes(problem.system, 3)[1])
    plant, shapes = galerkin(problem, V)
    K = shapes.reduce_gain(problem, scaled(case.gain, factor))
    controller = Controller(K, np.zeros(plant.N), np.zeros(n_s), plant, period=0.4)
    found = SampledLoop(problem).controller(controller, law)
    A_d, B_d = ticked(case, law)
    rng = np.random.default_rng(5)
    x, waiting, hand = rng.standard_normal(len(A_d)), np.zeros(n_s), []
    controller.reset(plant.rest_at(np.zeros(n_s))[0][2 * n_s :])
    for _ in range(300):
        u = controller.step(x[:n_s], x[n_s : 2 * n_s])
        x = A_d @ x + B_d @ waiting
        waiting = u
        hand.append(x[:n_s])
    assert found.stable == (factor == 1.0)
    if not found.stable:
        assert growth(np.array(hand)[200:]) == pytest.approx(found.value, rel=1e-6)  # two pairs are left
    else:
        steady = np.mean(hand[200:], axis=0)  # where gravity and the target hold it
        late = [np.abs(np.array(hand[a : a + 50]) - steady).max() for a in (100, 200)]
        assert late[1] < late[0] < np.abs(hand[0] - steady).max()


def test_a_stable_rate_is_stable_and_not_much_too_high() -> None:
    case, law = setup("one_way"), Sampling(0.1, 4, True)
    K = block(case, 12 * case.K)
    found = SampledLoop(case.problem, modes=MODES).stable_rate(K, law, 40.0)
    assert found is not None

    def dense(rate: float, steps: int) -> float:
        every = round(steps / (rate * 40.0))
        here = Sampling(40.0 / steps, every, True)
        return radius(*ticked(case, here), 12 * case.K, True)

    assert dense(found.rate, found.steps) == pytest.approx(found.radius, abs=1e-3)  # the modes left out
    assert dense(found.rate, found.steps) < 1
    assert found.rate > 2.5
    ticks = round(0.9 * found.rate * 40.0)
    assert dense(ticks / 40.0, 4 * ticks) > 1
    nothing = Block(-K.hand, -K.tall)  # pushes away from the target at every rate
    assert SampledLoop(case.problem, modes=MODES).stable_rate(nothing, law, 40.0) is None


def test_the_law_inside_the_step() -> None:
    """Moebius image of the poles: the dense recursion of the closed loop, stable or not."""
    case = setup("two_way")
    for factor in (1.0, -1.0):
        F = case.A + factor * case.B @ case.K
        step = np.linalg.solve(case.E - 0.05 * F, case.E + 0.05 * F)
        exact = float(np.abs(np.linalg.eigvals(step)).max())
        poles: Any = scipy.linalg.eigvals(F, case.E)
        assert midpoint_radius(poles, 0.1) == pytest.approx(exact, abs=1e-9)  # rounding of two eigenvalue problems
        assert (exact < 1) == (factor > 0)
