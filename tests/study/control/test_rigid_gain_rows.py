"""Gains of a control page name load, axis and unit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from softgrasp.study.control.report import _rigid_gain_rows


def test_rows_have_axes_and_units_and_rounding_is_zero() -> None:
    problem: Any = SimpleNamespace(layout=SimpleNamespace(n_s=3, dimension=2))
    displaced = np.array([[-1.0, 2e-8], [1e-9, -2.5], [0.1, 0.0]])
    rows = _rigid_gain_rows(problem, (displaced, 2 * displaced))
    assert rows[0] == ("force along x, body displaced", "-1 N/m in x, 0 N/m in y")
    assert rows[2] == ("torque about z, body displaced", "0.1 N m/m in x, 0 N m/m in y")
    assert rows[4] == ("force along y, body moving", "0 N/(m/s) in x, -5 N/(m/s) in y")
    assert len(rows) == 6
