"""Markers chosen before measuring: against all choices, against the errors of fits, and what is refused."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.optimal import choose, determinant, deviations
from softgrasp.reduction.identify.suggest import spread_points

KEYS = ["tissue.cells=[4, 8]", "tissue.order=2", "time.steps=80", "effects.damping={kind='kelvin-voigt', beta=0.003}"]


def best_of_all(F: np.ndarray, k: int, count: int) -> float:
    return max(float(determinant(F[list(some)].sum(axis=0), k)) for some in combinations(range(len(F)), count))


@pytest.mark.serial
@pytest.mark.parametrize("nuisances", [0, 1])
def test_choices_are_the_best_of_all(nuisances: int) -> None:
    rng, lost = np.random.default_rng(4), []
    k, m = 3, 3 + nuisances
    for _ in range(40):
        J = rng.standard_normal((9, 5, m)) * rng.lognormal(0, 1.5, (9, 1, m))
        F = np.einsum("cti,ctj->cij", J, J)
        count = int(rng.integers(1, 5))
        chosen = choose(F, k, count)
        assert len(set(chosen)) == count
        lost.append(best_of_all(F, k, count) - float(determinant(F[chosen].sum(axis=0), k)))
    # exchanges end where no single one gains: the best of all in most cases, and never far below (log det)
    assert np.mean(np.array(lost) < 1e-9) > 0.8
    assert max(lost) < 0.5


@pytest.mark.serial
def test_candidates_of_a_body_are_chosen_as_by_exhaustive_search() -> None:
    model = sg.build("paper_forward", KEYS)
    points = np.array([[0, 0], [1, 0], [0.5, 0], [0, 0.5], [1, 1], [0.5, 2.0], [0.5, 1.0]])
    found = sg.suggest_markers(model, "mu,lambda,beta", 1e-3, 2, candidates=points, N=30)
    alone = {}
    for pair in combinations(range(len(points)), 2):  # each pair by itself
        only = sg.suggest_markers(model, "mu,lambda,beta", 1e-3, 2, candidates=points[list(pair)], N=30)
        alone[pair] = only.motions[0]
    best = min(alone, key=lambda pair: np.prod(alone[pair].deviations[-1]))
    assert tuple(sorted(found.motions[0].chosen)) in sorted(alone, key=lambda pair: alone[pair].size)[:2]
    np.testing.assert_allclose(
        found.motions[0].deviations[-1], alone[tuple(sorted(found.motions[0].chosen))].deviations[-1], rtol=1e-8
    )
    assert np.prod(found.motions[0].deviations[-1]) <= 1.2 * np.prod(alone[best].deviations[-1])


@pytest.mark.serial
@pytest.mark.parametrize("beside", [{}, {"offset": True}, {"shift": True}])
def test_errors_are_those_of_a_fit_with_these_markers(beside: dict[str, bool]) -> None:
    model = sg.build("paper_forward", KEYS)
    plan = sg.suggest_markers(model, "mu,beta", 2e-3, 2, N=30, **beside)
    measured = sg.build(plan.scene)
    run = sg.simulate(measured)
    y = run.outputs + np.random.default_rng(1).normal(0, 2e-3, run.outputs.shape)
    found = sg.identify(measured, Measurements("markers", run.times, y), "mu,beta", 2e-3, N=30, **beside)
    # the fit's errors are those at its own values, one or two of these errors away
    np.testing.assert_allclose(found.noise, plan.motions[0].deviations[-1], rtol=0.05)
    assert plan.motions[0].size == pytest.approx(np.linalg.det(found.covariance[:2, :2]) ** (1 / 4), rel=0.05)
    assert [o.name for o in measured.outputs] == ["m1", "m2"]


@pytest.mark.serial
def test_motions_rates_and_what_is_not_seen() -> None:
    model = sg.build("paper_forward", KEYS)
    family = [{"duration": 2.5}, {"duration": 1.0}, {"target": [0.5, 0.3]}]
    found = sg.suggest_markers(model, "mu,beta", 1e-2, 1, motions=family, N=20)
    assert found.motions[0].motion == {"duration": 1.0}
    assert [m.size for m in found.motions] == sorted(m.size for m in found.motions)
    # of two parameters: det of the covariance is at most the product of both variances, equal where nothing correlates
    assert all(m.size < np.sqrt(np.prod(m.deviations[-1])) for m in found.motions)
    best = int(np.argmin(found.motions[0].alone))
    assert (best,) == found.motions[0].chosen
    np.testing.assert_allclose(found.motions[0].by_one[best], found.motions[0].deviations[0], rtol=1e-12)  # the same F
    fast = sg.suggest_markers(model, "mu,beta", 1e-2, 1, motions=family, N=20, rate=4 * 80 / 1.0)
    np.testing.assert_allclose(fast.motions[0].deviations, found.motions[0].deviations / 2, rtol=1e-12)  # 1 / sqrt(4)
    hidden = sg.suggest_markers(model, "mu,lambda,rho", 1e-2, 3, N=20)
    assert not np.isfinite(hidden.motions[0].deviations).any()
    assert all(name in hidden.motions[0].hidden[0] for name in ("mu", "lambda", "rho"))  # all by one factor
    assert deviations(np.diag([4.0, 0.0]), 2).tolist() == [0.5, np.inf]


@pytest.mark.serial
def test_what_does_not_fit_is_refused() -> None:
    model = sg.build("paper_forward", KEYS)
    for words, arguments in {
        "0 markers: choose at least one": ("mu", 1e-3, 0),
        "noise = -1": ("mu", -1.0, 2),
        "the parameters are": ("weight", 1e-3, 2),
    }.items():
        with pytest.raises(SceneError, match=words):
            sg.suggest_markers(model, *arguments)
    with pytest.raises(SceneError, match=r"candidates have the shape \(4, 3\); it must be \(candidates, 2\)"):
        sg.suggest_markers(model, "mu", 1e-3, 1, candidates=np.zeros((4, 3)))
    with pytest.raises(SceneError, match=r"motion \{'duraton': 1\}: motion.duraton"):
        sg.suggest_markers(model, "mu", 1e-3, 1, motions=[{"duraton": 1}])
    with pytest.raises(SceneError, match="rate = 0"):
        sg.suggest_markers(model, "mu", 1e-3, 1, rate=0)


@pytest.mark.ranks
def test_markers_are_those_of_one_rank() -> None:
    model = sg.build("paper_forward", ["tissue.cells=[3, 6]", "time.steps=40"])
    found = sg.suggest_markers(model, "mu,lambda", 1e-3, 2, N=14)
    # of one rank, from this very test; bases of 2 and 3 ranks differ by rounding
    assert found.best.tolist() == BEST
    assert found.motions[0].deviations[-1] == pytest.approx(BARS, rel=1e-6)


@pytest.mark.serial
def test_spread_points_do_not_depend_on_their_order() -> None:
    X = np.random.default_rng(0).random((50, 2)).round(3)
    a = spread_points(X, np.zeros(2), 7)
    np.testing.assert_array_equal(a, spread_points(X[::-1], np.zeros(2), 7))
    gaps = np.linalg.norm(a[:, None] - a[None], axis=2) + 9 * np.eye(7)
    assert gaps.min() > 0.3
    assert len(spread_points(X, np.zeros(2), 99)) == len(np.unique(X, axis=0))


BEST, BARS = [[0.0, 0.0], [1.0, 0.0]], [0.00396233924, 0.0220584665]
