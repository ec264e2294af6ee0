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
