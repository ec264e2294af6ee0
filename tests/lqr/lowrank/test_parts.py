"""The parts of the low-rank Riccati solvers: shifted solves, modal start, shifts, line search."""

from __future__ import annotations

from typing import Any

import numpy as np
import psutil
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.dense.modal import relative_space
from softgrasp.lqr.lowrank.adjoint import adjoint_rhs, closed_adjoint, far_apart, mass_rhs, open_adjoints
from softgrasp.lqr.lowrank.compress import compress
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin, frequencies
from softgrasp.lqr.lowrank.modal_start import modal_start, plant_modes
from softgrasp.lqr.lowrank.newton import NewtonADI, best_step, mixed_residual
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.lowrank.shifted import GatheredTissue, make_shifted
from softgrasp.lqr.lowrank.shifts import ShiftRange, choose_shifts, energy_products, ritz_pairs
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from tests.helpers.models import gather_matrix, gather_rows, local_rows
from tests.helpers.riccati import SCENE, problem_of


@pytest.mark.parametrize("name", ["one_way", "two_way_drag_in_space", "layers"])
@pytest.mark.parametrize("tissue", ["gathered", "distributed"])
def test_shifted_adjoint_solve_is_the_dense_one(name: str, tissue: str) -> None:
    problem = problem_of(name)
    plant, layout = Plant(problem), problem.layout
    space = relative_space(problem)
    space = layout.comm.bcast(space)
    rng = np.random.default_rng(3)
    full = rng.standard_normal((layout.states, 3))
    n, s = layout.n_local, layout.n_s
    own = slice(2 * s + layout.start, 2 * s + layout.start + n)
    below = slice(own.start + layout.n_e, own.stop + layout.n_e)
    local = Block(full[: 2 * s], np.vstack([full[own], full[below]]))
    solver = make_shifted(plant.system, tissue)
    right = adjoint_rhs(plant, solver, local)
    K_full, W_full = full[:, :2].T, full[:, 2:]
    for p in (-0.7, -0.3 + 4.0j, -2.0 + 30.0j):
        solution = closed_adjoint(plant, open_adjoints(plant, solver, [p], right)[0], right)
        V = solution.real(np.array([[1, -1j]]))  # [Re V, Im V]
        B = space.B @ plant.B
        dense = np.linalg.solve((space.A - B @ K_full + p * space.E).T, W_full)
        columns = np.vstack([V.hand, plant.stiff(V.tall[:n]), V.tall[n:]])
        ours = columns[:, :1] + 1j * columns[:, 1:]
        theirs = np.vstack([dense[: 2 * s], dense[own], dense[below]])
        scale = np.abs(dense).max()
        assert np.abs(ours - theirs).max() < 1e-9 * scale  # condition of the dense matrix times rounding
    solver.destroy()


@pytest.mark.parametrize("name", ["one_way", "two_way_drag_in_space"])
def test_solution_beside_another_shift_is_that_of_the_new_right_hand_side(name: str) -> None:
    """Solved with again on one rank; on more the ranks solve with as many shifts at the same time."""
    problem = problem_of(name)
    plant, layout, rng = Plant(problem), problem.layout, np.random.default_rng(5)
    hand = rng.standard_normal((2 * layout.n_s, 3))
    local = np.sin(np.arange(1, 4) * (1 + layout.nodes.reshape(-1, 1)))
    solver = make_shifted(plant.system, "gathered")
    right = adjoint_rhs(plant, solver, Block(hand, np.vstack([local, -local])))
    shifts = [-0.3 + 4.0j, -2.0 + 30.0j, -0.7 + 0j]
    coefficients = rng.standard_normal((1, 2)) + 1j * rng.standard_normal((1, 2))
    small = rng.standard_normal((2, 3))
    together = open_adjoints(plant, solver, shifts, right)
    assert len(together) == min(layout.comm.size, 3)
    assert len(open_adjoints(plant, solver, [-1.0, -1.01, -9.0], right)) == 1  # too near
    assert far_apart([-1.0, -1.06, -1.12, -9.0]) == 2  # 0.057 * 0.11 < APART
    assert far_apart(shifts) == 3
    first, *others = [open_adjoints(plant, solver, [p], right)[0] for p in shifts]
    V = closed_adjoint(plant, first, right)
    new = right.plus(mass_rhs(plant, V.real(coefficients)), small)
    for beside, alone in zip(together[1:], others, strict=False):
        assert np.abs(beside.b - alone.b).max(initial=0) <= 1e-12 * np.abs(alone.b).max(initial=0)  # rounding
    for solution in others:
        moved = solution.moved(V, coefficients, small)
        again = open_adjoints(plant, solver, [solution.p], new)[0]
        for ours, theirs in ((moved.hand, again.hand), (moved.b, again.b)):
            # rounding of S(p), whose condition is 1e4 here, and of the difference of two solutions
            assert np.abs(ours - theirs).max(initial=0) <= 1e-9 * np.abs(theirs).max(initial=1e-9)
    solver.destroy()


