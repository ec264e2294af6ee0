"""A rank without tissue unknowns takes part in every command."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from softgrasp.study.shell.doctor import find_mpiexec
from tests.helpers.rank_worker import numbers

ROOT = Path(__file__).parents[3]


@pytest.mark.ranks
@pytest.mark.serial
def test_four_ranks_of_which_one_owns_no_tissue_give_what_one_gives(tmp_path: Path) -> None:
    mpiexec = find_mpiexec()
    if mpiexec is None:
        pytest.skip("no mpiexec")
    command = [mpiexec, "-n", "4", sys.executable, "-m", "tests.helpers.rank_worker", str(tmp_path / "four")]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert run.returncode == 0, run.stderr
    four, one = json.loads(run.stdout), numbers(tmp_path / "one")
    assert four.pop("least") == [0]  # else nothing is tested
    assert one.pop("least") == [10]
    assert four.keys() == one.keys()
    for key, values in one.items():
        assert four[key] == pytest.approx(values, rel=1e-8), key  # rounding, that the least error of a basis enlarges


SMALL = ["--set", "tissue.cells=[2,4]", "--set", "output.frames=2", "--quiet"]
COMMANDS = {
    "simulate": ["paper_forward", *SMALL, "--set", "time.steps=40"],
    "control": ["paper_lqr", *SMALL, "--set", "time.steps=40", "--set", "time.end=4.0", "--set", "control.N=[12]"],
    "effects": ["franka_muscle", *SMALL, "--set", "time.steps=40", "--set", "contact.box=[[0.0,0.06],[0.06,0.12]]",
                "--set", "study.repeats=1"],
}  # fmt: skip
# what the machine, the clock and the number of ranks say, and polishing steps, which rounding decides
OWN = {
    "ranks", "time", "memory_peak_mb", "solver", "command_line", "machine", "versions", "date", "seconds", "time_are",
    "slowest", "noise", "base", "cost", "newton_steps", "time_tick", "builds",
}  # fmt: skip


def plain_numbers(value: object, name: str = "") -> dict[str, float]:
    """Numbers in nested dictionaries and lists by their path, without those of :data:`OWN`."""
    if isinstance(value, dict):
        pairs = [(key, entry) for key, entry in value.items() if key not in OWN]
    elif isinstance(value, list):
        pairs = [(str(i), entry) for i, entry in enumerate(value)]
    else:
        return {name: float(value)} if isinstance(value, (int, float)) else {}
    return {path: number for key, entry in pairs for path, number in plain_numbers(entry, f"{name}/{key}").items()}


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("ranks", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_mesh_of_two_by_four_gives_one_result_on_any_number_of_ranks(name: str, ranks: int, tmp_path: Path) -> None:
    """The whole command with its pictures; rounding is all that may differ."""
    mpiexec = find_mpiexec()
    if mpiexec is None:
        pytest.skip("no mpiexec")
    results = []
    for n in (1, ranks):
        out = tmp_path / str(n)
        command = [mpiexec, "-n", str(n), sys.executable, "-m", "softgrasp.study.cli", name, *COMMANDS[name]]
        run = subprocess.run([*command, "--out", str(out)], cwd=ROOT, capture_output=True, text=True, timeout=900)
        assert run.returncode == 0, run.stderr
        assert len(list(out.glob("*.png"))) > 0
        results.append(plain_numbers(json.loads((out / "result.json").read_text())))
    one, many = results
    assert many.keys() == one.keys()
    for path, number in one.items():
        assert many[path] == pytest.approx(number, rel=1e-6, abs=1e-9), path
