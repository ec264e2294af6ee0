"""Samples of the posterior against the covariance of a fit that is nearly linear, and what is refused."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import SceneError
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.posterior import sample

KEYS = ["tissue.cells=[3, 6]", "time.steps=60", "effects.damping={kind='kelvin-voigt', beta=0.003}"]
pytestmark = pytest.mark.serial


def test_samples_agree_with_the_covariance() -> None:
    pytest.importorskip("emcee", reason="emcee is no dependency: pip install 'softgrasp[posterior]'")
    model = sg.build("paper_forward", KEYS)
    run = sg.simulate(model)
    y = run.outputs + np.random.default_rng(3).normal(0, 2e-2, run.outputs.shape)
    data = Measurements("tip", run.times, y)
    found = sg.identify(model, data, "mu,beta", 2e-2, N=10, law="linear", posterior=1500)
    assert found.posterior is not None
    independent = found.posterior.independent
    assert independent > 30
    # a deviation of n samples is known to 1 / sqrt(2 n), a mean to 1 / sqrt(n); 4 of these, and 3 % of curvature
    np.testing.assert_allclose(found.posterior.deviations, found.noise, rtol=0.03 + 4 / np.sqrt(2 * independent))
    assert (np.abs(found.posterior.mean) < (0.1 + 4 / np.sqrt(independent)) * found.noise).all()
    assert abs(found.posterior.correlation[0, 1] - found.correlation[0, 1]) < 4 / np.sqrt(independent)
    assert found.posterior.count == pytest.approx(0.8 * 1500, rel=0.02)


def test_samples_of_a_linear_model_have_its_covariance_where_that_is_thin() -> None:
    """mu and lambda have a correlation of -0.999, as in the tutorial."""
    pytest.importorskip("emcee", reason="emcee is no dependency: pip install 'softgrasp[posterior]'")
    J = np.diag([1 / 5e-4, 1 / 0.13, 1 / 6e-3]) @ np.array([[1.0, 0.088, 0.0], [-0.088, 1.0, 0.0], [0.0, 0.0, 1.0]])
    covariance = np.linalg.inv(J.T @ J)
    assert covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]) < -0.999
    wide = SimpleNamespace(limits=lambda p: (p - 1, p + 1))
    found = sample(SimpleNamespace(k=3, near=wide, residual=lambda x: J @ x), np.zeros(3), covariance, 1000, False)
    noise = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.deviations, noise, rtol=4 / np.sqrt(2 * found.independent))
    assert (np.abs(found.mean) < 4 / np.sqrt(found.independent) * noise).all()
    S = found.correlation * np.outer(found.deviations, found.deviations) + np.outer(found.mean, found.mean)
    # mean square of three normal numbers; 1.69 where the walkers start by the deviations without the correlation
    assert abs(np.trace(J @ S @ J.T) / 3 - 1) < 4 * np.sqrt(2 / 3 / found.independent)


def test_what_cannot_be_sampled_is_refused_before_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    model = sg.build("paper_forward", KEYS)
    with pytest.raises(SceneError, match="--posterior 10: give at least 1000"):
        sg.identify(model, "none.csv", "mu", 1e-2, posterior=10)
    monkeypatch.setitem(sys.modules, "emcee", None)
    with pytest.raises(SceneError, match=r"pip install 'softgrasp\[posterior\]'"):
        sg.identify(model, "none.csv", "mu", 1e-2, posterior=2000)
