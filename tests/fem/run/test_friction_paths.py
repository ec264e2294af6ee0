"""Friction in compiled steps and in those of curved obstacles or machines without a compiler: the same run; rest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.run.contact.friction import FlatFriction
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


def test_friction_of_sticking_nodes_does_no_work_even_by_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its rounding refused the impulse that stops 441 nodes, which swayed at 1e-8 m/s without end."""
    rubbed, finish = list[float](), FlatFriction.finish

    def note(contact: FlatFriction, *arguments: Any) -> None:
        finish(contact, *arguments)
        rubbed.append(float(contact.f.rubbed))

    monkeypatch.setattr(FlatFriction, "finish", note)
    table = "obstacle=[{kind='halfspace', normal=[0, 0, 1], offset=-0.001, friction=0.3}]"
    contact = simulate(build("set_down_3d", ["tissue.cells=[3, 3, 2]", "tissue.order=1", table])).contact
    assert min(rubbed) < -1e-6  # in the landing
    assert rubbed[-1] == 0.0
    assert contact.touching[-1] == 16
