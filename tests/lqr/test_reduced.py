"""Reduced Riccati equations: bases against their dense definition, figures against the full plant of another code."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.lqr.dense.care import fast_solution, solve_reduced
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import costates_to_absolute, gain_to_absolute
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import BASES, BasisFamily, energy_scaled, make_family
from softgrasp.lqr.reduced.retune import Materials, Retuner, retuned_gain
from softgrasp.lqr.reduced.riccati import GainCheck, full_gain, project_plant, reduce_riccati
from softgrasp.lqr.spectrum.certificate import abscissa
from softgrasp.lqr.spectrum.modal_loop import ModalLoop
from tests.helpers.models import (
    Array,
    FirstOrder,
    close,
    first_order,
    gather_rows,
    make_scene,
    reference,
    same_everywhere,
)
from tests.helpers.riccati import closed_loop, hand_start

PAPER = [name for name in BASES if name != "structured"]
DAMPED = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.002}}, "tissue": {"cells": [3, 6]}}
TARGET = np.array([5.0, 3.0])


@cache
def plant(two_way: bool = False) -> tuple[Model, RiccatiProblem, RiccatiSolution]:
    model = build(make_scene(DAMPED, {"effects": {"reaction": two_way}}), comm=MPI.COMM_WORLD)
    problem = make_problem(model)
    return model, problem, DenseRiccati().solve(problem)


@cache
def family(name: str) -> BasisFamily:
    _, problem, solution = plant()
    return make_family(name, problem, solution.factor)


@cache
def full_order() -> FirstOrder:
    return first_order(reference(plant()[0]))


def ordered(X: Block) -> Array:
    """Rows [q_s, v_s, q, v], the paper's order, tissue in node order. Collective."""
    layout = plant()[1].layout
    n = layout.n_local
    return np.concatenate([X.hand, gather_rows(layout, X.tall[:n]), gather_rows(layout, X.tall[n:])])


def to_paper(n_s: int, n: int) -> Array:
    """Permutation from [q_s, q, v_s, v] of the helpers to the paper's [q_s, v_s, q, v]."""
    i = np.arange(2 * (n_s + n))
    return np.concatenate([i[:n_s], i[n_s + n : 2 * n_s + n], i[n_s : n_s + n], i[2 * n_s + n :]])


def matrices() -> tuple[Array, Array, Array, Array]:
    """E, A, B of scikit-fem and P in the paper's coordinates."""
    _, problem, solution = plant()
    full, n_s, n_e = full_order(), problem.layout.n_s, problem.layout.n_e
    order = to_paper(n_s, n_e)
    Z = ordered(costates_to_absolute(problem.system, solution.factor))
    return full.E[np.ix_(order, order)], full.A[np.ix_(order, order)], full.B[order], Z @ Z.T


