"""Duality gap against dense oracles: the least cost of all inputs, the adjoint recursion, the true excess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.design.orders import with_bounds
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.loop.gap import Course, DualityGap, duality_gaps
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.reduced.bases import make_family
from softgrasp.lqr.reduced.riccati import GainCheck, GainReport, reduce_riccati
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from tests.helpers.loop import CASES, Setup, setup
from tests.helpers.models import local_rows, make_scene, same_everywhere
from tests.helpers.riccati import hand_start

pytestmark = pytest.mark.ranks

Array = np.ndarray
STEPS, DT = 60, 0.1


def off(case: Setup) -> tuple[Setup, Block, Array]:
    """The same plant under a gain that is not optimal, and a start in which the tissue moves as well."""
    rng = np.random.default_rng(5)
    layout = case.problem.layout
    n_s, n = layout.n_s, layout.n_e
    K = case.K * (1 + 0.2 * rng.standard_normal(case.K.shape))
    x = np.concatenate([-np.arange(1.0, n_s + 1), np.zeros(n_s), 0.1 * rng.standard_normal(2 * n)])
    tall = [local_rows(layout, x[a : a + n, None].copy()) for a in (2 * n_s, 2 * n_s + n)]
    return replace(case, K=K), Block(x[: 2 * n_s, None], np.concatenate(tall)), x


def least_cost(case: Setup, x: Array, terminal: Array, Q: Array, R: Array) -> float:
    """min over all inputs, by the discrete Riccati recursion of the midpoint rule with dense matrices."""
    left = case.E - DT / 2 * case.A
    F, G = np.linalg.solve(left, case.E + DT / 2 * case.A), np.linalg.solve(left, DT * case.B)
    C, D = case.C @ (F + np.eye(len(F))) / 2, case.C @ G / 2
    S = terminal
    for _ in range(STEPS):
        H, N = DT * (R + D.T @ Q @ D) + G.T @ S @ G, DT * C.T @ Q @ D + F.T @ S @ G
        S = DT * C.T @ Q @ C + F.T @ S @ F - N @ np.linalg.solve(H, N.T)
    return float(x @ S @ x)


def dense_gap(case: Setup, x: Array, terminal: Array, Q: Array, R: Array) -> tuple[float, float]:
    """Cost of the run under case.K and its gap, by the adjoint recursion with dense matrices."""
    X, U = case.recursion(x, np.zeros_like(x), np.zeros(len(case.K)), DT, STEPS)
    y = (X[1:] + X[:-1]) @ case.C.T / 2
    left, right = (case.E - DT / 2 * case.A).T, (case.E + DT / 2 * case.A).T
    costate = np.linalg.solve(case.E.T, terminal @ X[-1])
    gap = 0.0
    for k in reversed(range(STEPS)):
        before = np.linalg.solve(left, right @ costate + DT * case.C.T @ Q @ y[k])
        r = R @ U[k] + case.B.T @ (before + costate) / 2
        gap, costate = gap + DT * r @ np.linalg.solve(R, r), before
    cost = DT * (np.einsum("ki,ij,kj->", y, Q, y) + np.einsum("ki,ij,kj->", U, R, U))
    return float(cost + X[-1] @ terminal @ X[-1]), float(gap)


@pytest.mark.ranks(ends="any Z")
@pytest.mark.parametrize("ends", ["nothing to come", "Riccati", "any Z"])
@pytest.mark.parametrize("name", list(CASES))
def test_gap_is_the_adjoint_recursion_and_bounds_the_excess(name: str, ends: str) -> None:
    """Coupling both ways, drag in space, rotation; Z does not have to solve anything."""
    case, start, x = off(replace(setup(name), f=np.zeros_like(setup(name).f)))
    problem, E = case.problem, case.E
    whole, part = case.solution.factor, slice(-3, None)  # the largest columns
    Z = {"nothing to come": None, "Riccati": whole, "any Z": whole[part].times(np.diag([1.0, 2.0, 0.3]))}[ends]
    values, vectors = np.linalg.eigh(case.X)
    dense = vectors * np.sqrt(np.maximum(values, 0))
    if ends == "any Z":
        dense = dense[:, part] * [1.0, 2.0, 0.3]
    terminal = np.zeros_like(E) if Z is None else E.T @ dense @ dense.T @ E
    solution = None if Z is None else replace(case.solution, factor=Z)
    (found,) = duality_gaps(problem, [case.gain], Course(start, DT, STEPS), solution)
    cost, gap = dense_gap(case, x, terminal, problem.Q, problem.R)
    least = least_cost(case, x, terminal, problem.Q, problem.R)
    assert abs(found.cost / cost - 1) < 1e-9  # two factorisations, 60 steps, sums with the hand's growing responses
    assert abs(found.gap / gap - 1) < 1e-7  # as above, of a difference
    assert 0 < cost - least <= found.gap
    assert (cost - least) / least <= found.cost_excess_at_most
    assert found.end == pytest.approx(STEPS * DT)
    assert same_everywhere(problem.layout.comm, np.array([found.gap, found.cost]))


def test_gap_closes_at_the_optimal_gain() -> None:
    """With the Riccati solution behind the end there is no floor: u* is optimal for every number of steps and dt."""
    case = setup("one_way")
    for steps, dt in ((5, 1.0), (50, 0.2), (200, 0.05)):
        start = hand_start(case.problem, [5.0, 3.0])
        (found,) = duality_gaps(case.problem, [case.gain], Course(start, dt, steps), case.solution)
        assert found.gap < 1e-12 * found.cost  # rounding of the dense X, squared
        x = np.concatenate([start.hand[:, 0], np.zeros(2 * case.problem.layout.n_e)])
        assert found.cost == pytest.approx(x @ case.E.T @ case.X @ case.E @ x, rel=1e-8)  # rounding of X


def test_reduced_gains_stay_below_their_bound() -> None:
    """Against the excess cost of the loop without end, from a Lyapunov equation."""
    scene = make_scene({"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.002}}, "tissue": {"cells": [4, 8]}})
    problem = make_problem(build(scene, comm=MPI.COMM_WORLD))
    solution = DenseRiccati().solve(problem)
    start = hand_start(problem, [-5.0, -3.0])
    gain_check = GainCheck(problem, solution, start, ModalLoop(problem))
    family = make_family("structured", problem, solution.factor)
    gains = [reduce_riccati(problem, family.at(N)).gain for N in (4, 8, 12, 20)]
    excess = np.array([gain_check.quality(gain).cost_excess for gain in gains])
    assert 1e-12 < excess.min() < excess.max() < 1e-4  # above rounding, and a gain that is worth a bound
    alone = np.array(
        [duality_gaps(problem, [gain], Course(start, 0.5, 600), solution)[0].cost_excess_at_most for gain in gains]
    )
    gaps = duality_gaps(problem, gains, Course(start, 0.5, 600), solution)
    bounds = np.array([gap.cost_excess_at_most for gap in gaps])
    assert bounds == pytest.approx(alone, rel=1e-12)  # the run of the optimal law is always among them
    ran = np.array([gap.excess for gap in gaps])
    assert ran == pytest.approx(excess, rel=1e-2)  # what is to come after 300 s
    assert (bounds >= excess).all(), bounds / excess
    # what is to come after 300 s, five times; a fifth of what the last half lost is less
    room = np.array([5.1 * gap.to_come / gap.least for gap in gaps])
    assert (bounds <= 1.001 * excess + room).all(), bounds / excess
    longer = duality_gaps(problem, gains, Course(start, 0.5, 1200), solution)
    bounds = np.array([gap.cost_excess_at_most for gap in longer])
    assert (bounds >= excess * (1 - 1e-6)).all(), bounds / excess  # rounding of the Lyapunov equation
    assert (bounds[:2] <= [1.003 * excess[0], 3 * excess[1]]).all(), bounds / excess  # sharp, as little is to come


def test_a_run_that_starts_at_its_target_costs_nothing_and_bounds_nothing() -> None:
    """0 / 0 of the relative excess: the bound says infinite, and nothing is divided by zero."""
    case = setup("one_way")
    course = Course(hand_start(case.problem, [0.0, 0.0]), DT, STEPS)
    report = GainReport("structured", 4, 0.0, error_K=0.0, cost_excess=0.0, abscissa_full=-1.0, gain=case.gain)
    (bounded,) = with_bounds(case.problem, case.solution, [report], course)
    assert bounded.cost_excess_at_most == np.inf


def test_a_gain_that_does_not_stabilise_has_no_bound() -> None:
    case = setup("one_way")
    away = Gain(-100 * case.gain.K_s, case.gain.K_z, case.gain.K_v)
    (found,) = duality_gaps(case.problem, [away], Course(hand_start(case.problem, [5.0, 3.0]), 1.0, 400))
    assert found.cost_excess_at_most > 1e3  # nan would hide it


def test_relative_bound_says_infinite() -> None:
    assert DualityGap(2.0, 1.0, -1.0, 0.0, 1.0).cost_excess_at_most == np.inf
    assert DualityGap(np.inf, np.inf, 1.0, np.inf, 1.0).cost_excess_at_most == np.inf
    assert DualityGap(1.0, 3.0, 2.0, 0.0, 1.0).cost_excess_at_most == 0.5
    after = DualityGap(1.0, 3.0, 2.5, 0.1, 1.0, after=0.1)
    assert after.cost_excess_at_most == pytest.approx((0.5 + 0.1) / 2.5, rel=1e-11)  # rounding of a cost, 1e-12
    assert DualityGap(1.0, 3.0, 2.5, 0.0, 1.0).cost_excess_at_most == pytest.approx(0.2, rel=1e-11)
