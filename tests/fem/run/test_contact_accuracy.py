"""Contact against exact solutions: a bar that a wall hits, order in time while nodes stay pressed, many nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate

HELD = ["effects.obstacles=true", "motion={profile='hold'}", "control=false", "contact={sides=['top'], box=false}"]


def bar(n: int) -> tuple[float, float, Any]:
    """Errors of pressure and displacement of a bar of n cells, held at the top, that a wall hits from below.

    With E = rho = L = 1 a front of the pressure rho c V runs upwards, u = V (t - t_0 - y / c) behind it, until it comes
    back at t_0 + 2.
    """
    speed, gap, end = 0.01, 0.01 / 3, 2.1
    steps = round(2 * n * end)  # half a cell a step
    wall = f"obstacle=[{{kind='box', lo=[-1, -1], hi=[1, {-gap}], path={{velocity=[0, {speed}]}}}}]"
    result = simulate(build("paper_forward", [
        *HELD, wall, "tissue.size=[0.05, 1.0]", f"tissue.cells=[1, {n}]", f"time={{steps={steps}, end={end}}}",
        "tissue.material={young=1.0, poisson=0.0, rho=1.0}", "effects.damping=false", "effects.gravity=false",
    ]))  # fmt: skip
    middles = (np.arange(steps) + 0.5) * end / steps
    exact = np.where(middles > gap / speed, speed, 0.0)
    pressure = result.contact.force[:, 0, 1] / 0.05
    tip = result.outputs[:, 1] - result.outputs[0, 1]  # at the bottom: it goes with the wall
    moved = np.maximum(0.0, speed * result.times - gap)
    return np.abs(pressure - exact).mean() / speed, np.abs(tip - moved).max() / (speed * end), result


def test_a_bar_that_a_wall_hits_takes_the_pressure_of_the_wave() -> None:
    cells = (10, 40, 160)  # the wall comes at the same share of a step
    pressures, ways, results = zip(*(bar(n) for n in cells), strict=True)
    # a node's mass that stops is of order 1, a front that is spread over more and more cells of order 1/2 to 1
    order = np.polyfit(np.log(cells), -np.log(pressures), 1)[0]
    assert 0.6 < order < 1.0, (order, pressures)  # measured 0.78
    assert pressures[-1] < 1e-2
    assert max(ways) < 1e-12  # pressed from the first step of touch on, without a rebound
    for result in results:
        assert result.energy_drift < 1e-12  # rounding of 700 steps
        assert result.contact.penetration < 1e-14


def test_steps_are_of_second_order_while_nodes_stay_pressed() -> None:
    """A block that rests on a table at the start is pressed by its hand and let go by as much."""
    ends = []
    for steps in (40, 80, 160, 640):
        result = simulate(build("paper_forward", [
            "tissue.cells=[4, 8]", "effects.obstacles=true", "control=false", "effects.gravity={g=[0, -5]}",
            "obstacle=[{kind='halfspace', normal=[0, 1], offset=0.01}]", "time.start='equilibrium'",
            "effects.damping={kind='kelvin-voigt', beta=0.02}", "motion={target=[0.0, -0.02], duration=1.0}",
            f"time={{steps={steps}, end=1.0, start='equilibrium'}}",
        ]))  # fmt: skip
        assert result.contact.touching.min() == result.contact.touching.max() == 5
        ends.append(np.split(result.final, 2)[0])
    errors = np.array([np.abs(z - ends[-1]).max() for z in ends[:-1]])
    orders = np.log2(errors[:-1] / errors[1:])
    assert ((orders > 1.9) & (orders < 2.15)).all(), orders  # 2, and 1/15 of an error left in the finest run


@pytest.mark.parametrize("steps", [pytest.param(4000, marks=pytest.mark.slow), 400, 40, 4])
def test_contact_never_adds_energy_from_short_to_long_steps(steps: int) -> None:
    """Courant numbers of 0.01 to 10 for waves of 12 m/s over cells of a quarter."""
    end = 0.8
    result = simulate(build("paper_forward", [
        "tissue.cells=[4, 8]", "motion={profile='hold'}", "control=false", "effects.obstacles=true",
        "effects.gravity={g=[0, -5]}", "obstacle=[{kind='halfspace', normal=[0, 1], offset=-0.03}]",
        "effects.damping=false", f"time={{steps={steps}, end={end}}}",
    ]))  # fmt: skip
    contact = result.contact
    assert contact.touching.max() > 0
    assert contact.touch >= 0
    assert contact.stopped >= 0
    assert result.energy_drift < 1e-12  # that of the issue
    assert contact.penetration < 1e-13


@pytest.mark.slow
def test_a_thousand_nodes_touch() -> None:
    result = simulate(build("paper_forward", [
        *HELD, "tissue.size=[50.0, 0.5]", "tissue.cells=[1000, 10]", "effects.gravity={g=[0, -5]}",
        "obstacle=[{kind='halfspace', normal=[0, 1], offset=-0.002}]", "time={steps=60, end=0.3}",
        "effects.damping={kind='kelvin-voigt', beta=0.002}",
    ]))  # fmt: skip
    assert result.contact.touching.max() == 1001
    assert result.energy_drift < 1e-12
    assert result.contact.penetration < 1e-12
