"""The C of a controller against ``Controller.step``: with and without an observer, limits, late and lost samples."""

from __future__ import annotations

import locale
import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.constrained import plan_control
from softgrasp.lqr.design.controller import make_controller
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.observer import observe
from softgrasp.lqr.export.controller import write_controller
from softgrasp.lqr.loop.controller import Controller

pytestmark = [
    pytest.mark.serial,
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler cc here"),
]
BUILTIN = {"U", "memcpy", "memset", "memmove", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}
SAMPLES = "markers=[[0,0],[1,0],[0,1],[1,1]],noise={speed=0.01},delay=2"
PLANNED = ("tissue.cells=[2,4]", "control.loop.rate=20", "control.constraints.parts=2", "control.constraints.N=14")
OBSERVER = f"control.observer={{{SAMPLES},disturbance={{box=[[0,0],[1,0]]}}}}"


@cache
def controller(kind: str) -> Controller:
    observed = kind == "late"
    model = build(load_scene("paper_lqr", ["tissue.cells=[2,4]", *[OBSERVER] * observed]), comm=MPI.COMM_SELF)
    made = design(model)
    if observed:
        return observe(made, Stopwatch(MPI.COMM_SELF)).controller
    plain = make_controller(made, order=10)
    if kind == "limited":  # one axis, far below what the gain asks for
        return replace(plain, limits=np.array([0.5, np.inf]))
    if kind == "hand alone":
        plant = plain.plant
        cut = {"E": plant.E[:4, :4], "A": plant.A[:4, :4], "B": plant.B[:4], "C": plant.C[:, :4], "f": plant.f[:4]}
        hand = replace(plant, **cut, S_q=plant.S_q[:, :4], S_v=plant.S_v[:, :4])
        return replace(plain, K=plain.K[:, :4], x_bar=plain.x_bar[:4], plant=hand)
    assert observed or kind == "plain"
    return plain


@cache
def planned(*changes: str) -> Controller:
    """With the plan of the paper's scene past a wall and a disc, which is made again every second."""
    model = build(load_scene("paper_obstacle", [*PLANNED, *changes]), comm=MPI.COMM_SELF)
    made, watch = design(model), Stopwatch(MPI.COMM_SELF)
    observed = observe(made, watch) if made.model.scene.control.observer is not None else None
    found = plan_control(made, watch, observed=observed)
    assert found.online is not None, found.reason
    return found.online.controller


def make(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", "-C", str(folder), *words], capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("kind", ["plain", "limited", "hand alone", "late"])
def test_c_gives_our_own_loads(kind: str, tmp_path: Path) -> None:
    """Silent with all warnings as errors and with the sanitizers; a hand that is not measured is withstood."""
    own = controller(kind)
    write_controller(own, tmp_path)
    done = make(tmp_path, "test")
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    found = re.findall(
        r"400 ticks: .* load (\S+), allowed 1e-12; (\d) with lost samples, 0 held; .* withstood", done.stdout
    )
    assert len(found) == 2
    assert all(float(digits) <= 1e-12 for digits, _ in found)
    assert {lost for _, lost in found} == {"2" if kind == "late" else "0"}
    if kind == "limited":
        loads = [line.split()[-2:] for line in (tmp_path / "golden.log").read_text().splitlines() if "tick" in line]
        assert max(abs(float.fromhex(x)) for x, _ in loads) == 0.5


@pytest.mark.skipif(shutil.which("localedef") is None, reason="there is no program here that makes a locale")
def test_a_decimal_comma_changes_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "locales").mkdir()
    words = ["localedef", "-i", "de_DE", "-f", "UTF-8", "--no-archive", str(tmp_path / "locales" / "de_DE.UTF-8")]
    if subprocess.run(words, capture_output=True).returncode:
        pytest.skip("the description of the locale de_DE is missing here")
    write_controller(controller("plain"), tmp_path / "point")
    monkeypatch.setenv("LOCPATH", str(tmp_path / "locales"))
    before = locale.setlocale(locale.LC_ALL)
    try:
        locale.setlocale(locale.LC_ALL, "de_DE.UTF-8")
        assert f"{1.5:n}" == "1,5"
        write_controller(controller("plain"), tmp_path / "comma")
    finally:
        locale.setlocale(locale.LC_ALL, before)
    files = sorted(path.name for path in (tmp_path / "point").iterdir())
    assert len(files) > 3
    assert all((tmp_path / "point" / name).read_bytes() == (tmp_path / "comma" / name).read_bytes() for name in files)


