"""Small dense systems: midpoint steps against the rule as it is written."""

from __future__ import annotations

import numpy as np
import pytest

from softgrasp.fem.errors import SolverError
from softgrasp.fem.reduced import STEPS, MidpointSteps, march_together, midpoint_map

pytestmark = pytest.mark.serial


def random_system(n: int, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    E, A = rng.standard_normal((2, n, n))
    return E @ E.T + np.eye(n), A - 2 * np.sqrt(n) * np.eye(n), rng.standard_normal((n, inputs + 1))


@pytest.mark.parametrize("n", [1, 7, 64, 190])  # 190: one step a product, else eight
def test_steps_follow_the_rule_as_it_is_written(n: int) -> None:
    E, A, loads = random_system(n, 3)
    dt, u, x = 0.05, np.sin(np.arange(63.0)).reshape(21, 3), np.cos(np.arange(float(n)))
    steps = MidpointSteps(dt, E, A, loads)
    assert steps.steps == (1 if n == 190 else STEPS)
    states = steps.march(u, x)
    middle, rate = (states[1:] + states[:-1]) / 2, np.diff(states, axis=0) / dt
    residual = rate @ E.T - middle @ A.T - np.column_stack([u, np.ones(21)]) @ loads.T
    assert np.abs(residual).max() < 1e-10 * np.abs(rate @ E.T).max()  # rounding over dt
    assert (states[0] == x).all()
    two = march_together([steps, MidpointSteps(dt, E, 2 * A, loads)], np.stack([u, u]), x)
    np.testing.assert_allclose(two[0], states, rtol=0, atol=1e-12 * np.abs(states).max())  # another order of sums


def test_a_stack_of_systems_and_a_singular_one() -> None:
    E, A, loads = random_system(5, 2)
    both = midpoint_map(E, np.stack([A, 3 * A]), np.stack([loads, loads]), 0.1)
    np.testing.assert_allclose(both[1], midpoint_map(E, 3 * A, loads, 0.1), rtol=1e-14)  # rounding
    with pytest.raises(SolverError, match=r"singular at dt = 0\.5 s"):
        midpoint_map(np.eye(2), 4 * np.eye(2), np.zeros((2, 1)), 0.5)
