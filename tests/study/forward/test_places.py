"""A result names the places of its outputs."""

from __future__ import annotations

import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.study.forward.result import simulate_result
from tests.helpers.models import make_scene

pytestmark = pytest.mark.ranks


def test_a_result_says_where_its_outputs_are(comm: MPI.Intracomm) -> None:
    model = build(make_scene(time={"steps": 3}), comm=comm)
    places = simulate_result(model, simulate(model)).places
    assert places == {"tip": "node (0, 0), one of the 2 free ones farthest from the hand"}
