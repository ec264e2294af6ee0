"""How far bounds of outputs lie above the truth: three damped scenes, and what the benchmark counts as below."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from benchmarks import outputs as bench
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.certified.model import CertifiedModel

pytestmark = pytest.mark.serial
SMALL = ("tissue.cells=[4, 8]", "time={steps=150, end=3.0}", "reduction.grid=3")


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """One model for all tests of this file."""
    kept: list[Any] = []
    train = bench.trained

    def trained(name: str, *changes: str) -> Any:
        if not kept:
            kept.append(train(name, *SMALL))
        return kept[0]

    monkeypatch.setattr(bench, "trained", trained)


@pytest.mark.usefixtures("small")
def test_bounds_below_the_truth_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = bench.measure("paper", 3)
    assert sound.below == 0
    assert len(sound.ratios) == 3 * 2  # a point in 2D
    assert 1.0 <= min(sound.ratios) <= sound.median <= sound.most == max(sound.ratios)
    assert sound.plain > 2 * sound.median

    run = CertifiedModel.run

    def flattered(self: CertifiedModel, *arguments: Any, **more: Any) -> CertifiedRun:
        found = run(self, *arguments, **more)
        own = found.certificate.outputs
        outputs = replace(own, values=own.values / (2 * sound.most))
        return replace(found, certificate=replace(found.certificate, outputs=outputs))

    monkeypatch.setattr(CertifiedModel, "run", flattered)
    wrong = bench.measure("paper", 3)
    assert wrong.below == 3
    assert not all(goal.ok for goal in bench.goals_of([wrong]))


@pytest.mark.slow
@pytest.mark.parametrize("name", bench.DAMPED.split(","))
def test_outputs_are_bounded_within_four_times_the_truth(name: str) -> None:
    """Sixty materials of each scene, the median over materials and components."""
    assert [goal.text for goal in bench.goals_of([bench.measure(name, 60)]) if not goal.ok] == []
