"""Closed loops: full order against a dense recursion, reduced against full, cost against its Riccati prediction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from softgrasp.fem.errors import SolverError
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.lqr.loop.actuation import Actuation, ImplicitInput
from softgrasp.lqr.loop.cost import predicted_cost
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions
from softgrasp.lqr.loop.small import galerkin, m_orthonormal
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain, PlantState
from softgrasp.lqr.plant.target import hand_target, rest
from softgrasp.reduction.errors import full_energy
from tests.helpers.loop import CASES, Setup, aim, enumerate_input, plain_loop, setup
from tests.helpers.models import close, gather_rows, gather_states, local_rows, same_everywhere
from tests.helpers.small_loop import expand, expand_gain, run_small

Array = np.ndarray
STEPS, END = 40, 4.0


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> Setup:
    return setup(request.param)


def test_rest_is_rest(case: Setup) -> None:
    """A x_bar + B u_bar + f = 0, and the outputs of the target are C x_bar."""
    target = hand_target(case.problem, aim(case))
    x = case.full(target.state)
    load = case.A @ x + case.B @ target.u + case.f
    assert np.abs(load).max() < 1e-10 * np.abs(case.A).max()  # rounding of K z, K of size |A|
    assert close(case.C @ x, target.y) < 1e-12  # rounding of one sum


@pytest.mark.ranks
def test_full_order_loop_is_the_dense_recursion(case: Setup) -> None:
    """SMW with columns made once equals the factored closed loop, also far from its optimum and with a coarse step."""
    target = hand_target(case.problem, aim(case))
    loop = ClosedLoop(case.problem, END / STEPS)
    run = loop.run(case.gain, target, STEPS, options=LoopOptions(snapshots="memory"))
    start = rest(case.problem.system)
    X, U = case.recursion(case.full(start), case.full(target.state), target.u, END / STEPS, STEPS)
    n_s = case.problem.layout.n_s
    assert run.snapshots is not None
    ours = np.hstack([run.q_s, run.v_s, gather_states(case.problem.layout, run.snapshots.Z).T])
    assert close(ours, X) < 1e-9  # two factorisations with condition about 1e5, 40 steps
    assert close(run.inputs, U) < 1e-9  # as above
    assert close(run.outputs, X @ case.C.T) < 1e-9  # as above
    assert close(run.outputs_rigid, run.q_s @ case.problem.C_s.T) < 1e-14  # the same product
    assert close(case.full(run.final), X[-1]) < 1e-8  # the last state is smaller than the largest
    assert same_everywhere(case.problem.layout.comm, run.inputs)
    exact = full_energy(case.problem.system, run.snapshots.Z)
    # the balance of 40 steps, each of sums larger than the energy where gravity does work
    assert np.abs(run.energy - exact).max() < 1e-10 * max(exact.max(), run.dissipated[-1])
    assert 0 < max(run.residuals) < 1e-12  # rounding of direct solves
    assert run.residuals[0] != run.residuals[1]  # of the first and of the last step
    assert run.inputs.shape == (STEPS, n_s)
    assert run.saturated == 0.0
    loop.destroy()


def test_midpoint_recursion_converges_to_the_exponential() -> None:
    """Order two against exp(t E^-1 (A + B K)), from a smooth start (the step at t = 0 alone excites all modes)."""
    case = setup("two_way")
    target = hand_target(case.problem, aim(case))
    x_bar = case.full(target.state)
    exact_rate = np.linalg.solve(case.E, case.A + case.B @ case.K)
    smooth = scipy.linalg.expm(1.0 * exact_rate) @ (case.full(rest(case.problem.system)) - x_bar)
    n_s, n = case.problem.layout.n_s, case.problem.layout.n_e
    parts = np.split(smooth + x_bar, [n_s, 2 * n_s, 2 * n_s + n])
    rows = [local_rows(case.problem.layout, p.copy()) for p in parts[2:]]
    start = PlantState(parts[0], parts[1], *rows)
    exact = x_bar + scipy.linalg.expm(1.0 * exact_rate) @ smooth
    errors = []
    for steps in (20, 40, 80, 160):
        loop = ClosedLoop(case.problem, 1.0 / steps)
        run = loop.run(case.gain, target, steps, start=start)
        errors.append(close(case.full(run.final), exact))
        loop.destroy()
    order = np.polyfit(np.log([40, 80, 160]), np.log(errors[1:]), 1)[0]
    assert abs(order + 2) < 0.01, f"order {-order:.3f} of {errors}, 2 expected"  # next term at 40 steps


ACTUATIONS = [
    Actuation(rate=10.0),
    Actuation(rate=5.0, delay=True),
    Actuation(limits=3.0),
    Actuation(rate=10.0, delay=True, limits=(2.0,)),
]


@pytest.mark.parametrize("law", ACTUATIONS, ids=["held", "delayed", "limited", "all"])
@pytest.mark.parametrize("name", ["one_way", "two_way", "two_way_space"])
def test_actuation_against_a_plain_loop(name: str, law: Actuation) -> None:
    case = setup(name)
    target = hand_target(case.problem, -aim(case))
    loop = ClosedLoop(case.problem, 0.05)
    if law.limits is not None and case.problem.system.gravity is not None:
        peak = np.abs(loop.run(case.gain, target, STEPS, replace(law, limits=None)).inputs).max(axis=0)
        least = np.abs(target.u)
        law = replace(law, limits=tuple(np.where(peak > 1.01 * least, (peak + least) / 2, np.inf).tolist()))
    run = loop.run(case.gain, target, STEPS, law)
    X, U = plain_loop(case, 0.05, STEPS, target, law)
    assert close(run.inputs, U) < 1e-9  # two factorisations, 40 steps
    assert close(run.outputs, X @ case.C.T) < 1e-9  # as above
    assert close(case.full(run.final), X[-1]) < 1e-8  # the last state is smaller than the largest
    if law.limits is not None:
        assert 0 < run.saturated < 1
        assert (np.abs(run.inputs) <= np.asarray(law.limits)).all()
    loop.destroy()


@pytest.mark.serial
def test_implicit_input_with_limits_finds_the_only_solution() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        F = rng.standard_normal((3, 3))
        H = -F @ F.T - 0.1 * np.eye(3)  # feedback that takes energy out: the solution is unique
        u_0, bound = 3 * rng.standard_normal(3), rng.uniform(0.2, 2.0, 3)
        assert close(ImplicitInput(H, bound).solve(u_0), enumerate_input(u_0, H, bound)) < 1e-12  # same small solve


def test_cost_is_the_riccati_prediction(case: Setup) -> None:
    """J(T) + V(x(T)) = V(x(0)), exactly, for every time step: the midpoint rule keeps quadratic balances."""
    target = hand_target(case.problem, aim(case))
    start = rest(case.problem.system)
    V = predicted_cost(case.problem, case.solution, start - target.state)
    x = case.full(start) - case.full(target.state)
    direct = x @ case.E.T @ case.X @ case.E @ x
    assert pytest.approx(direct, rel=1e-9) == V  # factor Z drops negative rounding
    for steps in (10, 40):
        loop = ClosedLoop(case.problem, END / steps)
        run = loop.run(case.gain, target, steps)
        left = predicted_cost(case.problem, case.solution, run.final - target.state)
        assert 1e-6 * V < left < V  # what is to come counts, and is not all
        assert run.cost[-1] + left == pytest.approx(V, rel=1e-7)  # residual of SciPy's X
        assert run.cost[0] == 0
        assert (np.diff(run.cost) >= 0).all()
        loop.destroy()


def test_cost_of_sampling_is_second_order_in_the_tick() -> None:
    """Held input costs the optimum plus the integral of |u - K x|^2, which falls with the square of the tick."""
    case = setup("one_way")
    target = hand_target(case.problem, aim(case))
    V = predicted_cost(case.problem, case.solution, rest(case.problem.system) - target.state)
    loop = ClosedLoop(case.problem, 1 / 320)
    excess = []
    ticks = np.array([32, 16, 8, 4])
    for tick in ticks:
        run = loop.run(case.gain, target, 2560, Actuation(rate=320 / tick))
        left = predicted_cost(case.problem, case.solution, run.final - target.state)
        excess.append((run.cost[-1] + left) / V - 1)
    loop.destroy()
    order = np.polyfit(np.log(ticks[1:]), np.log(excess[1:]), 1)[0]
    # the balance itself is exact; k midpoints in a tick see 1 - 1/(4 k^2) of the integral, 0.984 at k = 4
    assert abs(order - 2) < 0.1, f"order {order:.3f} of {excess}, 2 expected"


def test_two_runs_of_one_loop_do_not_touch_each_other() -> None:
    case = setup("two_way")
    target = hand_target(case.problem, aim(case))
    loop = ClosedLoop(case.problem, 0.1)
    gain = case.gain
    copies = [gain.K_s.copy(), gain.K_z.copy(), gain.K_v.copy(), target.u.copy(), target.state.z.copy()]
    first = loop.run(gain, target, 10)
    loop.run(gain, hand_target(case.problem, 3 * aim(case)), 10, Actuation(rate=10.0))
    again = loop.run(gain, target, 10)
    assert (first.inputs == again.inputs).all()
    assert (first.final.z == again.final.z).all()
    for kept, now in zip(copies, (gain.K_s, gain.K_z, gain.K_v, target.u, target.state.z), strict=True):
        assert (kept == now).all()
    loop.destroy()


def test_observers_see_the_run() -> None:
    case = setup("one_way")
    target = hand_target(case.problem, aim(case))
    seen: list[tuple[int, float, Array]] = []
    loop = ClosedLoop(case.problem, 0.1)

    def frame(run: Any) -> None:
        n = case.problem.layout.n_local
        assert run.state.array.shape == (2 * n,)
        seen.append((run.reached, run.reached * run.dt, run.drive.q[run.reached].copy()))

    run = loop.run(case.gain, target, 30, options=LoopOptions(frames=(0, 7, 30), frame=frame))
    assert [s[0] for s in seen] == [0, 7, 30]
    assert all((q == run.q_s[n]).all() for n, _, q in seen)
    loop.destroy()


def test_a_target_of_another_length_is_refused() -> None:
    case = setup("space_gravity")
    with pytest.raises(ControlError, match="2 or 3 finite"):
        hand_target(case.problem, np.array([1.0]))


@pytest.mark.serial
@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Actuation(delay=True), "needs a rate"),
        (Actuation(rate=7.0), "no multiple"),
        (Actuation(rate=-1.0), "positive"),
        (Actuation(limits=0.0), "one positive number"),
        (Actuation(limits=(1.0, 2.0, 3.0)), "one per input"),
    ],
)
def test_actuation_that_does_not_fit_is_refused(law: Actuation, words: str) -> None:
    case = setup("one_way")
    loop = ClosedLoop(case.problem, 0.1)
    with pytest.raises(ControlError, match=words):
        loop.run(case.gain, hand_target(case.problem, aim(case)), 5, law)
    loop.destroy()


def test_a_gain_that_does_not_stabilise_is_named() -> None:
    case = setup("one_way")
    wrong = Gain(-case.gain.K_s, case.gain.K_z, case.gain.K_v)
    loop = ClosedLoop(case.problem, 0.1)
    with pytest.raises(SolverError, match="diverged before t"):
        loop.run(wrong, hand_target(case.problem, aim(case)), 20000)
    loop.destroy()


# --- reduced


def test_all_shapes_give_the_full_loop(case: Setup) -> None:
    """With as many shapes as unknowns the reduced loop is the full one, in other coordinates."""
    problem = case.problem
    full = np.eye(problem.layout.n_e)
    V = m_orthonormal(problem.system.M_ee, local_rows(problem.layout, full))
    plant, shapes = galerkin(problem, V)
    target, dt = hand_target(problem, aim(case)), 0.05
    x_bar, u_bar = plant.rest_at(aim(case))
    assert close(shapes.reduce(problem, target.state), x_bar) < 1e-9  # condition of K
    assert close(u_bar, target.u) < 1e-9 or np.abs(u_bar - target.u).max() < 1e-9  # zero without gravity
    K = shapes.reduce_gain(problem, case.gain)
    back = expand_gain(shapes, problem, K)
    assert close(gather_rows(problem.layout, back.K_z), gather_rows(problem.layout, case.gain.K_z)) < 1e-12  # V'MV = I
    loop = ClosedLoop(problem, dt)
    limit = tuple(1.3 * np.abs(target.u) + 2.0)
    for law in (Actuation(), Actuation(limits=limit), Actuation(rate=10.0, delay=True, limits=limit)):
        run = loop.run(case.gain, target, STEPS, law)
        small = run_small(plant, dt, K, (x_bar, u_bar), STEPS, (problem.Q, problem.R), law)
        assert close(small.outputs, run.outputs) < 1e-8  # two ways to the same numbers, condition of M and K
        assert close(small.inputs, run.inputs) < 1e-8  # as above
        assert close(small.cost, run.cost) < 1e-8  # as above
        assert small.saturated == run.saturated
        end = expand(shapes, problem, small.states[-1])
        assert close(gather_rows(problem.layout, end.z), gather_rows(problem.layout, run.final.z)) < 1e-6  # small end
    loop.destroy()


def test_few_modes_give_nearly_the_full_loop() -> None:
    case = setup("one_way")
    problem = case.problem
    _, V = lowest_modes(problem.system, 12)
    plant, shapes = galerkin(problem, V)
    target = hand_target(problem, aim(case))
    loop = ClosedLoop(problem, 0.05)
    run = loop.run(case.gain, target, 200)
    K = shapes.reduce_gain(problem, case.gain)
    small = run_small(plant, 0.05, K, plant.rest_at(aim(case)), 200, (problem.Q, problem.R))
    error = close(small.outputs, run.outputs)
    assert error < 2e-3  # static share of the modes left out, about (omega_1 / omega_12)^2 of a deformation of 3 %
    assert small.cost[-1] == pytest.approx(run.cost[-1], rel=1e-4)  # sag is little of the cost: 3e-6
    loop.destroy()


def test_dependent_shapes_are_refused() -> None:
    case = setup("one_way")
    _, V = lowest_modes(case.problem.system, 3)
    with pytest.raises(ControlError, match="linearly dependent"):
        galerkin(case.problem, np.asfortranarray(np.hstack([V, V])))
