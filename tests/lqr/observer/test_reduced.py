"""The filter that runs: its Riccati equation, lost and late samples, and its judgement on the full plant."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.petsc import rows_on_all, total
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.feedback import Design, design
from softgrasp.lqr.design.observer import ObservedControl, observe
from softgrasp.lqr.loop.controller import Controller
from softgrasp.lqr.observer.judge import Ticks, loop_map, make_ticks
from softgrasp.lqr.observer.reduced import reduced_filter
from softgrasp.lqr.observer.sensors import make_disturbance
from softgrasp.lqr.observer.tail import rest_of
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.spectrum.modal_loop import ModalLoop

OBSERVER = "control.observer={markers=[[0,0],[1,0],[0,1],[1,1]],disturbance={box=[[0,0],[1,0]]}}"
SMALL = "tissue.cells=[4,8]"


@cache
def observed(*overrides: str) -> tuple[Design, ObservedControl, Ticks]:
    model = build(load_scene("paper_lqr", [SMALL, OBSERVER, *overrides]), comm=MPI.COMM_WORLD)
    made = design(model)
    found = observe(made, Stopwatch(model.system.layout.comm))
    acting = make_disturbance(made.problem, 0.02, 0.05, [[0, 0], [1, 0]])
    return made, found, make_ticks(made.problem, found.loop, found.sensors, acting, found.controller.period)


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("Q", "most"), [("1.0", 0.002), ("1e6", 0.11)])
def test_loop_with_observer_is_as_fast_as_with_the_state_known(Q: str, most: float) -> None:
    judged = observed(f"control.Q={Q}")[1].judged
    assert judged.abscissa < 0.98 * judged.abscissa_known < 0
    assert 0 < judged.excess <= most  # the least cost is that of the known state


def test_modes_that_the_full_loop_shows_to_be_slow_take_the_place_of_others() -> None:
    made, found, ticks = observed("control.Q=1e7")
    acting = make_disturbance(made.problem, 0.02, 0.05, [[0, 0], [1, 0]])
    first = reduced_filter(made.problem, found.loop.plant, found.sensors, acting, 14, 1e-3)
    values = np.linalg.eigvals(loop_map(ticks, found.controller.K, first.filter).F)
    assert found.judged.abscissa < 0.98 * found.judged.abscissa_known
    assert np.log(np.abs(values).max()) / 1e-3 > 0.98 * found.judged.abscissa_known  # the modes by cost leave it slow
    assert len(found.reduced.kept) == len(first.kept) == 3
    assert set(found.reduced.kept) != set(first.kept)
    assert found.weight < 1


@pytest.mark.slow
@pytest.mark.parametrize(("Q", "most"), [("1.0", 0.002), ("1e6", 0.11)])
def test_paper_mesh_has_a_fast_observer_of_14_states(Q: str, most: float) -> None:
    judged = observed(f"control.Q={Q}", "tissue.cells=[10,20]")[1].judged
    assert 0.98 < judged.abscissa / judged.abscissa_known < 1.02  # of the loop with the state known
    assert 0 < judged.excess <= most


def test_filter_that_ignores_what_it_leaves_out_spills_over() -> None:
    made, found, ticks = observed("control.Q=1e6")
    acting = make_disturbance(made.problem, 0.02, 0.05, [[0, 0], [1, 0]])
    naive = reduced_filter(made.problem, found.loop.plant, found.sensors, acting, 14, 1e-3, weight=0.0)
    slow = np.log(np.abs(np.linalg.eigvals(loop_map(ticks, found.controller.K, naive.filter).F)).max()) / 1e-3
    own = naive.filter
    fast = np.log(np.abs(np.linalg.eigvals(own.A @ (np.eye(14) - own.M @ own.C))).max()) / 1e-3
    assert fast < -1  # on its own plant nothing shows
    assert -0.1 < slow < 0  # the full one is a tenth as fast as with the state known


def test_swings_that_the_noise_hides_add_up_to_it() -> None:
    """Samples of the full plant from a free swing: the sum of all, over their variances, is one."""
    made, found, ticks = observed()
    seen, n, modes = found.seen, len(found.loop.plant.omega), found.loop.plant
    assert seen is not None
    for i, mode in enumerate(seen.modes):
        pair = [4 + mode, 4 + n + mode]
        C = ticks.C[found.sensors.markers][:, pair] / ticks.sd[found.sensors.markers, None]
        A = ticks.A[np.ix_(pair, pair)]
        gramian = scipy.linalg.solve_discrete_lyapunov(A.T, C.T @ C)
        shape = rows_on_all(made.problem.layout.comm, modes.Phi[:, mode])
        moved = np.linalg.norm(shape.reshape(-1, 2), axis=1).max()
        eta = seen.hidden[i] / moved
        # samples of 1 ms for an integral, and a decay of 1.4 % of the third mode's frequency
        assert abs(gramian[0, 0] * (modes.omega[mode] * eta) ** 2 - 1) < 0.02
        assert (seen.share[:, i] <= 1).all()


@pytest.mark.parametrize("delay", [0, 3])
def test_loop_of_few_modes_and_the_rest_is_the_whole_one_and_the_rest_is_bounded(delay: int) -> None:
    """det(zI - F) = det(zI - F_few) det(zI - A_rest) det(I - T D); small gain of a good filter, not of a naive one."""
    made, found, ticks = observed("control.Q=1e6")
    problem, kept, n, K = made.problem, 30, len(found.loop.plant.omega), found.controller.K
    few, acting = ModalLoop(problem, kept), make_disturbance(problem, 0.02, 0.05, [[0, 0], [1, 0]])
    small, rest = make_ticks(problem, few, found.sensors, acting, 1e-3), rest_of(problem, few, found.sensors, 1e-3)
    left = np.r_[4 + kept : 4 + n, 4 + n + kept : 4 + 2 * n]
    A, B, C = ticks.A[np.ix_(left, left)], ticks.B[left], ticks.C[:, left]

    def from_inputs(z: complex) -> np.ndarray:
        return C @ np.linalg.solve(z * np.eye(len(left)) - A, B)

    assert found.controller.observer is not None
    good = replace(found.controller.observer, delay=delay)
    naive = reduced_filter(problem, found.loop.plant, found.sensors, acting, 14, 1e-3, delay, weight=0.0).filter
    largest = max(np.linalg.norm(from_inputs(z) / ticks.sd[:, None], 2) for z in np.exp(1j * np.geomspace(1e-3, 3, 99)))
    assert largest <= rest.size
    gains = []
    for own in (good, naive):
        whole, part = loop_map(ticks, K, own), loop_map(small, K, own)
        F, enter = part.F, part.noise[:, -len(small.sd) :] / small.sd
        leave, direct = K @ part.estimate, K @ part.direct / small.sd
        gains.append(rest.gain(F, enter, leave, direct))
        for z in (1.1 * np.exp(0.3j), np.exp(0.01j)):
            T = leave @ np.linalg.solve(z * np.eye(len(F)) - F, enter) + direct
            product = np.linalg.slogdet(np.eye(len(T)) - T @ from_inputs(z))
            parts = [np.linalg.slogdet(z * np.eye(len(X)) - X) for X in (F, A)]
            # the lowest modes have an error of their own, the residual of SLEPc
            assert np.isclose(np.linalg.slogdet(z * np.eye(len(whole.F)) - whole.F)[1],
                              sum(x[1] for x in (product, *parts)), rtol=1e-7)  # fmt: skip
            assert gains[-1] >= (1 - 1e-6) * np.linalg.norm(T * small.sd, 2) * largest
    assert gains[0] < 0.5 < 1 < gains[1]


def test_correction_solves_the_riccati_equation_of_the_ticks() -> None:
    own = observed()[1].reduced
    A, C, P = own.filter.A, own.filter.C, own.P
    after = P - own.filter.M @ C @ P
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + own.V)
    assert np.abs(own.filter.M - gain).max() < 1e-9 * np.abs(gain).max()  # rounding through the condition of C P C' + V
    W = P - A @ after @ A.T  # what a tick adds: of the disturbances, no more
    assert np.linalg.eigvalsh((W + W.T) / 2).min() > -1e-9 * np.abs(W).max()


def run(plant: Ticks, controller: Controller, ticks: int, start: np.ndarray, lost: slice | None = None) -> np.ndarray:
    """States of the full plant under ``Controller.step`` without noise, (ticks, n)."""
    x, late, rows = start, [np.full(len(plant.C), np.nan)] * controller.observer.delay, []
    controller.reset()
    for _ in range(ticks):
        late.append(plant.C @ x)
        sample = late.pop(0)
        y = np.array(sample[2:])
        if lost is not None:
            y[lost] = np.nan
        u = controller.step(x[:2], x[2:4], y)
        rows.append(x)
        x = plant.A @ x + plant.B @ u
    return np.array(rows)


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_judged_map_is_what_step_does(delay: int) -> None:
    _, found, plant = observed()
    own, n = replace(found.controller.observer, delay=delay), len(plant.A)
    controller = replace(found.controller, observer=own, x_bar=0 * found.controller.x_bar)
    start = np.random.default_rng(3).standard_normal(n)
    start[:4] = 0.0  # what the filter starts from
    rows = run(plant, controller, 40, start, lost=slice(0, 2))
    # at the tick at which the first samples arrive: the state, what the filter starts from, inputs and samples before
    x = rows[: delay + 1]
    inputs = [np.linalg.lstsq(plant.B, b - plant.A @ a)[0] for a, b in pairwise(x)]
    state = np.concatenate([x[-1], np.zeros(14), *inputs[::-1], *(plant.C @ past for past in x[-2::-1])])
    F = loop_map(plant, controller.K, own, np.isin(np.arange(10), [2, 3])).F
    for row in rows[delay + 1 :]:
        state = F @ state
        assert np.abs(state[:n] - row).max() < 1e-9  # rounding of 40 ticks, and of the inputs found from the states


def test_estimate_of_its_own_plant_is_exact_with_samples_lost_and_late() -> None:
    found = observed()[1]
    own = replace(found.controller.observer, delay=2)
    controller = replace(found.controller, observer=own)
    x, late, generator = np.zeros(14), [np.full(10, np.nan)] * 2, np.random.default_rng(1)
    for tick in range(200):
        late.append(own.C @ x)
        y = late.pop(0)[2:]
        given = None if tick % 7 == 0 else np.where(generator.random(8) < 0.3, np.nan, y)
        u = controller.step(x[:2], x[2:4], given)
        assert np.abs(controller._x - x).max() < 1e-12 * (1 + np.abs(x).max()) * 200  # rounding of 200 ticks
        x = own.A @ x + own.B @ u + own.f
    assert np.abs(x[:2]).min() > 1e-3  # it moved


@pytest.mark.parametrize("delay", [0, 2])
def test_absurd_samples_leave_nothing_behind(delay: int) -> None:
    found = observed()[1]
    own = replace(found.controller.observer, delay=delay)
    robot, twin = (replace(found.controller, observer=own) for _ in range(2))
    generator = np.random.default_rng(2)
    for tick in range(60):
        q, v, y = 1e-3 * generator.standard_normal(2), np.zeros(2), 1e-3 * generator.standard_normal(8)
        absurd = 20 <= tick < 25
        with np.errstate(over="ignore", invalid="ignore"):
            u = robot.step(np.full(2, 1e308) if absurd else q, v, np.full(8, -1e308) if absurd else y)
        known = twin.step(np.full(2, np.nan) if absurd else q, v, None if absurd else y)
        assert np.isfinite(u).all()
        assert delay or np.array_equal(u, known)  # as if all had been lost


def test_cost_and_deviations_are_those_of_another_lyapunov_solver() -> None:
    made, found, plant = observed()
    judged, controller, n = found.judged, found.controller, len(plant.A)
    loop = loop_map(plant, controller.K, controller.observer)
    X = scipy.linalg.solve_discrete_lyapunov(loop.F, loop.noise @ loop.noise.T, method="bilinear")
    close = 1e-7  # |X| / distance of the spectrum from the circle, 2e-5, in units of rounding
    assert np.abs(judged.covariance - X[:n, :n]).max() < close * np.abs(X).max()
    seen = np.hstack([plant.y, np.zeros((2, 14))])
    off = seen - controller.plant.C @ loop.estimate
    at_once = controller.plant.C @ loop.direct
    assert np.allclose(judged.sd_error, np.sqrt(np.diag(off @ X @ off.T + at_once @ at_once.T)), rtol=1e-5)
    u, now = controller.K @ loop.estimate, controller.K @ loop.direct
    cost = np.trace(made.problem.Q @ seen @ X @ seen.T) + np.trace(made.problem.R @ (u @ X @ u.T + now @ now.T))
    assert abs(judged.cost / cost - 1) < close
    # the least cost, of the known state and the law in continuous time, from the other side
    F = plant.A + plant.B @ found.loop.gain(made.gain.block)
    Y = scipy.linalg.solve_discrete_lyapunov(F, plant.W @ plant.W.T, method="bilinear")
    K = found.loop.gain(made.gain.block)
    least = np.trace(made.problem.Q @ plant.y @ Y @ plant.y.T) + np.trace(made.problem.R @ K @ Y @ K.T)
    assert abs(judged.cost_known / least - 1) < 3e-4  # the law is held for a millisecond, which costs 1.5e-4


@pytest.mark.ranks(2)
def test_what_a_long_tick_adds_is_the_integral_over_it() -> None:
    made, found, plant = observed("control.loop.rate=5.0")  # the fastest mode turns eight times in a tick
    acting, modes = make_disturbance(made.problem, 0.02, 0.05, [[0, 0], [1, 0]]).factor, found.loop.plant
    loads = total(made.problem.layout.comm, modes.Phi.T @ acting.parts[3])
    G = np.linalg.solve(modes.space.E, np.vstack([acting.hand, np.zeros_like(loads), loads]))
    points, weights = np.polynomial.legendre.leggauss(120)  # more than four a turn of what is integrated
    exact = np.zeros_like(plant.A)
    for point, weight in zip((points + 1) / 2 * plant.period, weights / 2 * plant.period, strict=True):
        moved = scipy.linalg.expm(point * found.loop.A) @ G
        exact += weight * moved @ moved.T
    assert np.abs(plant.W @ plant.W.T - exact).max() < 1e-3 * np.abs(exact).max()  # Simpson's rule of a radian: 4e-4
    assert np.abs(plant.A - scipy.linalg.expm(plant.period * found.loop.A)).max() < 1e-9  # rounding of squarings


def test_controller_with_observer_survives_a_file(tmp_path: Path) -> None:
    found = observed()[1].controller
    again = Controller.load(found.save(tmp_path / "observer.npz"))
    found.reset()
    q, v, y = np.array([0.1, 0.2]), np.zeros(2), np.linspace(0.1, 0.2, 8)
    for _ in range(5):
        assert np.array_equal(again.step(q, v, y), found.step(q, v, y))
    assert again.observer.names == found.observer.names


def test_what_step_cannot_take_is_refused() -> None:
    found = observed()[1].controller
    found.reset()
    with pytest.raises(ControlError, match="this controller needs 8 samples beside q_s"):
        found.step(np.zeros(2), np.zeros(2), np.zeros(3))
    found.reset()
    with pytest.raises(ControlError, match="first samples of the hand must be finite"):
        found.step(np.full(2, np.nan), np.zeros(2))
    with pytest.raises(ControlError, match="no observer that uses y"):
        replace(found, observer=None).step(np.zeros(2), np.zeros(2), np.zeros(8))
    with pytest.raises(ControlError, match="observer has 14 states, the plant of the controller"):
        replace(found, observer=replace(found.observer, A=np.eye(14), B=np.zeros((14, 3))))


def test_observer_does_without_the_full_filter_where_rounding_ends_it() -> None:
    found = observed("control.observer.noise.marker=1e-6")[1]
    assert found.full is None
    assert "rounding limits this problem" in found.missing
    assert found.judged.stable


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("control.observer.N=400", "control.observer.N is 400; this plant has observers of 10 to"),
        ("effects.damping=false", "no damping: feedback alone has to stabilise all"),
        ("control.method='modal'", "leave out control.method = 'modal'"),
        ("control.loop={sampling='held',rate=2.0,delay=1}", "give control.observer.delay instead"),
    ],
)
def test_scenes_without_an_observer_are_refused(override: str, sentence: str) -> None:
    with pytest.raises(Exception, match=sentence.replace(".", r"\.")):
        observed(override)
