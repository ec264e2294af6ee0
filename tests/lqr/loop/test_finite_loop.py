"""The linear gain on a plant of finite strain: law, limits, linear limit, gravity, two-way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import total
from softgrasp.lqr.design.feedback import Design, design
from softgrasp.lqr.design.linearise import finite_problem, linearised
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.cost import overshoot
from softgrasp.lqr.loop.full import ClosedLoop, LoopOptions, LoopTrajectory
from softgrasp.lqr.plant.target import hand_target, rest, steady_input
from tests.helpers.models import make_scene

VISCOUS = {"damping": {"kind": "kelvin-voigt", "beta": 0.02}}
FALL = {"gravity": {"g": [1.0, -9.0]}}
STEPS, DT = 60, 0.05
CONTROL = {"outputs": [{"name": "tip", "kind": "node", "point": [0.5, 0.0]}], "Q": 10.0}


def plant(finite: bool = True, **effects: Any) -> Model:
    law = {"finite_strain": {"law": "neo-hooke", "tol": 1e-11}} if finite else {}
    tissue = {"cells": [2, 4]}
    return build(make_scene(tissue=tissue, effects={**VISCOUS, **law, **effects}, control=CONTROL))


def loops(
    model: Model, target: list[float], actuation: Actuation | None = None, dt: float = DT, steps: int = STEPS
) -> tuple[Design, LoopTrajectory, LoopTrajectory, Any]:
    """Design, linear loop, loop of finite strain and its target. Collective."""
    found = design(linearised(model))
    linear = ClosedLoop(found.problem, dt).run(found.gain, target, steps, actuation)
    problem, _ = finite_problem(found.problem, model.system, found.target)
    keep = LoopOptions(snapshots="memory")
    run = ClosedLoop(problem, dt).run(found.gain, target, steps, actuation, rest(model.system), keep)
    return found, linear, run, problem


@pytest.mark.ranks(2)
@pytest.mark.parametrize("effects", [{}, {"reaction": True}, FALL, {**FALL, "reaction": True}], ids=str)
@pytest.mark.parametrize("room", [None, 1.0])
def test_every_step_obeys_law_and_limits(effects: dict[str, Any], room: float | None) -> None:
    """u = clip(u_bar + K (x_mid - x_bar)) from the stored states, though the tissue's force is not linear."""
    model = plant(**effects)
    limit = None if room is None else room + float(np.abs(steady_input(model.system)).max())
    found, _, run, problem = loops(model, [2.0, 1.0], Actuation(limits=limit))
    assert law_missed(found.gain, run, problem, [2.0, 1.0], limit) < 1e-7
    assert (run.saturated > 0) == (limit is not None)
    assert run.newton is not None
    assert abs(run.newton.min_det - 1) > 1e-3


@pytest.mark.ranks
@pytest.mark.parametrize("reaction", [False, True])
def test_divided_steps_obey_the_law_too(reaction: bool) -> None:
    """A move too far for its six steps; all ranks take the same parts."""
    target = [160.0, 80.0]
    found, _, run, problem = loops(plant(reaction=reaction), target, dt=0.5, steps=6)
    assert run.newton is not None
    assert run.newton.substepped > 0
    assert law_missed(found.gain, run, problem, target) < 1e-7  # the parts' load is right to 1e-10


def law_missed(K: Any, run: LoopTrajectory, problem: Any, target: list[float], limit: float | None = None) -> float:
    """Largest difference of the inputs to the law from the stored states, over the largest input it asks for."""
    comm, Z = problem.layout.comm, run.snapshots
    assert Z is not None
    aim = hand_target(problem, np.array(target))
    hand = np.hstack([run.q_s - aim.state.q_s, run.v_s])
    tissue = total(comm, np.vstack([K.K_z, K.K_v]).T @ (Z.Z - np.concatenate([aim.state.z, aim.state.v_z])[:, None]))
    law = aim.u + (hand[1:] + hand[:-1]) @ K.K_s.T / 2 + (tissue[:, 1:] + tissue[:, :-1]).T / 2
    expected = law if limit is None else np.clip(law, -limit, limit)
    return float(np.abs(run.inputs - expected).max() / np.abs(law).max())


@pytest.mark.serial
def test_small_moves_are_those_of_the_linear_plant_and_rest_stays_rest() -> None:
    gaps = []
    for size in (1e-3, 1e-2):
        _, linear, run, _ = loops(plant(), [2.0 * size, size])
        gaps.append(np.abs(run.outputs - linear.outputs).max() / size)
    assert gaps[0] < 1e-3
    assert gaps[1] / gaps[0] == pytest.approx(10, rel=0.1)  # the next term of the force
    _, _, run, _ = loops(plant(**FALL), [0.0, 0.0])
    assert np.abs(run.outputs - run.outputs[0]).max() < 1e-8
    assert run.cost[-1] < 1e-12


@pytest.mark.serial
def test_sampled_law_runs_and_a_wild_gain_is_said_not_to_stabilise() -> None:
    found, linear, run, problem = loops(plant(reaction=True), [1.0, 0.5], Actuation(rate=10.0, delay=True))
    assert np.abs(run.outputs - linear.outputs).max() < 0.05
    wild = replace(found.gain, K_s=-10 * found.gain.K_s)
    with pytest.raises(SolverError):
        ClosedLoop(problem, DT).run(wild, [1.0, 0.5], STEPS, options=LoopOptions(most=1e6))


@pytest.mark.serial
def test_overshoot_is_the_farthest_past_the_target_over_the_way() -> None:
    y = np.array([[0.0, 1.0, 0.0], [2.5, 0.5, 7.0], [2.0, 0.0, 0.0]])
    assert overshoot(y, np.array([2.0, 0.0, 0.0])) == 0.25  # the third output has no way to go
    assert overshoot(y[:1], np.array([2.0, 0.0, 0.0])) == 0.0
