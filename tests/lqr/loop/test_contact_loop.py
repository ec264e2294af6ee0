"""A controller that was designed without obstacles drives the full plant into one."""

from __future__ import annotations

import numpy as np
import pytest

import softgrasp as sg

SCENE = ["tissue.cells=[4, 8]", "effects.reaction=true", "motion.target=[2.0, -1.0]"]
RUN = ["motion.drive='force'", "time={steps=2000, end=40}"]
FLOOR = ["effects.obstacles=true", "obstacle=[{kind='halfspace', normal=[0, 1], offset=-0.95}]"]


@pytest.mark.serial
def test_a_loop_rests_on_the_obstacle_that_its_design_does_not_know() -> None:
    controller = sg.make_controller(sg.design(sg.build("paper_lqr", [*SCENE, "control.loop.rate=50"])), order=8)
    runs = []
    for more in ([], FLOOR):
        controller.reset()
        model = sg.build("paper_lqr", [*SCENE, *RUN, *more])
        runs.append(sg.simulate(model, force=lambda n, t, q, v: controller.step(q, v)))
    free, stopped = runs
    assert free.q_s[-1] == pytest.approx([2.0, -1.0], abs=0.03)  # what is left after 40 s
    assert -0.96 < stopped.q_s[-1, 1] < -0.95 + 0.01  # on the floor, pressed into it by less than a centimetre
    contact = stopped.contact
    assert contact is not None
    assert contact.force[-500:, 0, 1].mean() > 0.01  # the loop pushes on: it misses its target
    assert contact.penetration < 1e-12
    assert stopped.energy_drift < 1e-12
    # momentum: what hand and floor give, less what moves; the tissue is 2 of 22 kg and moves with the hand
    mass, dt = model.system.M_hand[1, 1] + model.system.M_rigid[1, 1], 0.02
    given = dt * (stopped.force[:, 1] + contact.force[:, 0, 1]).sum()
    tissue = float(np.asarray(model.system.G[:, 1] @ np.split(stopped.final, 2)[1]))
    assert given == pytest.approx(mass * stopped.v_s[-1, 1] + tissue, abs=1e-10)  # rounding of 2000 steps
