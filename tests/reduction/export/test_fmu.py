"""The FMU under FMPy: its validator, its simulator with both kinds of solvers, and what must be refused."""

from __future__ import annotations

import re
import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from softgrasp.reduction.export import write_fmu
from softgrasp.reduction.export.affine import AffinePlant, Label, affine_plant
from softgrasp.reduction.export.fmu import CONSTANT, INPUT, OUTPUT, STATE, Face, write_archive
from softgrasp.reduction.online import Stepper
from softgrasp.reduction.system import ModelError
from tests.helpers.exported import MODELS, state_matrices

fmpy = pytest.importorskip("fmpy", reason="FMPy reads the FMU")
validation, fmi3, calls = (pytest.importorskip(f"fmpy.{name}") for name in ("validation", "fmi3", "fmi1"))

pytestmark = [
    pytest.mark.serial,
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler cc here"),
]
TICK = 1e-3


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, AffinePlant]:
    """A damped model under gravity that the hand feels."""
    model = MODELS["gravity"]()
    return write_fmu(model, tmp_path_factory.mktemp("fmu") / "plant.fmu", TICK), affine_plant(model, TICK)


@pytest.fixture
def unpacked(exported: tuple[Path, AffinePlant], tmp_path: Path) -> Path:
    zipfile.ZipFile(exported[0]).extractall(tmp_path)
    return tmp_path


@pytest.fixture
def opened(unpacked: Path) -> Iterator[tuple[Any, list[str]]]:
    """An instance for co-simulation in its step mode, and what it logs."""
    description = fmpy.read_model_description(str(unpacked))
    instance = fmi3.FMU3Slave(
        unzipDirectory=str(unpacked), guid=description.guid, modelIdentifier="softgrasp", instanceName="test"
    )
    logged: list[str] = []
    instance.instantiate(logMessage=lambda _, status, category, text: logged.append(text.decode()))
    instance.enterInitializationMode()
    instance.exitInitializationMode()
    yield instance, logged
    instance.terminate()
    instance.freeInstance()


def test_validators_are_silent(exported: tuple[Path, AffinePlant]) -> None:
    assert validation.validate_fmu(str(exported[0])) == []
    names = set(zipfile.ZipFile(exported[0]).namelist())
    assert {"modelDescription.xml", "binaries/x86_64-linux/softgrasp.so", "sources/fmi3.c", "sources/plant.c"} <= names


def test_functions_are_those_of_the_standard(unpacked: Path) -> None:
    """Against its own headers: every function is there, and none has other arguments."""
    headers = Path(fmpy.__file__).parent / "c-code"
    sources, library = unpacked / "sources", unpacked / "binaries" / "x86_64-linux" / "softgrasp.so"
    command = ["cc", "-std=c99", "-fsyntax-only", "-I", str(headers), "-include", "fmi3Functions.h", "fmi3.c"]
    done = subprocess.run(command, cwd=sources, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    asked = set(re.findall(r"\b(fmi3\w+)TYPE\b", (headers / "fmi3FunctionTypes.h").read_text()))
    exports = subprocess.run(["nm", "-D", "--defined-only", str(library)], check=True, capture_output=True, text=True)
    assert len(asked) > 60
    assert asked - set(exports.stdout.split()) == set()


def test_co_simulation_takes_our_own_steps(exported: tuple[Path, AffinePlant]) -> None:
    """600 ticks, three a communication step, with another material that is set before they begin."""
    path, plant = exported
    model = MODELS["gravity"]()
    other = tuple(replace(m, mu=2.0 * m.mu, lam=0.5 * m.lam, beta=0.5 * m.beta) for m in model.materials)
    t, each = 3 * TICK * np.arange(201), 3
    u = 20 * np.sin(np.outer(t, [3.0, 5.0]))
    columns = [("time", float), *((x.name, float) for x in plant.inputs)]
    signal = np.array([(a, *b) for a, b in zip(t, u, strict=True)], dtype=columns)
    names = [x.name for x in plant.outputs]
    answer = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=t[-1], output_interval=t[1], input=signal, output=names,
        start_values={"mu": other[0].mu, "lambda": other[0].lam, "beta": other[0].beta},
    )  # fmt: skip
    stepper, system, own = Stepper(model.at(other), TICK, plant.d * plant.start), model.at(other), []
    for row in u[:-1]:
        for _ in range(each):
            stepper(row)
        x = stepper.state
        own.append(np.concatenate([system.S_q @ x, system.S_v @ x, system.C @ x]))
    found = np.array([[row[name] for name in names] for row in answer])[1:]
    assert found.shape == (200, len(names))
    assert abs(found - own).max() < 1e-13 * abs(np.array(own)).max()  # rounding of 600 steps


