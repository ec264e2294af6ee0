"""The public residual against dense algebra, on solutions and on anything else."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.modal import DenseRiccati, dense_residual, relative_space
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.lowrank.residual import _triangular, residual
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from tests.helpers.models import LAYERS, make_scene

CONTROL = {"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}], "Q": 7.0, "R": [[2.0, 0.5], [0.5, 1.0]]}}
KELVIN = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.003}}}
DRAG = {"effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.003, "drag": "space"}}}
TWO_WAY = {"effects": {"reaction": True}}
CASES = {
    "one_way": (KELVIN,),
    "two_way": (KELVIN, TWO_WAY),
    "drag": (DRAG,),
    "two_way_drag": (DRAG, TWO_WAY),
    "layers": (KELVIN, {"tissue": {"layers": LAYERS}}),
}


def spread(problem: RiccatiProblem, Z: Array) -> Block:
    layout, s = problem.layout, 2 * problem.layout.n_s
    own = slice(layout.start, layout.start + layout.n_local)
    return Block(Z[:s], np.concatenate([Z[s : s + layout.n_e][own], Z[s + layout.n_e :][own]]))


@pytest.mark.parametrize("name", list(CASES))
def test_residual_of_any_z_is_the_dense_one(name: str) -> None:
    """Also of a Z that is no solution: the number, not only its smallness."""
    problem = make_problem(build(make_scene(CONTROL, *CASES[name], tissue={"cells": [3, 6]}), comm=MPI.COMM_WORLD))
    space = problem.layout.comm.bcast(relative_space(problem))
    rng = np.random.default_rng(1)
    for rank in (1, 5):
        Z = rng.standard_normal((problem.layout.states, rank))
        # the same products in another order: rounding of a number of 1e3 to 1e4
        assert residual(problem, spread(problem, Z)) == pytest.approx(dense_residual(problem, space, Z), rel=1e-12)
    nothing = np.zeros((problem.layout.states, 1))
    assert residual(problem, spread(problem, nothing)) == pytest.approx(1.0, rel=1e-12)  # C'QC over itself


@pytest.mark.ranks
def test_residual_sees_a_small_error() -> None:
    problem = make_problem(build(make_scene(CONTROL, KELVIN, tissue={"cells": [3, 6]}), comm=MPI.COMM_WORLD))
    found = DenseRiccati().solve(problem).factor
    assert residual(problem, found) < 1e-9  # rounding times |A||X|
    worse = Block(found.hand * (1 + 1e-6), found.tall)
    assert residual(problem, worse) > 1e-7  # a hundred times the bound above


def test_residual_leaves_its_input_alone() -> None:
    problem = make_problem(build(make_scene(CONTROL, KELVIN, tissue={"cells": [3, 6]}), comm=MPI.COMM_WORLD))
    found = DenseRiccati().solve(problem).factor
    copies = [x.copy() for x in (found.hand, found.tall)]
    residual(problem, found)
    assert all(np.array_equal(a, b) for a, b in zip(copies, (found.hand, found.tall), strict=True))


@pytest.mark.ranks
@pytest.mark.parametrize("rows", [0, 2, 7])
def test_triangle_of_rows_that_other_ranks_lack(comm: MPI.Intracomm, rows: int) -> None:
    U = np.random.default_rng(4).standard_normal((rows, 3))
    R = _triangular(comm, U if comm.rank == comm.size - 1 else U[:0])
    if comm.rank == 0:
        np.testing.assert_allclose(R.T @ R, U.T @ U, rtol=0, atol=1e-14)  # sums of 7 products of numbers near 1