def outcomes(text: str) -> list[float]:
    """Relative differences that a log of plans leaves in C, whose outcomes must be the same."""
    found = re.findall(r"ticks: .* load (\S+), allowed 1e-12; .* 0 held; .* withstood\n\d+ plans, .* the same", text)
    return [float(digits) for digits in found]


def test_c_makes_our_own_plans(tmp_path: Path) -> None:
    """New, kept and soft ones, from states near the way and after pushes, and ticks over the second plan."""
    own = planned()
    write_controller(own, tmp_path)
    log = (tmp_path / "golden.log").read_text().splitlines()
    counts = [float.fromhex(word) for word in log[-1].split()[1:]]
    assert counts[0] >= 5
    assert counts[2] >= 1
    done = make(tmp_path, "test")
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert len(outcomes(done.stdout)) == 2
    assert max(outcomes(done.stdout)) <= 1e-12


def test_the_test_finds_a_plan_that_differs(tmp_path: Path) -> None:
    """One right-hand side off by a micrometre."""
    own = planned()
    assert own.planner is not None
    free = own.planner.free.copy()
    free[own.planner.obstacle >= 0] -= 1e-6
    write_controller(replace(own, planner=replace(own.planner, free=free)), tmp_path)
    text = (tmp_path / "controller_data.h").read_text()
    write_controller(own, tmp_path)
    (tmp_path / "controller_data.h").write_text(text)
    assert make(tmp_path, "test_controller").returncode == 0
    done = subprocess.run(["./test_controller", "golden.log"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        ("control.constraints.jump=1.5", "obstacle=[{kind='halfspace', normal=[-1, 0], offset=-6.05}]"),
        ("control.loop.rate=1000", "tissue.cells=[4, 8]", "control.constraints.parts=8",
         "control.observer={markers=[[0,0],[1,0],[0,1],[1,1]],delay=2,"
         "disturbance={hand=2e-4,load=5e-4,box=[[0,0],[1,0]]}}"),
    ],
    ids=["jumps", "observer"],
)  # fmt: skip
def test_a_million_ticks_with_plans_pass(changes: tuple[str, ...], tmp_path: Path) -> None:
    """No program reaches its limit of steps, and every plan is new or the last one."""
    write_controller(planned(*changes), tmp_path)
    done = make(tmp_path, "test")
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert max(outcomes(done.stdout)) <= 1e-12
    subprocess.run(["cc", "-std=c99", "-O3", "-c", "controller.c"], cwd=tmp_path, check=True)
    names = subprocess.run(["nm", "-u", "controller.o"], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert set(names.stdout.split()) <= BUILTIN
    done = make(tmp_path, "time")
    assert done.returncode == 0, done.stderr
    found = re.search(r"(\d+) plans: (\d+) new, (\d+) kept, 0 soft, 0 at the limit of steps; 0 held", done.stdout)
    assert found, done.stdout
    assert int(found[2]) > 0.9 * int(found[1])


def test_the_test_finds_a_wrong_digit(tmp_path: Path) -> None:
    """One entry of the gain off by 1e-9 of itself."""
    own = controller("plain")
    wrong = own.K.copy()
    wrong[0, 0] *= 1 + 1e-9
    write_controller(replace(own, K=wrong, u_bar=own.u_bar + (wrong - own.K) @ own.x_bar), tmp_path)
    text = (tmp_path / "controller_data.h").read_text()
    write_controller(own, tmp_path)
    (tmp_path / "controller_data.h").write_text(text)
    assert make(tmp_path, "test_controller").returncode == 0
    done = subprocess.run(["./test_controller", "golden.log"], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, "bad samples withstood" in done.stdout) == (1, True)


def test_nothing_is_called_and_a_million_ticks_pass(tmp_path: Path) -> None:
    write_controller(controller("late"), tmp_path)
    subprocess.run(["cc", "-std=c99", "-O3", "-c", "controller.c"], cwd=tmp_path, check=True)
    names = subprocess.run(["nm", "-u", "controller.o"], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert set(names.stdout.split()) <= BUILTIN
    done: Any = make(tmp_path, "time")
    assert done.returncode == 0, done.stderr
    assert re.search(r"N = \d+: a tick takes .*; 0 held", done.stdout)


def test_arithmetic_that_removes_tests_for_nan_is_refused(tmp_path: Path) -> None:
    write_controller(controller("plain"), tmp_path)
    for flag in ("-Ofast", "-ffast-math"):
        made = subprocess.run(["cc", flag, "-c", "controller.c"], cwd=tmp_path, capture_output=True, text=True)
        assert made.returncode != 0
        assert "compile without -ffast-math" in made.stderr
