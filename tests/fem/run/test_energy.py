"""The energy over time of a run is that of its states, whole or resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import Paused
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from tests.helpers.models import make_scene

pytestmark = pytest.mark.ranks

DAMPED = {"damping": {"kind": "rayleigh", "beta": 0.01, "alpha": 0.1}}
KINDS: dict[str, dict[str, Any]] = {
    "undamped": {},
    "damped": {"time": {"steps": 40, "start": "equilibrium"}, "effects": {"gravity": [0.0, -9.81], **DAMPED}},
    "two-way": {"effects": {"reaction": True, **DAMPED}},
    "by cg": {"effects": DAMPED, "time": {"steps": 40, "solver": "cg"}},
    "finite strain": {"effects": {"finite_strain": {}, **DAMPED}},
    "contact": {
        "effects": {"obstacles": True, **DAMPED},
        "obstacle": [{"name": "table", "kind": "halfspace", "normal": [0.0, 1.0], "offset": -0.05}],
        "motion": {"target": [0.3, -0.15]},
    },
}


@pytest.mark.ranks(kind=("damped", "two-way", "finite strain", "contact"))
@pytest.mark.parametrize("kind", KINDS)
def test_energy_is_that_of_the_states(kind: str, comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    """By the step's own sum of potential and momentum at every frame; those of linear steps by K and M too."""
    scene = make_scene(**{"tissue": {"cells": [3, 6]}, "time": {"steps": 40}, "output": {"frames": 10}, **KINDS[kind]})
    model, seen = build(scene, comm=comm), {}

    def look(run: Run) -> None:
        seen[run.reached] = run.midpoint.energy(run.state)

    run = simulate(model, RunOptions(mpi_tmp_path, frame=look))
    size = max(np.abs(run.energy).max(), run.dissipated[-1])
    # both sums round in every step; the drift of these 40 steps is some 1e-14
    np.testing.assert_allclose(run.energy[list(seen)], list(seen.values()), rtol=0, atol=1e-12 * size)
    assert len(seen) == 11
    assert size > 0
    assert (np.diff(run.dissipated) >= -1e-14 * size).all()  # rounding: damping takes and never gives
    assert (run.dissipated[-1] > 0) == bool(model.system.damping.active)
    if kind == "finite strain":
        return
    assert run.snapshots is not None
    z, v = np.split(np.asfortranarray(run.snapshots.Z), 2)
    twice = sum((x * times_columns(A, x)).sum(axis=0) for x, A in ((z, model.system.K_ee), (v, model.system.M_ee)))
    exact = total(comm, twice) / 2
    np.testing.assert_allclose(run.energy[run.snapshots.steps], exact, rtol=0, atol=1e-11 * size)  # as above, by norms


def test_a_resumed_run_has_the_energies_of_the_whole_one(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    scene = make_scene(tissue={"cells": [3, 6]}, time={"steps": 12}, effects=DAMPED)
    whole = simulate(build(scene, comm=comm), RunOptions(mpi_tmp_path))
    with pytest.raises(Paused):
        simulate(build(scene, comm=comm), RunOptions(mpi_tmp_path, until=5))
    rest = simulate(build(scene, comm=comm), RunOptions(mpi_tmp_path, resume=True))
    np.testing.assert_array_equal(rest.energy, whole.energy)
    np.testing.assert_array_equal(rest.dissipated, whole.dissipated)
