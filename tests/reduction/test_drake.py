"""Midpoint steps of a reduced model by Drake's simulator, where Drake is installed."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.reduced import ReducedSystemError
from tests.helpers.reduced import DAMPED, model_of, small_of

pytestmark = pytest.mark.serial


def test_drake_takes_our_own_steps() -> None:
    """Under a load that changes in the middle of the run."""
    analysis = pytest.importorskip("pydrake.systems.analysis", reason="Drake is not part of `make env`")
    system, dt, half = small_of(model_of(MPI.COMM_SELF, DAMPED)), 0.01, 150
    loads = np.array([[3.0, -1.0], [0.5, 2.0]])
    simulator = analysis.Simulator(system.to_drake(dt))
    plant, context, found = simulator.get_system(), simulator.get_mutable_context(), []
    for i, u in enumerate(loads):
        plant.get_input_port().FixValue(context, u)
        simulator.AdvanceTo((i + 1) * half * dt)
        found.append(plant.get_output_port().Eval(context))
    own = system.midpoint(dt).march(np.repeat(loads, half, axis=0), np.zeros(system.N)) @ system.C.T
    assert abs(np.array(found) - own[[half, 2 * half]]).max() < 1e-12 * abs(own).max()  # rounding of 300 steps


def test_without_drake_there_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pydrake.systems.primitives", None)
    with pytest.raises(ReducedSystemError, match="Drake is not installed; `pip install drake`"):
        small_of(model_of(MPI.COMM_SELF, DAMPED)).to_drake(0.01)
