"""A subtree of the factor on each rank: against dense solves, and whole runs against those with a factor on each."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve import costs, subtrees
from softgrasp.fem.solve.cholesky import OrderedFactor
from softgrasp.fem.solve.solvers import make_solver
from softgrasp.fem.solve.subtrees import SplitFactor
from tests.helpers.models import LAYERS, close, gather_matrix, gather_rows, local_rows, make_scene

pytestmark = [
    pytest.mark.ranks,
    pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="one rank has no separator"),
]
SCENES: dict[str, dict[str, Any]] = {"p1": {"cells": [9, 17]}, "p2": {"cells": [4, 8], "order": 2}}
EFFECTS: dict[str, dict[str, Any]] = {
    "bare": {},
    "everything": {
        "gravity": {"g": [1.0, -9.0], "hand_weight": True},
        "damping": {"kind": "rayleigh", "alpha": 0.4, "beta": 0.01},
        "reaction": True,
    },
    "layered damping": {"damping": {"kind": "kelvin-voigt", "beta": 0.01}},
}


@pytest.mark.parametrize("name", SCENES)
def test_solves_agree_with_a_dense_solve(comm: MPI.Intracomm, name: str) -> None:
    system = build(make_scene({"tissue": SCENES[name]}), comm=comm).system
    layout, S = system.layout, midpoint_matrix(system, 0.01)
    dense = gather_matrix(layout, S).toarray()
    solver = make_solver(S, "cholesky", layout, "test_", subtrees=True)
    assert isinstance(solver.factor, SplitFactor)
    r, w = S.createVecs()
    for seed in (1, 2):  # the second one finds used vectors
        full = np.random.default_rng(seed).standard_normal(layout.n_e)
        r.array_w[:] = local_rows(layout, full)
        solver.solve(r, w)
        assert close(gather_rows(layout, w.array_r), np.linalg.solve(dense, full)) < 1e-12  # condition about 1e2
        assert solver.residual(r, w) < 1e-13  # as above
    solver.destroy()


def test_where_a_rank_has_nothing_to_eliminate_each_has_the_whole_factor(comm: MPI.Intracomm) -> None:
    system = build(make_scene({"tissue": {"cells": [1, 2]}}), comm=comm).system
    layout, S = system.layout, midpoint_matrix(system, 0.01)
    dense = gather_matrix(layout, S).toarray()
    solver = make_solver(S, "cholesky", layout, "test_", subtrees=True)
    assert isinstance(solver.factor, OrderedFactor)
    r, w = S.createVecs()
    full = np.ones(layout.n_e)
    r.array_w[:] = local_rows(layout, full)
    solver.solve(r, w)
    assert close(gather_rows(layout, w.array_r), np.linalg.solve(dense, full)) < 1e-12  # as above
    solver.destroy()


def test_each_rank_has_the_entries_of_its_part(comm: MPI.Intracomm) -> None:
    system = build(make_scene({"tissue": {"cells": [20, 40]}}), comm=comm).system
    whole, split = (
        make_solver(midpoint_matrix(system, 0.01), "cholesky", system.layout, "test_", subtrees=some)
        for some in (False, True)
    )
    share = max(comm.allgather(split.entries)) / whole.entries
    assert share < 0.65  # 0.57 on two ranks, 0.48 on three: the separator has 24 and 52 of 840 nodes
    whole.destroy()
    split.destroy()


@pytest.mark.parametrize("case", EFFECTS)
def test_a_run_is_the_one_with_a_factor_on_each_rank(
    comm: MPI.Intracomm, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And has the same bits in each run."""
    motion = {"motion": {"drive": "force"}} if case == "everything" else {}
    tissue = {"tissue": {"cells": [6, 12]} if case == "bare" else {"layers": LAYERS}}
    model = build(make_scene(tissue, motion, effects=EFFECTS[case], time={"steps": 20}), comm=comm)
    a = simulate(model)
    monkeypatch.setattr(costs, "SUBTREES_FROM", 0)
    b, again = simulate(model), simulate(model)
    assert b.solver.name == a.solver.name == "cholesky"
    assert np.array_equal(b.outputs, again.outputs)
    assert np.array_equal(b.final, again.final)
    assert 0 < close(a.final, b.final) < 1e-10  # other sums; rounding of 20 solves with a matrix of condition 1e4
    assert close(a.outputs, b.outputs) < 1e-10
    assert close(a.force, b.force) < 1e-10
    assert b.energy_drift < 1e-12  # of direct solves


def test_a_matrix_that_is_not_definite_is_refused_on_all_ranks(comm: MPI.Intracomm) -> None:
    system = build(make_scene(), comm=comm).system
    S = midpoint_matrix(system, 0.01)
    S.scale(-1.0)
    with pytest.raises(SolverError, match="not definite"):
        make_solver(S, "cholesky", system.layout, "test_", subtrees=True)


def test_where_blocks_lose_digits_each_rank_has_the_whole_factor(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(subtrees, "BACKWARD_ERROR", 0.0)
    system = build(make_scene(), comm=comm).system
    solver = make_solver(midpoint_matrix(system, 0.01), "cholesky", system.layout, "test_", subtrees=True)
    assert isinstance(solver.factor, OrderedFactor)
    solver.destroy()