def dense_definition(name: str, N: int) -> Array:
    """V of the paper's text, from a dense P."""
    E, _, _, P = matrices()
    n_s = plant()[1].layout.n_s
    s, n = 2 * n_s, (len(E) - 2 * n_s) // 2
    q, v, hand_q = slice(s, s + n), slice(s + n, None), slice(0, n_s)

    def leading(X: Array, k: int) -> Array:
        return np.linalg.svd(X)[0][:, :k]

    if name == "pod":
        return leading(P, N)
    if name == "weighted_pod":
        W = scipy.linalg.sqrtm((E + E.T) / 2).real
        return np.linalg.solve(W, leading(W @ P, N))
    if name == "pod_fixed_solid":
        tissue = leading(P[s:], N - s)
    elif name == "componentwise_pod":
        first = leading(np.hstack([P[q, hand_q], P[q, q], P[q, v]]), (N - s + 1) // 2)
        second = leading(np.hstack([P[v, hand_q], P[v, q], P[v, v]]), (N - s) // 2)
        tissue = scipy.linalg.block_diag(first, second)
    else:
        one = leading(np.hstack([P[q, q], P[q, v], P[v, q], P[v, v]]), (N - s) // 2)
        tissue = scipy.linalg.block_diag(one, one)
    return scipy.linalg.block_diag(np.eye(s), tissue)


def projector(V: Array) -> Array:
    Q = np.linalg.qr(V)[0]
    return Q @ Q.T


@pytest.mark.parametrize("name", PAPER)
def test_bases_equal_their_dense_definition(name: str) -> None:
    for N in (8, 12, 20):
        basis = family(name).at(N)
        V = ordered(Block(basis.U.hand, basis.U.tall + under(basis.U)))
        # a POD subspace is as good as eps sigma_1 / gap; the dense P loses half the digits of what it holds below
        assert np.linalg.norm(projector(V) - projector(dense_definition(name, N)), 2) < 1e-5, N
        if name == "weighted_pod":
            E = matrices()[0]
            assert close(V.T @ (E + E.T) / 2 @ V, np.eye(N)) < 1e-10  # condition of W


def under(U: Block) -> Array:
    """What turns relative rows into absolute ones: T q_s and T v_s."""
    _, problem, _ = plant()
    n_s, T = problem.layout.n_s, problem.system.T
    return np.concatenate([T @ U.hand[:n_s], T @ U.hand[n_s:]])


@pytest.mark.parametrize("name", PAPER)
def test_reduced_equation_is_the_papers(name: str) -> None:
    """P_hat, error of P and gain, from V'EV, V'AV of another code."""
    _, problem, solution = plant()
    E, A, B, P = matrices()
    n_s, N = problem.layout.n_s, 12
    reduced = reduce_riccati(problem, family(name).at(N))
    V = ordered(Block(reduced.basis.U.hand, reduced.basis.U.tall + under(reduced.basis.U)))
    C = outputs_in_papers_order(problem)
    P_N = solve_scipy(V.T @ E @ V, V.T @ A @ V, V.T @ B, C @ V)
    P_hat = V @ P_N @ V.T
    report = GainCheck(problem, solution, hand_start(problem, -TARGET)).report(family(name).at(N))
    error = np.linalg.norm(P - P_hat) / np.linalg.norm(P)
    assert abs(report.error_P - error) < 1e-6 * (1 + error)  # SciPy's accuracy
    K, K_hat = -B.T @ P @ E, -B.T @ P_hat @ E
    assert abs(report.error_K - np.linalg.norm(K - K_hat) / np.linalg.norm(K)) < 1e-6 * (1 + error)  # as above
    mine = ordered(gain_to_absolute(problem.system, reduced.gain.block)).T
    assert close(mine, K_hat) < 1e-6  # SciPy's accuracy
    assert mine.shape == (n_s, len(E))


def outputs_in_papers_order(problem: RiccatiProblem) -> Array:
    layout = problem.layout
    T, C_z = gather_rows(layout, problem.system.T), gather_rows(layout, problem.C_z)
    zero = np.zeros_like(problem.C_s)
    return np.hstack([problem.C_s - C_z.T @ T, zero, C_z.T, np.zeros_like(C_z.T)])


def solve_scipy(E: Array, A: Array, B: Array, C: Array) -> Array:
    Y = scipy.linalg.solve_continuous_are(np.linalg.solve(E, A), np.linalg.solve(E, B), C.T @ C, np.eye(B.shape[1]))
    return np.linalg.solve(E.T, np.linalg.solve(E.T, Y).T)


def test_marks_come_from_the_spectrum_of_the_full_closed_loop() -> None:
    """Every abscissa equals that of E^-1 (A + B K_hat) by scikit-fem and LAPACK; stable and unstable ones occur."""
    _, problem, solution = plant()
    E, A, B, _ = matrices()
    gain_check = GainCheck(problem, solution, hand_start(problem, -TARGET))
    seen = set()
    for name in ("pod", "pod_fixed_solid", "structured"):
        for N in family(name).orders(range(6, 37, 6)):
            report = gain_check.report(family(name).at(N))
            if report.reason:
                assert not report.stable
                continue
            K = ordered(gain_to_absolute(problem.system, reduce_riccati(problem, family(name).at(N)).gain.block)).T
            exact = scipy.linalg.eigvals(A + B @ K, E).real.max()
            assert abs(report.abscissa_full - exact) < 1e-9 * (1 + np.linalg.norm(K)), (name, N)  # rounding of B K
            assert report.stable == (exact < 0), (name, N)
            assert np.isfinite(report.cost_excess) == report.stable
            seen.add(report.stable)
    assert seen == {True, False}


def test_a_gain_that_drives_away_is_marked_unstable() -> None:
    _, problem, solution = plant()
    gain_check = GainCheck(problem, solution, hand_start(problem, -TARGET))
    away = Gain.of_block(solution.gain.block.times(-np.eye(2)))
    good, bad = gain_check.quality(solution.gain), gain_check.quality(away)
    assert good.stable
    assert good.cost_excess == 0
    assert bad.abscissa > 0.1  # 0.43: no rounding
    assert not bad.stable
    assert bad.cost_excess == np.inf
    large = abscissa(problem, away)
    assert abs(large.value - bad.abscissa) < 1e-7  # tolerance 1e-9 of eigenvalues of size 10
    assert not large.stable


def test_the_road_of_large_scenes_says_the_same() -> None:
    """Certificate and lowest modes against all modes; without a certificate all modes decide."""
    _, problem, solution = plant()
    start = hand_start(problem, -TARGET)
    whole = GainCheck(problem, solution, start)
    large = GainCheck(problem, solution, start, ModalLoop(problem, 20))
    assert whole.loop.complete
    assert not large.loop.complete
    for name, N in (("pod", 12), ("pod", 20), ("structured", 8), ("pod_decomposed", 8)):
        a, b = whole.report(family(name).at(N)), large.report(family(name).at(N))
        assert a.stable == b.stable, name
        assert abs(a.abscissa_full - b.abscissa_full) < 1e-7 or not a.stable, name  # as above
        # the modes beyond the lowest 20 take no part that shows: 4e-9 measured
        assert a.cost_excess == b.cost_excess or abs(a.cost_excess - b.cost_excess) < 1e-6 * a.cost_excess, name


def test_cost_excess_against_a_dense_lyapunov_equation() -> None:
    """J(K_hat) and J(K) each by SciPy in absolute coordinates, from the scene's start."""
    _, problem, solution = plant()
    E, A, B, P = matrices()
    gain_check = GainCheck(problem, solution, hand_start(problem, -TARGET))
    C, n_s = outputs_in_papers_order(problem), problem.layout.n_s
    x = np.zeros(len(E))
    x[:n_s] = -TARGET
    tissue = -np.tile(TARGET, problem.layout.n_e // 2)
    x[2 * n_s : 2 * n_s + problem.layout.n_e] = tissue
    optimal = x @ E.T @ P @ E @ x
    assert abs(gain_check.optimal / optimal - 1) < 1e-10  # rounding of P
    assert abs(np.sum((solution.factor.hand[:2].T @ TARGET) ** 2) / optimal - 1) < 1e-10  # rounding of P, as above
    for name, N in (("pod", 12), ("pod_decomposed", 8), ("structured", 6)):
        gain = reduce_riccati(problem, family(name).at(N)).gain
        K = ordered(gain_to_absolute(problem.system, gain.block)).T
        F = np.linalg.solve(E, A + B @ K)
        Y = scipy.linalg.solve_continuous_lyapunov(F.T, -(C.T @ C + K.T @ K))
        excess = x @ Y @ x / optimal - 1
        assert excess > -1e-6  # cancellation, as below
        near = 1e-6 * (1 + excess)  # cancellation in SciPy's numbers
        assert abs(gain_check.quality(gain).cost_excess - excess) < near


def test_structured_basis_needs_no_solution_and_converges() -> None:
    _, problem, solution = plant()
    nothing = Block(np.zeros((4, 0)), np.zeros((2 * problem.layout.n_local, 0)))
    gain_check = GainCheck(problem, solution, hand_start(problem, -TARGET))
    modes = make_family("structured", problem, nothing)
    reports = [gain_check.report(modes.at(N)) for N in (4, 8, 16, 32)]
    errors = [r.error_K for r in reports]
    assert all(r.stable for r in reports)
    assert errors[-1] < 1e-4 < 1e-2 < 1e3 * errors[0]  # measured: 7e-3, 4e-5, 2e-6, 8e-7
    assert errors == sorted(errors, reverse=True)
    m = project_plant(problem, modes.at(8))
    assert close(m.E[4:, 4:], np.eye(4)) < 1e-10  # energy scaling: Phi'M Phi = I
    assert scipy.linalg.eigvals(m.A, m.E).real.max() < 1e-7  # double zero of the hand: sqrt(eps)


def test_energy_scaling_keeps_the_span_and_the_fast_way_agrees_with_the_careful_one() -> None:
    _, problem, _ = plant()
    for name in ("pod", "pod_decomposed", "structured"):
        basis = family(name).at(12)
        scaled = energy_scaled(problem, basis)
        raw, m = project_plant(problem, basis), project_plant(problem, scaled)
        fast, careful = fast_solution(m), solve_reduced(raw)
        assert fast is not None
        T = np.linalg.lstsq(ordered(basis.U), ordered(scaled.U), rcond=None)[0]
        assert close(T @ fast @ T.T, careful) < 1e-7  # condition of the raw matrices, up to 1e6
        assert closed_loop(m, fast).real.max() < 0
        assert same_everywhere(problem.layout.comm, fast)


@pytest.mark.parametrize(("name", "cells"), [("pod_fixed_solid", 2), ("pod_decomposed", 2), ("componentwise_pod", 5)])
def test_what_rounding_alone_solves_is_refused(name: str, cells: int) -> None:
    """Too few columns hide the hand from the outputs; the last digits then decide on a gain of any size."""
    changes = {"tissue": {"cells": [cells, 2 * cells]}, "control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}}
    problem = make_problem(build(make_scene(DAMPED, changes), comm=MPI.COMM_WORLD))
    bases = make_family(name, problem, DenseRiccati().solve(problem).factor)
    with pytest.raises(ControlError, match=r"by rounding alone|not detectable"):
        reduce_riccati(problem, bases.at(6))
    reduced = reduce_riccati(problem, bases.at(8))
    assert closed_loop(reduced.matrices, reduced.P_N).real.max() < 0


def test_weighted_pod_is_refused_when_the_hand_is_light() -> None:
    """W = (E + E')/2 is indefinite for a light hand; scikit-fem's E says the same."""
    _, problem, solution = plant()
    light = replace(problem, system=replace(problem.system, M_hand=1e-3 * np.eye(2)))
    with pytest.raises(ControlError, match=r"W = \(E \+ E'\)/2 is not positive definite"):
        make_family("weighted_pod", light, solution.factor)
    E = matrices()[0].copy()
    assert np.linalg.eigvalsh((E + E.T) / 2)[0] > 0
    E[2:4, 2:4] = 1e-3 * np.eye(2)
    assert np.linalg.eigvalsh((E + E.T) / 2)[0] < 0
    _, two_way, other = plant(two_way=True)
    assert make_family("weighted_pod", two_way, other.factor).largest > 20  # E itself is symmetric there


def test_orders_and_names_are_checked() -> None:
    _, problem, solution = plant()
    with pytest.raises(ControlError, match="basis 'psd' is unknown; choose one of pod, weighted_pod"):
        make_family("psd", problem, solution.factor)
    with pytest.raises(ControlError, match=r"has no order N = 7; choose 4 to .* in steps of 2"):
        family("pod_decomposed").at(7)
    with pytest.raises(ControlError, match="the start is the target"):
        GainCheck(problem, solution, hand_start(problem, [0, 0]))
    gain_check = GainCheck(problem, solution, hand_start(problem, -TARGET))
    nothing = gain_check.report(family("pod_fixed_solid").at(4))  # the hand alone, in absolute coordinates, is not seen
    assert "not detectable" in nothing.reason
    assert not nothing.stable


@pytest.mark.parametrize("two_way", [False, True], ids=["one-way", "two-way"])
def test_certified_abscissa_of_large_scenes(two_way: bool) -> None:
    """Shift-and-invert finds what LAPACK finds, and the bound certifies the optimal gain."""
    _, problem, solution = plant(two_way)
    gain = solution.gain.block
    found = abscissa(problem, Gain.of_block(gain))
    values = GainCheck(problem, solution, hand_start(problem, -TARGET)).loop.poles(gain)
    inside = values[np.abs(values) <= found.radius]
    assert abs(found.value - inside.real.max()) < 1e-7  # tolerance 1e-9 of eigenvalues of size 10
    assert found.stable
    assert abs(found.value - values.real.max()) < 1e-7  # as above
    assert found.bound < 1
    # the true largest gain outside the circle stays below the bound
    space = GainCheck(problem, solution, hand_start(problem, -TARGET)).loop
    k, one = space.gain(gain), np.eye(len(space.A))
    largest = max(
        np.linalg.norm(k @ np.linalg.solve(1j * w * one - space.A, space.B), 2)
        for w in np.geomspace(found.radius, 100 * found.radius, 60)
    )
    assert largest <= found.bound
    for factor in (1e4, -1e4):  # the bound may give up on a stable gain, never the other way round
        loud = Block(gain.hand, factor * gain.tall)
        exact, claim = space.poles(loud).real.max(), abscissa(problem, Gain.of_block(loud))
        assert exact < 0 or not claim.stable, factor
        assert exact > 0 or abs(claim.value - exact) < 1e-6, factor  # an unstable one far out is not searched for
    assert two_way or exact > 0.1  # one-way that one is unstable indeed: 13


def test_what_cannot_be_certified_is_not_called_stable() -> None:
    _, problem, solution = plant()
    none = replace(problem, system=replace(problem.system, damping=type(problem.system.damping)()))
    found = abscissa(none, solution.gain)
    assert not found.stable
    assert "no damping" in found.reason or found.value >= 0
    free = Block(np.zeros((4, 2)), solution.gain.block.tall)
    assert not abscissa(problem, Gain.of_block(free)).stable  # a hand that nothing holds


def test_retuning_equals_projection_at_the_new_material() -> None:
    _, problem, solution = plant()
    material = problem.system.materials[0]
    for name in ("pod", "structured"):
        retuner = Retuner(problem, family(name).at(12))
        for lam, mu in ((50.0, 50.0), (30.0, 20.0), (500.0, 500.0)):
            new = (replace(material, lam=lam, mu=mu),)
            moved = replace(problem, system=problem.system.with_materials(new))
            exact, mine = project_plant(moved, retuner.basis), retuner.at(new)
            assert close(mine.A, exact.A) < 1e-11  # rounding of two sums, and K_ee T + K_es = 0
            assert close(mine.E, exact.E) < 1e-14  # no stiffness in E: the same sums
            P_N = retuner.solve(new)
            direct = reduce_riccati(moved, family(name).at(12)) if (lam, mu) == (50.0, 50.0) else None
            if direct is not None:
                full = full_gain(problem, retuner.basis, P_N)
                assert close(ordered(full.block), ordered(direct.gain.block)) < 1e-8  # same equation
    assert solution.rank > 12


def test_retuning_over_a_box() -> None:
    _, problem, _ = plant()
    material = problem.system.materials[0]
    retuner = Retuner(problem, family("structured").at(12))
    settings = [(replace(material, lam=lam, mu=mu),) for lam, mu in ((50.0, 50.0), (200.0, 100.0))]
    start = hand_start(problem, -TARGET)

    def gain_check(at: Materials) -> GainCheck:
        moved = replace(problem, system=problem.system.with_materials(at))
        return GainCheck(moved, DenseRiccati().solve(moved), start)

    points = [retuned_gain(retuner, at, partial(gain_check, at)) for at in settings]
    assert all(p.stable for p in points)
    assert all(p.error_K < 1e-3 for p in points)  # measured 1e-5 and 3e-5: modes of the reference material
    assert points[0].error_K < points[1].error_K
    assert all(0 <= p.cost_excess < 1e-6 for p in points)  # second order in the error of K
    with pytest.raises(ControlError, match="rho = 2 differs from 1"):
        retuner.at((replace(material, rho=2.0),))
    with pytest.raises(ControlError, match="the body has 1 layers"):
        retuner.at((material, material))


@pytest.mark.slow
def test_bases_of_the_papers_scene_equal_the_dense_definition() -> None:
    """2n = 880, the size of the paper."""
    model = build(make_scene(DAMPED, {"tissue": {"cells": [10, 20]}}), comm=MPI.COMM_WORLD)
    problem = make_problem(model)
    solution = DenseRiccati().solve(problem)
    Z = costates_to_absolute(problem.system, solution.factor)
    layout = problem.layout
    n = layout.n_local
    dense = np.concatenate([Z.hand, gather_rows(layout, Z.tall[:n]), gather_rows(layout, Z.tall[n:])])
    P = dense @ dense.T
    U, s, _ = np.linalg.svd(P)
    V = make_family("pod", problem, solution.factor)
    assert close(V.sigma[0][:40], s[:40]) < 1e-12  # rounding, of the largest
    basis = V.at(8)
    T = problem.system.T
    n_s = layout.n_s
    tall = basis.U.tall + np.concatenate([T @ basis.U.hand[:n_s], T @ basis.U.hand[n_s:]])
    mine = np.concatenate([basis.U.hand, gather_rows(layout, tall[:n]), gather_rows(layout, tall[n:])])
    assert np.linalg.norm(projector(mine) - projector(U[:, :8]), 2) < 1e-6  # eps sigma_1 / gap
