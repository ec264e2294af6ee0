"""The factor in blocks: its order, its solves on any number of ranks, and when single entries take over."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import softgrasp.fem.solve.solvers
from softgrasp.fem.errors import Interrupted, SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import whole_copy
from softgrasp.fem.run.midpoint import TissueMidpoint, midpoint_matrix, state_on
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.solve.cholesky import BACKWARD_ERROR, backward_error, dissect, factor_blocks, make_ksp, package_of
from softgrasp.fem.solve.solvers import choose_solver, make_solver
from tests.helpers.models import CUBE, close, gather_matrix, gather_rows, local_rows, make_scene

UNEQUAL: dict[str, Any] = {"tissue": {"material": {"lambda": 90.0, "mu": 20.0, "rho": 1.0}}}
SCENES = {"2d": [UNEQUAL], "3d": [UNEQUAL, CUBE], "p2": [UNEQUAL, {"tissue": {"order": 2}}]}
# a block 1e6 times as stiff as the one it hangs from, lambda = 0
HANGING: dict[str, Any] = {
    "tissue": {
        "cells": [4, 8],
        "order": 2,
        "material": {"lambda": 0.0, "mu": 50.0, "rho": 1.0},
        "layers": {"low": {"box": [[0.0, 0.0], [1.0, 1.0]], "material": {"lambda": 0.0, "mu": 5e7, "rho": 1.0}}},
    },
    "contact": {"sides": ["top"], "box": [[0.0, 0.0], [1.0, 2.0]]},
}


def factor_of(ksp: PETSc.KSP) -> PETSc.Mat:
    return ksp.getPC().getFactorMatrix()


def kept_nonzeros(P: PETSc.Mat, ordering: str) -> float:
    """Entries of PETSc's own factor of single entries."""
    ksp = PETSc.KSP().create(P.comm)
    ksp.setOperators(P)
    ksp.setType("preonly")
    ksp.getPC().setType("cholesky")
    ksp.getPC().setFactorOrdering(ordering)
    ksp.setUp()
    kept = float(factor_of(ksp).getInfo()["nz_used"])
    ksp.destroy()
    return kept


