"""Runs that several modules of this folder compare with."""

from __future__ import annotations

import pytest

from softgrasp.fem.scene.file import load_scene
from softgrasp.reduction.replay import FullRun
from tests.helpers.full_runs import PAPER, SMALL, made


@pytest.fixture(scope="module")
def small() -> FullRun:
    return made(load_scene(PAPER, SMALL))


@pytest.fixture(scope="module")
def coarse() -> FullRun:
    return made(load_scene(PAPER, ["tissue.cells=[3,6]", "time.steps=60"]))