def test_ticks_are_those_of_extended_precision(exported: tuple[Path, AffinePlant]) -> None:
    """3000 ticks with the FMU's own material: our stepper's rounding, of its propagator, is thirty times this."""
    path, plant = exported
    E, A = (X.astype(np.longdouble) for X in state_matrices(plant, plant.theta))
    B, C, f = (X.astype(np.longdouble) for X in (plant.B, plant.C, plant.f))
    t = TICK * np.arange(3001)
    u = 20 * np.sin(np.outer(t, [3.0, 5.0]))
    columns = [("time", float), *((x.name, float) for x in plant.inputs)]
    signal = np.array([(a, *b) for a, b in zip(t, u, strict=True)], dtype=columns)
    names = [x.name for x in plant.outputs]
    answer = fmpy.simulate_fmu(
        str(path), fmi_type="CoSimulation", stop_time=t[-1], output_interval=TICK, input=signal, output=names
    )
    found = np.array([[row[name] for name in names] for row in answer])[1:]
    S, w, exact = E - TICK / 2 * A, plant.start.astype(np.longdouble), []
    lu = scipy.linalg.lu_factor(S.astype(float))
    for row in u[:-1]:
        r, change = A @ w + B @ row.astype(np.longdouble) + f, np.zeros(len(w), np.longdouble)
        for _ in range(3):  # refined to the digits of extended precision
            change += scipy.linalg.lu_solve(lu, (r - S @ change).astype(float))
        w = w + TICK * change
        exact.append(C @ w)
    size = np.abs(exact).max(axis=0)
    assert (np.abs(found - exact).max(axis=0) < 2e-14 * size).all()  # sums of N products, 3000 times


def test_model_exchange_is_the_equation(exported: tuple[Path, AffinePlant]) -> None:
    """CVode against the exponential of w' = A w + B u + f under a constant load."""
    path, plant = exported
    u = np.array([3.0, -2.0])
    E, A = state_matrices(plant, plant.theta)
    N, load = plant.N, plant.B @ u + plant.f
    flow = scipy.linalg.expm(np.block([[A, load[:, None]], [np.zeros((1, N + 1))]]))
    exact = plant.C @ (flow @ np.append(plant.start, 1.0))[:N]
    assert np.array_equal(E, np.eye(N))
    names = [x.name for x in plant.outputs]
    answer = fmpy.simulate_fmu(
        str(path), fmi_type="ModelExchange", solver="CVode", relative_tolerance=1e-9, stop_time=1.0, output=names,
        start_values={x.name: value for x, value in zip(plant.inputs, u, strict=True)},
    )  # fmt: skip
    found = np.array([answer[-1][name] for name in names])
    assert abs(found - exact).max() < 1e-6 * abs(exact).max()  # a thousand times the tolerance of a step


def refused(call: Any, logged: list[str]) -> str:
    """The sentence with which a call is refused."""
    with pytest.raises(calls.FMICallException) as caught:
        call()
    assert caught.value.status == 3  # fmi3Error
    return logged[-1]


def test_bad_calls_end_in_a_sentence(opened: tuple[Any, list[str]]) -> None:
    """Numbers that are not finite, steps between ticks, no material, unknown references: nothing changes."""
    instance, logged = opened
    states = list(range(STATE, STATE + 14))
    before = instance.getFloat64(states)
    for value in (np.nan, np.inf):
        assert "not a finite number" in refused(lambda v=value: instance.setFloat64([INPUT], [v]), logged)
    assert "no multiple of the tick" in refused(lambda: instance.doStep(0.0, 1.5 * TICK), logged)
    assert "whole number of ticks" in refused(lambda: instance.doStep(0.0, 0.0), logged)
    assert "does not begin where the last one ended" in refused(lambda: instance.doStep(0.5, TICK), logged)
    assert "of nothing" in refused(lambda: instance.getFloat64([77]), logged)
    assert "can be set" in refused(lambda: instance.setFloat64([OUTPUT], [1.0]), logged)
    mu = instance.getFloat64([CONSTANT])[0]
    instance.setFloat64([CONSTANT], [-1.0])
    assert "no elastic material" in refused(lambda: instance.doStep(0.0, TICK), logged)
    assert instance.getFloat64(states) == before
    instance.setFloat64([CONSTANT], [mu])
    instance.doStep(0.0, TICK)
    assert instance.getFloat64(states) != before