def test_modal_start_stabilises_and_leaves_other_modes_alone() -> None:
    for name in ("one_way", "two_way"):
        problem = problem_of(name)
        plant, layout = Plant(problem), problem.layout
        start = modal_start(plant, 5)
        n = layout.n_local
        K = np.vstack(
            [start.gain.hand, gather_rows(layout, start.gain.tall[:n]), gather_rows(layout, start.gain.tall[n:])]
        )
        space = layout.comm.bcast(relative_space(problem))
        E, A, B = (ordered(problem, M) for M in (space.E, space.A, space.B @ plant.B))
        closed = np.linalg.eigvals(np.linalg.solve(E, A - B @ K.T))
        free = np.linalg.eigvals(np.linalg.solve(E, A))
        assert closed.real.max() < 0
        distance = np.abs(closed[:, None] - free[None, :]).min(axis=1)
        # 5 pairs and the hand's 4 poles move, the rest stays to rounding of the eigenvalues
        assert (distance < 1e-5 * np.abs(closed)).sum() >= layout.states - 14


@pytest.mark.parametrize("name", ["one_way", "two_way_drag_in_space", "layers"])
def test_compression_changes_the_residual_by_no_more_than_allowed(name: str) -> None:
    problem = problem_of(name)
    plant, layout = Plant(problem), problem.layout
    space = layout.comm.bcast(relative_space(problem))
    E, A = (ordered(problem, M) for M in (space.E, space.A))
    n, s, k = layout.n_local, layout.n_s, 24
    full = np.random.default_rng(4).standard_normal((layout.states, k)) * 10.0 ** (-np.arange(k) / 2)
    Z = Block(full[: 2 * s], np.vstack([local_rows(layout, part) for part in np.split(full[2 * s :], 2)]))

    def change(X: Block) -> Array:
        tissue = [gather_rows(layout, part) for part in (plant.stiff(X.tall[:n]), X.tall[n:])]
        rows = np.vstack([X.hand, *tissue])
        product = (A.T @ rows) @ (E.T @ rows).T
        return np.asarray(product + product.T)

    allowed = 1e-6 * float(np.linalg.norm(change(Z), 2))
    small = compress(plant, Z, allowed)
    assert 1 < small.columns < k
    # the bound of the dropped columns (with drag in space the weight is no exact norm, but there is slack); 1e-12:
    # rounding of the dense products
    assert np.linalg.norm(change(Z) - change(small), 2) <= allowed * (1 + 1e-12 / 1e-6)


def ordered(problem: RiccatiProblem, M: Array) -> Array:
    """Dense rows (and columns) in global numbering to node order."""
    layout = problem.layout
    numbers = gather_rows(layout, np.arange(layout.start, layout.start + layout.n_local, dtype=float)[:, None])
    at = numbers[:, 0].astype(int)
    s, n_e = 2 * layout.n_s, layout.n_e
    index = np.concatenate([np.arange(s), s + at, s + n_e + at])
    return M[index][:, index] if M.shape[1] == len(index) else M[index]


def test_ritz_values_of_the_open_plant_are_stable_and_true() -> None:
    problem = problem_of("one_way")
    plant, layout = Plant(problem), problem.layout
    rng = np.random.default_rng(5)
    tall = rng.standard_normal((2 * layout.n_e, 10))
    local = np.vstack([local_rows(layout, tall[: layout.n_e]), local_rows(layout, tall[layout.n_e :])])
    V = Block(np.zeros((2 * layout.n_s, 10)), local)
    values, sizes = ritz_pairs(plant, V, V[:2], None)
    assert (values.real < 0).all()  # dissipation in the energy product
    assert sizes.shape == values.shape
    # span of whole state blocks of one eigenvector: its Ritz value is the eigenvalue
    omegas, modes = plant_modes(plant, 3)
    phi, omega = modes[:, :1], omegas[0]
    pair = np.zeros((2 * layout.n_local, 2))
    pair[: layout.n_local, :1], pair[layout.n_local :, 1:] = phi, phi
    hand = np.zeros((4, 2))
    hand[2:, 1:] = -np.linalg.solve(plant.M_s, total(layout.comm, plant.G.T @ phi))  # E'V has no row of the hand
    found, _ = ritz_pairs(plant, Block(hand, pair), Block(hand, pair), None)
    assert np.allclose(found.real, -0.003 * omega**2 / 2, rtol=1e-8, atol=0)  # what softgrasp.fem.solve.modes lets pass
    assert np.allclose(np.abs(found), omega, rtol=1e-8, atol=0)  # as above


