"""Derivatives of full runs on several ranks, with whole, spread and no factors, against differences of the runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.fem.errors import SceneError

pytestmark = pytest.mark.ranks
KEYS = ["tissue.cells=[2, 4]", "time.steps=8", "output.snapshots='none'", "effects.reaction=true", "hand.mass=20"]
DAMPED = "effects.damping={kind='rayleigh', beta=0.004, alpha=0.1, drag='space'}"
STEP = 1e-4  # relative step of central differences: 1e-8 of it truncated, 1e-9 of it rounded
CLOSE = 2e-6
SOLVERS = {
    "whole": ["motion.drive='force'"],
    "spread": ["motion.drive='force'", "time.solver='mumps'", "time.reproducible=false"],
    "led, iterative": ["time.solver='cg'", "time.rtol=1e-11"],
}


@pytest.mark.parametrize("keys", SOLVERS.values(), ids=SOLVERS)
def test_gradients_are_differences_of_runs(keys: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    model = sg.build("paper_forward", [*KEYS, DAMPED, *keys])
    run = sg.simulate(model)

    def loss(y: Any) -> Any:
        return ((y - 0.9 * run.outputs) ** 2).sum() / 2, y - 0.9 * run.outputs

    if len(keys) > 1:  # states in a file of each rank
        monkeypatch.setattr("softgrasp.fem.adjoint.forward.free_memory", lambda: 1)
    found = sg.gradient(model, loss)
    np.testing.assert_allclose(found.run.outputs, run.outputs, rtol=0, atol=1e-10)  # the tolerance of iterative solves
    (m,) = model.system.materials
    keys_of = ("mu", "rho", "beta")
    ends = []
    for share in (1 + STEP, 1 - STEP):  # all at once: one derivative along log(mu) + log(rho) + log(beta)
        other = (replace(m, **{key: share * getattr(m, key) for key in keys_of}),)
        ends.append(loss(sg.simulate(replace(model, system=model.system.with_materials(other))).outputs)[0])
    along = sum(getattr(found, key)[0] * getattr(m, key) for key in keys_of)
    assert along == pytest.approx((ends[0] - ends[1]) / (2 * STEP), rel=CLOSE)
    n_s, n = model.system.layout.n_s, model.system.layout.n_local
    assert found.start.shape == (2 * n_s + 2 * n,)
    comm = model.system.layout.comm
    assert len({part.tobytes() for part in comm.allgather(found.mu)}) == 1


def test_a_loss_that_fails_on_one_rank_fails_on_all(comm: Any) -> None:
    model = sg.build("paper_forward", KEYS)
    with pytest.raises(SceneError, match="the shape"):
        sg.gradient(model, lambda y: (0.0, y[1:]))
    with pytest.raises(ZeroDivisionError):
        sg.gradient(model, lambda y: 1 // comm.rank)  # it runs on rank 0 alone