@pytest.mark.ranks
@pytest.mark.parametrize("name", SCENES)
def test_order_moves_nodes_and_comes_back(comm: MPI.Intracomm, name: str) -> None:
    system = build(make_scene(*SCENES[name]), comm=comm).system
    d, n = system.layout.dimension, system.layout.n_e
    K = whole_copy(system.K_ee)
    found = dissect(K, d)
    order = found.order
    assert sorted(order.nodes.tolist()) == list(range(n // d))
    x = np.random.default_rng(0).standard_normal((n, 2))
    moved = order.enter(x)
    assert np.array_equal(moved.reshape(-1, d, 2), x.reshape(-1, d, 2)[order.nodes])
    assert np.array_equal(order.leave(moved), x)
    P = found.matrix(K)
    rows = order.enter(np.arange(n))
    dense = K.convert("dense", PETSc.Mat()).getDenseArray()  # lambda is not mu: its blocks are not symmetric
    assert np.array_equal(P.convert("dense", PETSc.Mat()).getDenseArray(), dense[np.ix_(rows, rows)])


@pytest.mark.serial
def test_order_keeps_the_factor_thin(comm: MPI.Intracomm) -> None:
    system = build(make_scene(tissue={"cells": [40, 80]}), comm=comm).system
    P = dissect(system.K_ee, 2).matrix(system.K_ee)
    ksp = factor_blocks(P, "test_")
    kept = factor_of(ksp).getInfo()["nz_used"]
    # nodes instead of their rows in the same dissection: as thin as PETSc's own order, a third less than the mesh's
    assert kept < 1.1 * kept_nonzeros(system.K_ee, "nd")
    assert kept < 0.7 * kept_nonzeros(system.K_ee, "natural")
    ksp.destroy()


@pytest.mark.serial
@pytest.mark.parametrize("name", SCENES)
def test_pattern_with_every_level_is_that_of_cholesky(comm: MPI.Intracomm, name: str) -> None:
    system = build(make_scene(*SCENES[name]), comm=comm).system
    P = dissect(system.K_ee, system.layout.dimension).matrix(system.K_ee)
    ksp = make_ksp(P.convert("sbaij", PETSc.Mat()), "test_")
    ksp.getPC().setType("cholesky")
    ksp.getPC().setFactorOrdering("natural")
    ksp.setUp()
    found = []
    for one in (factor_blocks(P, "test_"), ksp):
        r, w = factor_of(one).createVecs()
        r.array_w[:] = np.random.default_rng(1).standard_normal(P.getSize()[0])
        factor_of(one).solve(r, w)
        found.append((factor_of(one).getInfo()["nz_used"], w.array_r.tolist(), package_of(one.getPC())))
        one.destroy()
    assert found[0] == found[1]  # the same entries in the same order: the same bits


@pytest.mark.ranks
@pytest.mark.parametrize("name", SCENES)
def test_solves_agree_with_a_dense_solve_on_any_ranks(comm: MPI.Intracomm, name: str) -> None:
    system = build(make_scene(*SCENES[name]), comm=comm).system
    layout = system.layout
    S = midpoint_matrix(system, 0.01)
    dense = gather_matrix(layout, S).toarray()
    solver = make_solver(S, "cholesky", layout, "test_")
    assert factor_of(solver.ksp).getBlockSize() == layout.dimension
    r, w = S.createVecs()
    for seed in (1, 2):  # the second one finds used vectors
        full = np.random.default_rng(seed).standard_normal(layout.n_e)
        r.array_w[:] = local_rows(layout, full)
        solver.solve(r, w)
        # condition about 1e2
        assert close(gather_rows(layout, w.array_r), np.linalg.solve(dense, full)) < 1e-12
        assert solver.residual(r, w) < 1e-13  # as above
    solver.destroy()


def permuted(K: PETSc.Mat) -> PETSc.Mat:
    whole = whole_copy(K)
    return dissect(whole, 2).matrix(whole)


def blocks_of(P: PETSc.Mat) -> PETSc.KSP:
    """The factor in blocks, whatever it is worth."""
    ksp = make_ksp(P.convert("sbaij", PETSc.Mat()), "test_")
    ksp.setUp()
    return ksp


def stiff_part(box: list[list[float]], mu: float) -> dict[str, Any]:
    """A small part of the soft body much stiffer than the rest, which the softest modes hardly strain."""
    material = {"lambda": 0.0, "rho": 1.0}
    layers = {"part": {"box": box, "material": {**material, "mu": mu}}}
    return {"tissue": {"cells": [8, 16], "order": 2, "material": {**material, "mu": 1.0}, "layers": layers}}


UNSTABLE = {
    "hanging": HANGING,
    "near the hand": stiff_part([[0.25, 1.25], [0.75, 1.5]], 1e6),
    "in the middle": stiff_part([[0.25, 0.75], [0.75, 1.25]], 1e6),
}


@pytest.mark.parametrize("name", UNSTABLE)
@pytest.mark.parametrize("by", ["petsc", "mumps"])
def test_single_entries_take_over_where_blocks_lose_digits(comm: MPI.Intracomm, name: str, by: Any) -> None:
    P = permuted(build(make_scene(UNSTABLE[name]), comm=comm).system.K_ee)
    blocks, chosen = blocks_of(P), factor_blocks(P, "test_", by)
    assert backward_error(P, blocks) > BACKWARD_ERROR
    assert "sbaij" not in chosen.getOperators()[0].getType()
    assert chosen.getPC().getFactorSolverType() == by
    assert backward_error(P, chosen) < BACKWARD_ERROR
    for ksp in (blocks, chosen):
        ksp.destroy()


def test_choice_is_free_of_the_scale_of_rows(comm: MPI.Intracomm) -> None:
    for scene, single in (({}, False), (HANGING, True)):
        P = permuted(build(make_scene(scene), comm=comm).system.K_ee)
        scale = P.createVecLeft()
        scale.array_w[:] = 10.0 ** np.random.default_rng(0).integers(-5, 6, P.getSize()[0])
        P.diagonalScale(scale, scale)
        ksp = factor_blocks(P, "test_")
        assert ("sbaij" not in ksp.getOperators()[0].getType()) == single
        assert backward_error(P, ksp) < BACKWARD_ERROR
        ksp.destroy()


def test_large_systems_in_space_leave_single_entries_to_mumps(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(softgrasp.fem.solve.solvers.FEW_LIMIT, 2, 100)
    system = build(make_scene(HANGING), comm=comm).system
    solver = make_solver(system.K_ee.copy(), "cholesky", system.layout, "test_")
    assert solver.used("small").reason == "small; in single entries by MUMPS, since blocks would lose digits here"
    solver.destroy()


def test_run_says_when_single_entries_took_over(comm: MPI.Intracomm) -> None:
    still = {"motion": {"profile": "hold", "target": None}, "time": {"steps": 1, "end": 1.0}}
    for changes, remark in ((HANGING, True), ({}, False)):
        run = simulate(build(make_scene(changes, still), comm=comm))
        assert ("single entries by PETSc" in run.solver.reason) == remark
        assert run.energy_drift == 0.0  # nothing moves


def test_step_does_not_lose_what_blocks_would(comm: MPI.Intracomm) -> None:
    """One long step of the hanging scene against a dense solve: the stiff part's stretch is 1e-6 of its motion."""
    system = build(make_scene(HANGING), comm=comm).system
    layout = system.layout
    midpoint = TissueMidpoint(system, 1.0, "cholesky")
    state = state_on(np.zeros(2 * layout.n_local), system)
    midpoint.start(state)
    midpoint.solve_midpoint(np.array([0.0, -1.0]))
    midpoint.advance(state, state)
    S = gather_matrix(layout, midpoint_matrix(system, 1.0)).toarray()
    exact = 2 * np.linalg.solve(S, gather_rows(layout, system.G) @ [0.0, -1.0])
    # eps times the condition 7e9 of S scaled to a unit diagonal [VDS69]; blocks leave 1e-5
    assert close(gather_rows(layout, state.z.array_r), exact) < 1.5e-6
    midpoint.destroy()


def test_backward_error_is_that_of_the_matrix_solved_with(comm: MPI.Intracomm) -> None:
    """The factor of P + 1e-6 D^2, D^2 = diag P, leaves D^-1 (r - P w) = 1e-6 D w."""
    P = permuted(build(make_scene(), comm=comm).system.K_ee)
    other, diagonal = P.copy(), P.getDiagonal()
    diagonal.scale(1 + 1e-6)
    other.setDiagonal(diagonal)
    ksp = factor_blocks(other, "test_")
    # the sum with |D^-1 r| counts, which for a soft body is well below |D w|
    assert 0.5e-6 < backward_error(P, ksp) < 1e-6
    ksp.destroy()


@pytest.mark.ranks
def test_vanishing_pivot_is_named_on_every_rank(comm: MPI.Intracomm) -> None:
    system = build(make_scene(), comm=comm).system
    S = system.K_ee.copy()
    S.zeroEntries()
    with pytest.raises(SolverError, match=r"cholesky: the factorisation of the tissue matrix \(n_e = \d+\) failed"):
        make_solver(S, "cholesky", system.layout, "test_")


@pytest.mark.ranks
def test_state_and_vectors_held_whole_keep_the_same_bits(comm: MPI.Intracomm) -> None:
    system = build(make_scene(), comm=comm).system
    layout = system.layout
    midpoint = TissueMidpoint(system, 0.01, "cholesky")
    z, v = np.random.default_rng(3).standard_normal((2, layout.n_e))
    state = state_on(np.concatenate([local_rows(layout, z), local_rows(layout, v)]), system)
    midpoint.start(state)
    for _ in range(5):
        midpoint.solve_midpoint(np.ones(2))
        midpoint.advance(state, state)
    own = slice(layout.start, layout.start + layout.n_local)
    assert np.array_equal(midpoint.operators.leave(midpoint.z.array_r)[own], state.z.array_r)
    midpoint.destroy()


@pytest.mark.ranks
def test_restart_file_holds_the_right_hand_side_in_the_order_of_the_layout(
    comm: MPI.Intracomm, mpi_tmp_path: Path
) -> None:
    model = build(make_scene(), comm=comm)
    with pytest.raises(Interrupted):
        simulate(model, RunOptions(mpi_tmp_path, until=7))
    system, layout = model.system, model.system.layout
    with np.load(next(mpi_tmp_path.glob(f"checkpoint/*-step7-rank{comm.rank}.npz"))) as file:
        r, pending, state = file["r"], file["pending"], state_on(file["state"], system)
    y, k = system.K_ee.createVecs()
    system.M_ee.mult(state.v, y)
    system.K_ee.mult(state.z, k)
    s = 2 * model.scene.time.steps / model.scene.time_end
    h = s * y.array_r - k.array_r
    own = slice(layout.start, layout.start + layout.n_local)
    assert close(r[own] + system.G @ pending, h) < 1e-10  # seven steps of rounding in differences of large terms


def test_few_solves_in_space_go_to_mumps_earlier(comm: MPI.Intracomm) -> None:
    layout = build(make_scene(CUBE), comm=comm).system.layout
    large = replace(layout, n_e=6_003)
    assert choose_solver(large)[0] == "cholesky"
    assert choose_solver(large, few=True)[0] == "mumps"
    assert choose_solver(large, "cholesky", few=True)[0] == "cholesky"