@pytest.mark.parametrize("name", ["one_way", "drag_in_space", "two_way_drag_in_space", "layers"])
def test_energy_products_are_those_of_the_dense_matrices(name: str) -> None:
    """V'H^{-1} with H = blkdiag(1, M_s, K, M), two-way with G in the mass, times A'V, E'V and other columns."""
    problem = problem_of(name)
    plant, layout = Plant(problem), problem.layout
    n, s, rng = layout.n_local, layout.n_s, np.random.default_rng(8)
    own = slice(2 * s + layout.start, 2 * s + layout.start + n)
    below = slice(own.start + layout.n_e, own.stop + layout.n_e)
    full = rng.standard_normal((3, layout.states, 4))
    V, W, X = (Block(x[: 2 * s], np.vstack([x[own], x[below]])) for x in full)
    space = layout.comm.bcast(relative_space(problem))
    z, v, hand = np.s_[2 * s : 2 * s + layout.n_e], np.s_[2 * s + layout.n_e :], np.s_[s : 2 * s]
    K = -space.A[v, z]
    V_full = full[0].copy()  # the solvers keep K_ee^{-1} times the rows of z
    V_full[z] = K @ V_full[z]
    H = np.eye(layout.states)
    H[z, z], H[v, v], H[hand, hand] = K, space.E[v, v], space.E[hand, hand]
    if problem.system.two_way:
        H[v, hand], H[hand, v] = space.E[v, hand], space.E[hand, v]
    E_V = space.E.T @ V_full
    E_V[z], A_V = V_full[z], space.A.T @ V_full
    test = np.linalg.solve(H, E_V)
    for ours, direct in zip(energy_products(plant, V, W, X), (A_V, E_V, full[1], full[2]), strict=True):
        assert np.allclose(ours, test.T @ direct, rtol=0, atol=1e-10 * np.abs(test.T @ direct).max())  # condition of H


def test_clip_and_choice_of_shifts() -> None:
    limits = ShiftRange(0.01, 100.0)
    assert limits.clip(np.array([-5.6e-11 + 0j]))[0] == -0.01  # the spurious Ritz value of the hand's zero poles
    assert abs(limits.clip(np.array([-1e4 + 1e4j]))[0]) == pytest.approx(100.0)
    assert limits.clip(np.array([2.0 - 3.0j]))[0] == pytest.approx(-2.0 + 3.0j)
    assert limits.clip(np.array([-0.0 + 5.0j]))[0].real < 0
    candidates = np.array([-1.0 + 0j, -1.0 + 10j, -1.0 + 20j])
    chosen = choose_shifts(candidates, np.array([1.0, 5.0, 3.0]), 3)
    # what is planned already counts as chosen
    assert choose_shifts(candidates, np.array([1.0, 5.0, 3.0]), 2, chosen[:1]) == chosen[1:]
    assert chosen[0] == candidates[1]
    assert set(chosen) == set(candidates.tolist())


