"""Reduced tissue beside flex bodies of MuJoCo: a row of each on a coarse mesh, and what counts as a goal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import flex as bench

pytest.importorskip("mujoco", reason="MuJoCo is no dependency: pip install 'softgrasp[mujoco]'")
pytestmark = pytest.mark.serial


def test_reduced_tissue_and_a_flex_follow_the_same_move() -> None:
    hand, exact = bench.reference((2, 2, 4), steps=72)
    model, h = bench.reduced_model((2, 2, 4), bench.POISSON[0]), 1e-2
    mine = bench.motion(bench.Reduced(model, h), h, hand, exact)
    other = bench.motion(bench.Flex("flex, quadratic", (3, 3, 5), bench.POISSON[0], h), h, hand, exact)
    assert mine.error < 2 < other.error < 60, (mine, other)  # the first has the mesh of the full model
    assert model.k == mine.unknowns < other.unknowns == 99
    goals = bench.goals_of(bench.Results([replace(mine, dt=1.0), other], []))
    assert goals[0].ok
    assert goals[0].value == pytest.approx(mine.error / other.error)


def test_sag_is_that_of_the_full_model() -> None:
    exact = bench.at_rest((2, 2, 4), bench.POISSON[0])
    mine = bench.Reduced(bench.reduced_model((2, 2, 4), bench.POISSON[0]), 1e-3).rest()
    flex = bench.Flex("flex, quadratic", (3, 3, 5), bench.POISSON[0], bench.SETTLE, 4 * bench.BETA).rest()
    size = np.linalg.norm(exact)
    assert np.linalg.norm(mine - exact) < 0.02 * size  # what twelve clamped modes leave out
    assert np.linalg.norm(flex - exact) < 0.5 * size  # another element on the same nodes
