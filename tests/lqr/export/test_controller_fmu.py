"""The FMU of a controller under FMPy: against ``Controller.step``, and in a loop with the FMU of the plant."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import softgrasp as sg
from softgrasp.lqr.design.controller import make_controller
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.export.fmu import write_controller_fmu
from softgrasp.reduction.export import write_fmu
from softgrasp.reduction.online import Stepper
from tests.lqr.export.test_controller import controller, planned

fmpy = pytest.importorskip("fmpy", reason="FMPy reads the FMU")
validation, fmi3, calls = (pytest.importorskip(f"fmpy.{name}") for name in ("validation", "fmi3", "fmi1"))

pytestmark = [
    pytest.mark.serial,
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler cc here"),
]


@contextmanager
def opened(file: Path, folder: Path) -> Iterator[tuple[Any, dict[str, int]]]:
    """An instance for co-simulation in its step mode, and its value references by name."""
    about = fmpy.read_model_description(str(file))
    instance = fmi3.FMU3Slave(
        unzipDirectory=fmpy.extract(str(file), str(folder)), guid=about.guid, modelIdentifier="softgrasp",
        instanceName=file.stem,
    )  # fmt: skip
    instance.instantiate()
    instance.enterInitializationMode()
    instance.exitInitializationMode()
    try:
        yield instance, {each.name: each.valueReference for each in about.modelVariables}
    finally:
        instance.terminate()
        instance.freeInstance()


@pytest.mark.parametrize("kind", ["plain", "limited", "late", pytest.param("planned", marks=pytest.mark.slow)])
def test_the_fmu_is_the_controller(kind: str, tmp_path: Path) -> None:
    """Ticks on a hand that moves at random, with the samples of an observer where there is one."""
    robot = deepcopy(planned() if kind == "planned" else controller(kind))
    robot.reset()
    file = write_controller_fmu(robot, tmp_path / "robot.fmu")
    assert validation.validate_fmu(str(file)) == []
    n_s, others = robot.n_s, 0 if robot.observer is None else robot.observer.others
    rng, ticks = np.random.default_rng(2), 40
    q, v = 1e-3 * rng.standard_normal((2, ticks, n_s)).cumsum(axis=1)
    y = 1e-3 * rng.standard_normal((ticks, others))
    with opened(file, tmp_path / "robot") as (instance, names):
        references = list(names.values())
        inputs, outputs = references[1 : 1 + 2 * n_s + others], references[-n_s:]
        assert list(names)[1 : 1 + n_s] == ["hand_q_x", "hand_q_y"]
        assert list(names)[-n_s:] == ["force_x", "force_y"]
        for k in range(ticks):
            instance.setFloat64(inputs, np.concatenate([q[k], v[k], y[k]]).tolist())
            instance.doStep(k * robot.period, robot.period)
            found = np.array(instance.getFloat64(outputs))
            wanted = robot.step(q[k], v[k], None if robot.observer is None else y[k])
            assert np.abs(found - wanted).max() <= 1e-12 * max(np.abs(wanted).max(), 1.0)  # as of the C
        with pytest.raises(calls.FMICallException):
            instance.setFloat64(inputs[:1], [float("nan")])
        with pytest.raises(calls.FMICallException):
            instance.doStep(ticks * robot.period, 0.4 * robot.period)


def test_two_fmus_close_the_loop_of_the_small_plant(tmp_path: Path) -> None:
    """The plant's reduced model and the controller, each in its file, against both in Python."""
    model = sg.build("paper_lqr", ["tissue.cells=[4, 8]", "time.steps=200", "time.end=20.0"])
    rom = sg.reduce(model, sg.simulate(model), "craig_bampton", N=14)
    robot = make_controller(design(model), order=10)
    plant, own = write_fmu(rom, tmp_path / "plant.fmu", robot.period), write_controller_fmu(robot, tmp_path / "own.fmu")
    stepper, n_s = Stepper(rom.at(), robot.period), robot.n_s
    robot.reset()
    system, x = rom.at(), np.zeros(rom.N)
    worst, largest, at = 0.0, 0.0, np.zeros(2 * n_s)
    with opened(plant, tmp_path / "plant") as (body, of_body), opened(own, tmp_path / "own") as (hand, of_hand):
        seen = [name for name in of_hand if name.startswith("hand_")]
        loads = ["force_x", "force_y"]
        for k in range(300):
            t = k * robot.period
            hand.setFloat64([of_hand[n] for n in seen], list(body.getFloat64([of_body[n] for n in seen])))
            hand.doStep(t, robot.period)
            body.setFloat64([of_body[n] for n in loads], list(hand.getFloat64([of_hand[n] for n in loads])))
            body.doStep(t, robot.period)
            stepper(robot.step(at[:n_s], at[n_s:]))
            x = stepper.state
            at = np.concatenate([system.S_q @ x, system.S_v @ x])
            found = np.array(body.getFloat64([of_body[n] for n in seen]))
            worst, largest = max(worst, np.abs(found - at).max()), max(largest, np.abs(at).max())
    assert largest > 0.01  # it moves
    assert worst < 1e-12 * largest  # rounding of 300 ticks
