"""Friction in compiled steps and in those of curved obstacles or machines without a compiler: the same run."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate


def test_a_compiler_does_not_change_a_run_in_which_a_slipping_node_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """At rest but for rounding, on one side of the threshold in one path alone: an impulse changed the run by 2e-3."""
    scene = [
        "tissue.cells=[3, 4, 1]", "tissue.order=1", "effects.damping={kind='rayleigh', alpha=2.0, beta=0.0}",
        "time.steps=130", "time.end=0.05",
        "obstacle=[{kind='halfspace', normal=[0, 0, 1], offset=-0.001, friction=0.3}]",
    ]  # fmt: skip
    compiled = simulate(build("set_down_3d", scene))
    monkeypatch.setattr("softgrasp.fem.run.contact.step.contact_library", lambda: None)
    general = simulate(build("set_down_3d", scene))
    most = np.abs(compiled.contact.force).max()
    assert np.abs(general.contact.force - compiled.contact.force).max() < 1e-8 * most  # rounding over 130 steps
    assert compiled.contact.rubbed > 1e-3
    assert np.abs(general.final - compiled.final).max() < 1e-8 * np.abs(compiled.final).max()
