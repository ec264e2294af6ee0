"""Own loads in feedback: the state of rest is that of gravity, whose code is another."""

from __future__ import annotations

import numpy as np
import pytest
import ufl

import softgrasp as sg
from softgrasp.lqr.plant.target import hand_target

TWO_WAY = ["effects.reaction=true", "motion.drive='force'"]


@pytest.mark.ranks
def test_feedback_meets_an_own_load_at_its_equilibrium():
    keys = ["tissue.cells=[4, 8]", *TWO_WAY, "effects.gravity={g=[0.0, 0.0]}", "time.start='equilibrium'"]
    pull = sg.Term("pull", lambda v: (0.3 * v[0] - v[1]) * ufl.dx, 0.2, adds="load")
    own, same = (
        sg.build("paper_lqr", keys, terms=[pull]),
        sg.build("paper_lqr", [*keys, "effects.gravity={g=[0.06, -0.2]}"]),
    )
    targets = [hand_target(sg.problem(model), np.array([1.0, 0.5])) for model in (own, same)]
    for one, two in zip(*((t.state.z, t.u, t.y) for t in targets), strict=True):
        assert np.abs(one - two).max(initial=0.0) < 1e-10