def test_line_search_finds_the_minimum_of_the_dense_residual(comm: MPI.Intracomm) -> None:
    rng = np.random.default_rng(9)
    U, W, change = (rng.standard_normal((12, k)) * f for k, f in ((3, 1.0), (2, 0.3), (2, 2.0)))
    signs = np.array([1.0, 1.0, -1.0])
    mine = slice(12 * comm.rank // comm.size, 12 * (comm.rank + 1) // comm.size)
    blocks = [Block(np.zeros((0, X.shape[1])), X[mine]) for X in (U, W, change)]
    t, before, after = best_step(comm, (blocks[0], signs), blocks[1], blocks[2])

    def residual(step: float) -> float:
        R = (1 - step) * (U * signs) @ U.T + step * W @ W.T - step**2 * change @ change.T
        return float(np.linalg.norm(R))

    grid = np.linspace(0.01, 1, 2000)
    assert residual(t) <= min(residual(s) for s in grid) * (1 + 1e-9)  # the grid may hit it: rounding
    assert (before, after) == (pytest.approx(residual(0.0)), pytest.approx(residual(1.0)))
    mixed, weights = mixed_residual((blocks[0], signs), blocks[1], blocks[2], t)
    whole = np.vstack(comm.allgather(mixed.tall))
    assert np.linalg.norm((whole * weights) @ whole.T) == pytest.approx(residual(t))


@pytest.mark.parametrize("solver", [NewtonADI(), RADI(), StructuredGalerkin()], ids=lambda s: type(s).__name__)
def test_what_decides_has_the_same_bits_where_ranks_round_differently(
    comm: MPI.Intracomm, solver: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A library whose small dense results differ by rounding from rank to rank: other processors, other alignment."""
    problem = problem_of("two_way")
    for name in ("norm", "eigvalsh", "cholesky"):
        call = getattr(np.linalg, name)
        monkeypatch.setattr(np.linalg, name, lambda *a, call=call, **k: call(*a, **k) * (1 + 1e-15 * comm.rank))
    whole = np.sum
    monkeypatch.setattr(np, "sum", lambda *a, **k: whole(*a, **k) * (1 + 1e-15 * comm.rank))
    solution = solver.solve(problem)
    U, W, change = (Block(np.zeros((0, 2)), np.random.default_rng(i).standard_normal((4, 2))) for i in range(3))
    decided = (Plant(problem).scale, solution.residual, *best_step(comm, (U, np.ones(2)), W, change))
    assert len(set(comm.allgather(decided))) == 1
    assert len(set(comm.allgather((solution.factor.columns, solution.counts["solves"])))) == 1


def test_frequencies_fill_the_range() -> None:
    points = np.sort(frequencies(1.0, 100.0, 7))
    assert np.allclose(np.diff(np.log(points)), np.log(100.0) / 8)  # 7 inner points of 8 equal parts


def test_symmetric_sparse_copy_is_the_matrix() -> None:
    """Rows serve as columns in the gathered solver: that needs a symmetric matrix."""
    system: BlockSystem = problem_of("layers").system
    for A in (system.K_ee, system.M_ee, system.damping.matrix):
        whole = gather_matrix(system.layout, A)
        assert abs(whole - whole.T).max() < 1e-12 * abs(whole).max()  # order of summation in assembly


@pytest.mark.ranks
def test_a_factor_that_fails_on_one_rank_ends_the_solve_on_all(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ranks factor and solve before they wait for each other; what was there before is not used again."""
    tissue, shifts = GatheredTissue(problem_of("one_way").system), [complex(-1.0 - i, 2.0) for i in range(comm.size)]
    F, make = np.ones((tissue.n_local, 2)), GatheredTissue._make
    expected = [tissue.solve(p, F) for p in shifts]

    def refused(self: GatheredTissue, p: complex, shell: int = 0) -> Any:
        if p == shifts[-1]:
            raise SolverError("the factorisation of S(p) failed")
        return make(self, p, shell)

    tissue.solve(-3.0 + 9j, F)
    with monkeypatch.context() as patch:
        patch.setattr(GatheredTissue, "_make", refused)
        with pytest.raises(SolverError, match="failed"):
            tissue.solve_each(shifts, [F] * len(shifts))
    for one, other in zip(tissue.solve_each(shifts, [F] * len(shifts)), expected, strict=True):
        assert np.array_equal(one, other)  # the same factor of the same rows


@pytest.mark.serial
def test_factors_of_a_helper_thread_are_freed() -> None:
    """SciPy frees the memory of a factor only in the thread that made it; forty of them hold 500 MB."""
    system = build(load_scene(SCENE, ["tissue.cells=[40,80]"]), comm=MPI.COMM_SELF).system
    tissue = GatheredTissue(system)
    F = np.ones((system.layout.n_local, 1))
    shifts = [complex(-1.0 - 0.1 * i, 2.0 + i) for i in range(44)]

    def work(i: int) -> None:
        guess = shifts[i + 1] if i % 5 else shifts[0]  # now and then another one than announced
        tissue.solve(shifts[i], F, [guess])

    for i in range(3):
        work(i)
    before = psutil.Process().memory_info().rss
    for i in range(3, 43):
        work(i)
    grown = psutil.Process().memory_info().rss - before
    tissue.destroy()
    assert grown < 50e6  # a few factors and the heap's slack
