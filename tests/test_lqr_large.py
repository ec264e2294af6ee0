"""Low-rank Riccati solvers against the dense oracle, against each other, and on every road through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
from mpi4py import MPI

from fem.build import build
from fem.errors import CheckpointError, ResourceError, SolverError
from fem.petsc import Array, total
from fem.scene_file import load_scene
from fem.system import BlockSystem
from lqr.adjoint import closed_adjoint, make_right
from lqr.checks import ControlError
from lqr.dense import DenseRiccati, relative_space
from lqr.galerkin import StructuredGalerkin, frequencies
from lqr.line_search import best_step, mixed_residual
from lqr.modal_start import modal_start
from lqr.newton import NewtonADI
from lqr.plant import Block, Plant
from lqr.problem import RiccatiProblem, RiccatiSolution
from lqr.radi import RADI
from lqr.shifted import GatheredTissue, factor_bytes, make_shifted
from lqr.shifts import ShiftRange, choose_shifts, energy_products, ritz_pairs
from lqr.solve import choose, solve
from study.control_problem import make_problem
from tests.helpers import CUBE, LAYERS, gather_matrix, gather_rows, local_rows, make_scene

SCENE = Path(__file__).parents[1] / "demos" / "scenes" / "paper_lqr.toml"
NODE = {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}
KELVIN = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.003}}, "control": NODE}
DRAG = {"effects": {"damping": {"kind": "rayleigh", "alpha": 0.05, "beta": 0.003, "drag": "space"}}}
REGION = [{"kind": "region", "box": [[0.0, 0.0], [0.6, 0.6]]}, {"kind": "hand"}]
CUBE_NODE = {"control": {"outputs": [{"kind": "node", "point": [0.9, 0.7, 0.1]}]}}
CASES: dict[str, tuple[dict[str, Any], ...]] = {
    "one_way": (KELVIN,),
    "two_way": (KELVIN, {"effects": {"reaction": True}}),
    "drag_in_space": (KELVIN, DRAG),
    "two_way_drag_in_space": (KELVIN, DRAG, {"effects": {"reaction": True}}),
    "layers": (KELVIN, {"tissue": {"layers": LAYERS}}),
    "cube": (CUBE, KELVIN, CUBE_NODE),
    "cube_two_way": (CUBE, KELVIN, CUBE_NODE, {"effects": {"reaction": True}}),
    "region_hand_weights": (
        KELVIN,
        {"control": {"outputs": REGION, "Q": np.diag([9.0, 1.0, 4.0, 0.0]).tolist(), "R": [[2.0, 0.5], [0.5, 1.0]]}},
    ),
}


@cache
def problem_of(name: str) -> RiccatiProblem:
    return make_problem(build(make_scene(*CASES[name]), MPI.COMM_WORLD))


@cache
def oracle(name: str) -> RiccatiSolution:
    return DenseRiccati().solve(problem_of(name))


@cache
def paper(*changes: str) -> RiccatiProblem:
    return make_problem(build(load_scene(SCENE, ["tissue.cells=[5,10]", *changes]), MPI.COMM_WORLD))


def gain(problem: RiccatiProblem, solution: RiccatiSolution) -> Array:
    """The gain in node order, (2n, m), on every rank."""
    layout = problem.layout
    return np.vstack([solution.K_s.T, gather_rows(layout, solution.K_z), gather_rows(layout, solution.K_v)])


def gain_error(problem: RiccatiProblem, ours: RiccatiSolution, theirs: RiccatiSolution) -> float:
    a, b = gain(problem, ours), gain(problem, theirs)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def factor(problem: RiccatiProblem, solution: RiccatiSolution) -> Array:
    """Z in node order, on every rank."""
    layout = problem.layout
    return np.vstack([solution.Z_s, gather_rows(layout, solution.Z_z), gather_rows(layout, solution.Z_v)])


def x_error(problem: RiccatiProblem, ours: RiccatiSolution, theirs: RiccatiSolution) -> float:
    a, b = factor(problem, ours), factor(problem, theirs)
    return float(np.linalg.norm(a @ a.T - b @ b.T, 2) / np.linalg.norm(b @ b.T, 2))


# --- the solution


@pytest.mark.parametrize("name", list(CASES))
def test_newton_and_radi_equal_the_dense_oracle(name: str) -> None:
    """Two recursions with nothing but the tissue solve in common, and an oracle with not even that."""
    problem = problem_of(name)
    for method in (NewtonADI(), RADI()):
        found = method.solve(problem)
        assert found.residual < 2e-10  # 1e-10 of the recursion and what compression may add
        assert gain_error(problem, found, oracle(name)) < 1e-9  # a residual of 1e-10 leaves much less in the gain
        assert x_error(problem, found, oracle(name)) < 1e-6
        assert found.rank < problem.layout.states


@pytest.mark.parametrize("name", ["one_way", "two_way", "two_way_drag_in_space", "layers", "cube", "cube_two_way"])
def test_galerkin_gain_is_as_good_as_it_says(name: str) -> None:
    problem = problem_of(name)
    found = StructuredGalerkin().solve(problem)
    assert found.history[-1]["change"] <= 1e-6
    assert gain_error(problem, found, oracle(name)) < 1e-6  # the promise of the tolerance
    assert found.counts["solves"] <= 20


@pytest.mark.parametrize(("beta", "weight"), [(0.02, 1.0), (0.002, 1.0), (0.002, 100.0), (0.002, 1e4), (2e-4, 1.0)])
def test_paper_scene_over_damping_and_weight(beta: float, weight: float) -> None:
    """Residual, agreement of two methods, and the identities that hold for every mesh and material."""
    problem = paper(f"effects.damping.beta={beta}", f"control.Q={weight}")
    newton, radi = NewtonADI().solve(problem), RADI().solve(problem)
    assert max(newton.residual, radi.residual) < 2e-10
    assert gain_error(problem, newton, radi) < 1e-8  # at Q = 1e4 the gain is 100 times the residual's scale
    assert newton.counts["newton_steps"] <= 2  # one, unless Q is large on a coarse mesh
    # whole body displaced: hand-relative state [I; 0; 0; 0], (K x_T)'(K x_T) = Q
    K_q, K_v = newton.K_s[:, :2], newton.K_s[:, 2:]
    assert np.allclose(K_q.T @ K_q, weight * np.eye(2), rtol=0, atol=1e-9 * weight)
    # whole body moving: (K x_T)'(K v_T) = x_T'E'XE x_T, E x_T = [I; 0; 0; 0]
    E_x = newton.Z_s[:2]
    assert np.allclose(K_q.T @ K_v, E_x @ E_x.T, rtol=0, atol=1e-8 * np.abs(K_q.T @ K_v).max())


@pytest.mark.slow
@pytest.mark.parametrize("beta", [0.02, 0.002, 2e-4])
def test_paper_size_against_the_oracle(beta: float) -> None:
    """2n = 880 for Q = 1, 100, 1e4."""
    for weight in (1.0, 100.0, 1e4):
        problem = paper("tissue.cells=[10,20]", f"effects.damping.beta={beta}", f"control.Q={weight}")
        reference = DenseRiccati(tolerance=1e-6).solve(problem)
        for method in (NewtonADI(), RADI()):
            found = method.solve(problem)
            assert found.residual < 2e-10
            assert gain_error(problem, found, reference) < 1e-6  # accuracy of the oracle
            assert x_error(problem, found, reference) < 1e-6
        galerkin = StructuredGalerkin().solve(problem)
        assert gain_error(problem, galerkin, reference) < 2e-6


def test_solves_do_not_grow_with_the_mesh() -> None:
    counts = [NewtonADI().solve(paper(f"tissue.cells=[{nx},{2 * nx}]")).counts["solves"] for nx in (4, 12)]
    assert counts[1] <= 1.5 * counts[0]  # the unknowns grow by a factor of 8
    assert counts[1] < 80


def test_inputs_stay_bitwise_the_same() -> None:
    problem = problem_of("two_way")
    system = problem.system
    arrays = {"C_s": problem.C_s, "C_z": problem.C_z, "Q": problem.Q, "R": problem.R, "G": system.G, "T": system.T}
    copies = {key: value.copy() for key, value in arrays.items()}
    values = [A.getValuesCSR()[2].copy() for A in (system.M_ee, system.K_ee)]
    for method in (NewtonADI(), RADI(), StructuredGalerkin()):
        method.solve(problem)
    assert all(np.array_equal(arrays[key], copies[key]) for key in arrays)
    for A, old in zip((system.M_ee, system.K_ee), values, strict=True):
        assert np.array_equal(A.getValuesCSR()[2], old)


def test_same_result_on_every_rank_count() -> None:
    """A rank by itself solves the same scene; the parallel gain is the same."""
    problem = problem_of("one_way")
    alone = make_problem(build(make_scene(*CASES["one_way"]), MPI.COMM_SELF))
    reference = gain(alone, NewtonADI().solve(alone))
    for method in (NewtonADI(), NewtonADI(tissue="distributed"), RADI(), RADI(tissue="distributed")):
        found = method.solve(problem)
        error = np.linalg.norm(gain(problem, found) - reference) / np.linalg.norm(reference)
        assert error < 1e-9
        assert len(set(problem.layout.comm.allgather(found.K_s.tobytes()))) == 1


# --- roads and refusals


def test_rigid_start_needs_more_newton_steps_and_ends_at_the_same_gain() -> None:
    problem = paper()
    found = NewtonADI(modes=0).solve(problem)
    assert found.counts["newton_steps"] > 1
    assert gain_error(problem, found, NewtonADI().solve(problem)) < 1e-9


@pytest.mark.parametrize(
    "method",
    [NewtonADI(modes=0, max_iterations=1), NewtonADI(max_solves=5), RADI(max_iterations=1), RADI(max_iterations=9)],
)
def test_unconverged_raises_with_value_tolerance_and_advice(method: NewtonADI | RADI) -> None:
    with pytest.raises(SolverError, match=r"residual .* after .* tolerance 1e-10; .*(use|add)"):
        method.solve(problem_of("one_way"))


def test_galerkin_that_has_not_settled_raises() -> None:
    with pytest.raises(SolverError, match="still changes by"):
        StructuredGalerkin(modes=3, max_iterations=1).solve(problem_of("one_way"))


def test_undamped_is_refused_with_the_way_out() -> None:
    problem = make_problem(build(make_scene({"control": NODE}), MPI.COMM_WORLD))
    for method in (NewtonADI(), RADI(), StructuredGalerkin()):
        with pytest.raises(ControlError, match=r"effects\.damping\.beta"):
            method.solve(problem)


def test_large_undamped_scene_is_diagnosed_not_refused_for_its_size() -> None:
    """What is wrong with it is the damping, not the memory of the dense method."""
    problem = paper("tissue.cells=[18,36]", "effects.damping.beta=0.0")
    assert problem.layout.states > DenseRiccati().limit
    with pytest.raises(ControlError, match=r"no damping: .* all 1366 modes, .*beta >= .* method modal_lqr"):
        solve(problem)


def test_factor_that_does_not_fit_is_refused_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of("cube")
    needed = factor_bytes(problem.layout.n_e, 3)
    for free, fits in ((1.01 * needed, True), (0.99 * needed, False)):
        monkeypatch.setattr("psutil.virtual_memory", lambda free=free: SimpleNamespace(available=free))
        if fits:
            make_shifted(problem.system, "distributed").destroy()
        else:
            with pytest.raises(ResourceError, match=r"n_e = \d+ in 3D\) needs about .* GiB are free"):
                make_shifted(problem.system, "distributed")


def test_inputs_on_the_tissue_without_a_hand() -> None:
    """n_s = 0, B = [0; B_z]: all three methods against the dense oracle."""
    problem = problem_of("one_way")
    layout = replace(problem.layout, n_s=0)
    none, thin = np.zeros((0, 0)), np.zeros((layout.n_local, 0))
    system = replace(problem.system, layout=layout, M_hand=none, M_rigid=none, G=thin, T=thin)
    bare = replace(problem, system=system, C_s=np.zeros((2, 0)), B_z=np.array(problem.system.G), R=np.eye(2))
    reference = DenseRiccati().solve(bare)
    for method, bound in ((NewtonADI(), 1e-9), (RADI(), 1e-9), (StructuredGalerkin(), 1e-5)):
        assert gain_error(bare, method.solve(bare), reference) < bound  # galerkin: 1e-6 in the energy norm


def test_bad_weights_and_numbers_are_refused() -> None:
    problem = problem_of("one_way")
    C_z = problem.C_z.copy()
    C_z[:1] = np.nan
    for bad, word in (
        (replace(problem, R=np.zeros((2, 2))), "R has the eigenvalue"),
        (replace(problem, Q=np.diag([1.0, -1.0])), "Q has the eigenvalue"),
        (replace(problem, Q=np.zeros((2, 2))), "zero"),
        (replace(problem, C_z=C_z), "finite"),
    ):
        with pytest.raises(ControlError, match=word):
            NewtonADI().solve(bad)


class _StopError(Exception):
    pass


def _stop_at(count: int) -> Callable[[dict[str, float]], None]:
    def observer(entry: dict[str, float]) -> None:
        if entry["solve"] == count:
            raise _StopError

    return observer


def test_resume_goes_on_where_it_stopped(mpi_tmp_path: Path) -> None:
    problem, folder = problem_of("one_way"), mpi_tmp_path / "restart"
    with pytest.raises(_StopError):
        NewtonADI(checkpoint=folder, checkpoint_every=5, progress=_stop_at(23)).solve(problem)
    seen: list[float] = []
    found = NewtonADI(checkpoint=folder, progress=lambda entry: seen.append(entry["solve"])).solve(problem)
    assert seen[0] == 21
    assert len(found.history) == found.counts["solves"]
    assert found.residual < 2e-10
    assert gain_error(problem, found, oracle("one_way")) < 1e-9


def test_foreign_restart_file_is_refused(mpi_tmp_path: Path) -> None:
    with pytest.raises(_StopError):
        NewtonADI(checkpoint=mpi_tmp_path, checkpoint_every=5, progress=_stop_at(8)).solve(problem_of("one_way"))
    with pytest.raises(CheckpointError, match="another control problem"):
        NewtonADI(checkpoint=mpi_tmp_path).solve(problem_of("two_way"))


def test_choice_names_its_reason() -> None:
    small, paper_like = problem_of("one_way"), paper()
    assert choose(small).method == "dense"
    assert choose(paper_like).method == "newton_adi"
    layers = make_problem(build(make_scene(*CASES["layers"], tissue={"cells": [6, 12]}), MPI.COMM_WORLD))
    assert choose(layers).method == "radi"
    assert "(chosen: asked for)" in solve(small, "galerkin").method
    with pytest.raises(SolverError, match="unknown"):
        solve(small, "magic")  # type: ignore[arg-type]


# --- the parts


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
    right = make_right(plant, solver, local)
    W_full, K_full = full[:, :1], full[:, 1:].T
    for p in (-0.7, -0.3 + 4.0j, -2.0 + 30.0j):
        V = closed_adjoint(plant, solver, p, right[:1], right[1:])
        B = space.B @ plant.B
        dense = np.linalg.solve((space.A - B @ K_full + p * space.E).T, W_full)
        stiff = plant.stiff(np.hstack([V.tall[:n].real, V.tall[:n].imag]))
        ours = np.vstack([V.hand, stiff[:, :1] + 1j * stiff[:, 1:], V.tall[n:]])
        theirs = np.vstack([dense[: 2 * s], dense[own], dense[below]])
        scale = np.abs(dense).max()
        assert np.abs(ours - theirs).max() < 1e-9 * scale  # condition of the dense matrix times rounding
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
    # with feedback, against the products written out
    W, gain = Block(V.hand[:, :2], np.sin(V.tall[:, :2])), Block(np.ones((2 * layout.n_s, 2)), np.cos(V.tall[:, 2:4]))
    F, G, seen, felt = energy_products(plant, V, W, gain)
    E_V, A_V = plant.mass_adjoint(V), plant.plant_adjoint(V)
    test = np.vstack([V.hand[: layout.n_s], np.linalg.solve(plant.M_s, E_V.hand[layout.n_s :])])
    for ours, X in ((F, A_V), (G, E_V), (seen, W), (felt, gain)):
        direct = total(layout.comm, V.tall.T @ X.tall) + test.T @ X.hand
        assert np.allclose(ours, direct, rtol=0, atol=1e-12 * np.abs(direct).max())  # rounding
    # span of whole state blocks of one eigenvector: its Ritz value is the eigenvalue
    start = modal_start(plant, 3)
    phi, omega = start.small.V[:, :1], start.small.omega[0]
    pair = np.zeros((2 * layout.n_local, 2))
    pair[: layout.n_local, :1], pair[layout.n_local :, 1:] = phi, phi
    hand = np.zeros((4, 2))
    hand[2:, 1:] = -np.linalg.solve(plant.M_s, total(layout.comm, plant.G.T @ phi))  # E'V has no row of the hand
    found, _ = ritz_pairs(plant, Block(hand, pair), Block(hand, pair), None)
    assert np.allclose(found.real, -0.003 * omega**2 / 2, rtol=1e-6)
    assert np.allclose(np.abs(found), omega, rtol=1e-6)


def test_clip_and_choice_of_shifts() -> None:
    limits = ShiftRange(0.01, 100.0, 50.0)
    assert limits.clip(-5.6e-11 + 0j) == -0.01  # the spurious Ritz value of the hand's zero poles
    assert abs(limits.clip(-1e4 + 1e4j)) == pytest.approx(100.0)
    assert limits.clip(2.0 - 3.0j) == pytest.approx(-2.0 + 3.0j)
    assert limits.clip(-0.0 + 5.0j).real < 0
    candidates = np.array([-1.0 + 0j, -1.0 + 10j, -1.0 + 20j])
    chosen = choose_shifts(candidates, np.array([1.0, 5.0, 3.0]), 3)
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
    assert residual(t) <= min(residual(s) for s in grid) * (1 + 1e-9)
    assert (before, after) == (pytest.approx(residual(0.0)), pytest.approx(residual(1.0)))
    mixed, weights = mixed_residual((blocks[0], signs), blocks[1], blocks[2], t)
    whole = np.vstack(comm.allgather(mixed.tall))
    assert np.linalg.norm((whole * weights) @ whole.T) == pytest.approx(residual(t))


def test_frequencies_fill_the_range() -> None:
    points = np.sort(frequencies(1.0, 100.0, 7))
    assert np.allclose(np.diff(np.log(points)), np.log(100.0) / 8)  # 7 inner points of 8 equal parts


def test_symmetric_sparse_copy_is_the_matrix() -> None:
    """Rows serve as columns in the gathered solver: that needs a symmetric matrix."""
    system: BlockSystem = problem_of("layers").system
    for A in (system.K_ee, system.M_ee, system.damping.matrix):
        whole = gather_matrix(system.layout, A)
        assert abs(whole - whole.T).max() < 1e-12 * abs(whole).max()  # order of summation in assembly


@pytest.mark.serial
def test_factors_of_a_helper_thread_are_freed() -> None:
    """SciPy frees the memory of a factor only in the thread that made it; forty of them hold 500 MB."""
    system = build(load_scene(SCENE, ["tissue.cells=[40,80]"]), MPI.COMM_SELF).system
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
