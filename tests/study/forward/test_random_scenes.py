"""Random scenes through `simulate`: each ends in a right answer or in one sentence, and leaves nothing half-written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.helpers.random_scenes import run_random

pytestmark = pytest.mark.serial
FIRST = 100_000
COUNT = int(os.environ.get("RANDOM_SCENES", "3000"))  # of the slow test
AT_ONCE = 50  # scenes of one test, which may take five minutes


def defects(seeds: range, folder: Path) -> list[str]:
    """What is wrong, by seed; at least a third of the scenes must have run at all."""
    wrong, answers = [], 0
    for seed in seeds:
        try:
            answers += not run_random(seed, folder / "scene")
        except Exception as error:
            wrong.append(f"{seed}: {type(error).__name__}: {error}")
    assert answers >= len(seeds) / 3
    return wrong


def test_random_scenes_end_well(tmp_path: Path) -> None:
    assert defects(range(FIRST, FIRST + 24), tmp_path) == []


@pytest.mark.slow
@pytest.mark.parametrize("first", range(FIRST, FIRST + COUNT, AT_ONCE))
def test_many_random_scenes_end_well(tmp_path: Path, first: int) -> None:
    assert defects(range(first, min(first + AT_ONCE, FIRST + COUNT)), tmp_path) == []
