"""The displacement of a run as a sum of two words."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import rows_on_all
from softgrasp.fem.run.displacement import Displacement, exact_sum
from softgrasp.fem.run.make import make_midpoint
from softgrasp.fem.run.midpoint import state_on
from softgrasp.fem.solve.differences import minus_twice
from softgrasp.fem.solve.solvers import SolverName

EPS = float(np.finfo(float).eps)


@pytest.mark.serial
def test_what_a_sum_loses_is_exact() -> None:
    """Against long double, which has all digits of these sums."""
    a, b = np.random.default_rng(2).standard_normal((2, 1000))
    b *= np.logspace(-3, 3, 1000)
    rounded, lost = exact_sum(a, b)
    assert np.array_equal(rounded, a + b)
    assert np.array_equal(a.astype(np.longdouble) + b, rounded.astype(np.longdouble) + lost)
    assert lost.any()


@pytest.mark.ranks
@pytest.mark.parametrize("solver", ["cholesky", "mumps", "cg"])
def test_small_steps_add_up(comm: MPI.Intracomm, solver: SolverName) -> None:
    """Two words are the sum of 2 w to the rounding of 2 w; the first alone would be wrong by 1e3 times that."""
    system = build("paper_forward", ["tissue.cells=[6, 8]"], comm=comm).system
    layout, midpoint = system.layout, make_midpoint(system, 1e-4, solver)
    n, rng = layout.n_local, np.random.default_rng(comm.rank)
    state = state_on(np.concatenate([1 + rng.random(n), rng.random(n)]), system)
    midpoint.start(state)
    sums, one, moved = state.array[:n].astype(np.longdouble), state.array[:n].copy(), 0.0
    for k in range(200):
        midpoint.solve_midpoint(np.full(layout.n_s, np.sin(k)))
        step = 2 * midpoint.owned()
        sums, one, moved = sums + step, one + step, max(moved, float(np.abs(step).max(initial=0.0)))
        midpoint.advance(state, state)
    errors = [
        np.abs(x).max(initial=0.0)
        for x in (
            state.array[:n] + midpoint.low.array_r[midpoint.operators.rows].astype(np.longdouble) - sums,
            one - sums,
        )
    ]
    midpoint.destroy()
    both, first = (comm.allreduce(float(e), MPI.MAX) for e in errors)
    bound = 200 * EPS * comm.allreduce(moved, MPI.MAX)
    assert both < bound  # rounding of 2 w + low in each step
    assert first > 2 * bound  # the sum of z alone


@pytest.mark.serial
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_steps_without_a_compiler_have_the_same_displacement(d: int, whole: bool) -> None:
    rng, n = np.random.default_rng(d), 30 * d
    w, nodes = np.zeros(n), rng.permutation(30)[: 20 if whole else 30]
    states, lows, held = np.zeros((2, 2 * d * len(nodes))), np.zeros((2, n)), np.ones((2, n))
    states[:, : d * len(nodes)] = 1.0
    places = np.ascontiguousarray(nodes if whole else np.arange(30))
    ways = [Displacement(w, low, 2e3, z if whole else None, places, d) for low, z in zip(lows, held, strict=True)]
    ways[1].code = None
    for _ in range(50):
        w[:] = 1e-3 * rng.standard_normal(n)
        for way, state in zip(ways, states, strict=True):
            way.move(state, state)
    z = states[:, : d * len(nodes)]
    assert lows[0].any()
    for a, b in (z, lows, held):
        assert np.array_equal(a, b)
    assert np.allclose(states[0], states[1], rtol=1e-13)  # v may differ by a fused product


@pytest.mark.ranks
@pytest.mark.parametrize(("scene", "cells"), [("paper_forward", "[20, 3]"), ("set_down_3d", "[6, 6, 2]")])
def test_the_product_has_both_words(comm: MPI.Intracomm, scene: str, cells: str) -> None:
    """The second word changes K z as a matrix product says, also across the borders of ranks."""
    system = build(scene, [f"tissue.cells={cells}"], comm=comm).system
    z, low, one, two, y = (system.K_ee.createVecRight() for _ in range(5))
    z.array_w[:], low.array_w[:] = system.layout.nodes.ravel(), np.sin(system.layout.nodes.ravel()) * 1e-3
    product = minus_twice(system.K_ee, system.layout.dimension)
    product.mult(z, one)
    product.mult(z, two, low)
    system.K_ee.mult(low, y)
    change = rows_on_all(comm, two.array_r - one.array_r + 2 * y.array_r)
    assert np.abs(change).max() < 1e-12 * np.abs(rows_on_all(comm, two.array_r)).max()  # rounding of both products
    product.destroy()
