"""A disc pressed into a block against Hertz."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.hertz import HALF_WIDTH, press

pytestmark = pytest.mark.serial


@pytest.mark.parametrize(("order", "widths", "peaks"), [(1, 3e-2, 0.1), (2, 1e-3, 1e-3)])
def test_half_width_and_pressure_are_those_of_hertz(order: int, widths: float, peaks: float, tmp_path: Path) -> None:
    pressed = press(order, HALF_WIDTH / 8, tmp_path)
    width, peak = pressed.errors
    assert pressed.a == pytest.approx(HALF_WIDTH, rel=0.05)
    assert abs(width) < widths, (width, peak)
    assert abs(peak) < peaks, (width, peak)