def test_a_foreign_token_makes_no_instance(unpacked: Path) -> None:
    logged: list[str] = []
    other = fmi3.FMU3Slave(unzipDirectory=str(unpacked), guid="{other}", modelIdentifier="softgrasp", instanceName="x")
    with pytest.raises(Exception, match="Failed to instantiate"):
        other.instantiate(logMessage=lambda _, status, category, text: logged.append(text.decode()))
    assert logged == ["no instance: the token is not that of modelDescription.xml, or the memory is full"]


def test_a_state_comes_back_bit_for_bit(opened: tuple[Any, list[str]]) -> None:
    """With its time, load and material."""
    instance, _ = opened
    everything = [0, INPUT, INPUT + 1, CONSTANT, *range(STATE, STATE + 14)]

    def march(first: float) -> list[float]:
        instance.setFloat64([INPUT], [5.0])
        for k in range(20):
            instance.doStep(first + k * TICK, TICK)
        return list(instance.getFloat64(everything))

    march(0.0)
    kept = instance.getFMUState()
    once = march(20 * TICK)
    instance.setFloat64([CONSTANT], [7.0])
    march(40 * TICK)
    instance.setFMUState(kept)
    assert march(20 * TICK) == once
    instance.freeFMUState(kept)
    instance.reset()
    assert instance.getFloat64([0, INPUT]) == [0.0, 0.0]


MAIN = r"""
#include "fmi3.c"
#include <stdio.h>
int main(void) {
    fmi3ValueReference in = INPUT, out = OUTPUT;
    double u = 3, y, last;
    bool a, b, d;
    fmi3FMUState kept = NULL;
    for (int exchange = 0; exchange < 2; ++exchange) {
        fmi3Instance c = exchange ? fmi3InstantiateModelExchange("a", TOKEN, 0, 0, 0, 0, 0)
                                  : fmi3InstantiateCoSimulation("a", TOKEN, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0);
        double w[SG_PLANT_N];
        if (fmi3EnterInitializationMode(c, 0, 0, 0, 0, 0) || fmi3ExitInitializationMode(c)) return 1;
        if (fmi3SetFloat64(c, &in, 1, &u, 1) || fmi3GetFMUState(c, &kept)) return 2;
        if (!exchange && fmi3DoStep(c, 0, 100 * SG_PLANT_TICK, 1, &a, &b, &d, &last)) return 3;
        if (exchange && fmi3GetContinuousStateDerivatives(c, w, SG_PLANT_N)) return 4;
        if (fmi3SetFMUState(c, kept) || fmi3FreeFMUState(c, &kept) || fmi3GetFloat64(c, &out, 1, &y, 1)) return 5;
        fmi3FreeInstance(c);
    }
    return 0;
}
"""


def test_sanitizers_are_silent(unpacked: Path) -> None:
    """Addresses, leaks and undefined behaviour; all warnings are errors."""
    folder = unpacked / "sources"
    (folder / "main.c").write_text(MAIN)
    flags = [
        "-std=c99",
        "-g",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
    ]
    subprocess.run(["cc", *flags, "main.c", "plant.c", "-o", "main"], cwd=folder, check=True)
    done = subprocess.run(["./main"], cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["time", "w_1", "der_w_2"])
def test_two_variables_of_one_name_are_refused(tmp_path: Path, name: str) -> None:
    """An own parameter may be called like what every FMU has; FMI asks for names that differ."""
    face = Face("a plant", 1e-3, (), (), ((0, Label(name, ""), 1.0),), (0.0, 0.0))
    with pytest.raises(ModelError, match=f"two variables of the FMU are called {name}; rename the output or the own"):
        write_archive(tmp_path / "plant.fmu", {}, face)
    assert not list(tmp_path.iterdir())


def test_no_compiler_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = MODELS["undamped"]()
    monkeypatch.setenv("CC", "false")
    with pytest.raises(ModelError, match="false cannot compile the FMU"):
        write_fmu(model, tmp_path / "plant.fmu")
    monkeypatch.delenv("CC")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ModelError, match="there is no C compiler here"):
        write_fmu(model, tmp_path / "plant.fmu")
    assert list(tmp_path.iterdir()) == []
