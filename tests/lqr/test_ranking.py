"""What gains cost on the modes kept, and which of them are examined on the full plant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import softgrasp.lqr.spectrum.divided
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.orders import reduce_gains
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.gap import Course, duality_gaps
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.reduced.bases import A_PRIORI
from softgrasp.lqr.reduced.riccati import GainCheck
from softgrasp.lqr.spectrum.sampled import Sampling
from tests.helpers.loop import CASES, aim, setup
from tests.helpers.riccati import SCENE, hand_start

pytestmark = pytest.mark.ranks(2)


def gains(name: str) -> list[Gain]:
    rng, K = np.random.default_rng(3), setup(name).gain
    return [Gain(K.K_s * (1 + x * rng.standard_normal(K.K_s.shape)), K.K_z, K.K_v) for x in (0.0, 0.05, 0.2)]


@pytest.mark.parametrize("name", list(CASES))
def test_cost_on_the_modes_kept_is_that_of_the_lyapunov_equation(name: str) -> None:
    case = setup(name)
    gain_check = GainCheck(case.problem, case.solution, hand_start(case.problem, list(5 * aim(case))))
    found = gain_check.excesses(gains(name))
    exact = [gain_check.quality(gain).cost_excess for gain in gains(name)]
    assert found[0] < 1e-14  # rounding
    assert found[1:] == pytest.approx(exact[1:], rel=1e-6)  # what is to come after thirty times to settle
    away = Gain(-case.gain.K_s, case.gain.K_z, case.gain.K_v)
    assert gain_check.excesses([away])[0] > 1e6  # grows for all that time


@pytest.mark.parametrize("name", list(CASES))
def test_cost_of_a_sampled_loop_is_that_of_the_full_plant(name: str) -> None:
    """Against runs of the full plant by PETSc, at a rate that shows."""
    case = setup(name)
    start = hand_start(case.problem, list(5 * aim(case)))
    law = Sampling(0.05, 2, 1)
    found = GainCheck(case.problem, case.solution, start, law=law).excesses(gains(name))
    course = Course(start, law.dt, 3000, Actuation(1 / (law.dt * law.every), law.delay))
    ran = [gap.excess for gap in duality_gaps(case.problem, gains(name), course, case.solution)]
    assert min(ran) > 1e-3  # far from the continuous law
    assert found == pytest.approx(ran, rel=1e-2)  # what is to come after five times to settle


def test_the_best_gain_of_a_basis_is_examined_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """278 unknowns, more than are kept whole: few certificates, and the marks that all of them would give."""
    made = design(build(load_scene(SCENE, ["tissue.cells=[8,16]", "control.N=[4,8,12,20]"])))
    check, asked = made.gain_check, list[Any]()
    assert not check.loop.complete
    real = softgrasp.lqr.spectrum.divided.abscissa
    monkeypatch.setattr(
        softgrasp.lqr.spectrum.divided, "abscissa", lambda *arguments: asked.append(1) or real(*arguments)
    )
    bases = reduce_gains(made, [4, 8, 12, 20], names=("pod_decomposed", A_PRIORI))
    assert len(asked) <= 3  # the best of each, and of small order for the controller
    monkeypatch.undo()
    for b in bases:
        best = b.best()
        assert best is not None
        assert b.family is not None
        for r in (r for r in b.reports if not r.reason):
            alone = check.report(b.family.at(r.N))
            assert r.error_K == alone.error_K
            assert r.error_P == alone.error_P
            assert r.ruled_out == (not alone.stable), (b.name, r.N)
            if r.examined:
                assert r.abscissa_full == alone.abscissa_full
        cheapest = min((r for r in b.reports if not r.ruled_out), key=lambda r: r.cost_excess)
        assert best.N == cheapest.N
