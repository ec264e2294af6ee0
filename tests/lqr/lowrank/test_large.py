"""Low-rank Riccati solvers against the dense oracle, against each other, and on every road through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

import softgrasp.lqr.lowrank.adi
from softgrasp.fem.errors import CheckpointError, ResourceError, SolverError
from softgrasp.fem.model.build import build
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.lowrank.adjoint import AdjointRhs
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.memory import HELD, LU_BYTES, gathered_bytes, shifted_factor_bytes
from softgrasp.lqr.lowrank.newton import Iteration, NewtonADI, load_state
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.lowrank.shifted import GatheredTissue, make_shifted
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.reduced.riccati import tissue_gain_error
from softgrasp.lqr.riccati import choose, solve
from tests.helpers.models import make_scene
from tests.helpers.riccati import CASES, NODE, gain, gain_error, oracle, paper, problem_of, x_error

# --- the solution


@pytest.mark.parametrize("name", list(CASES))
def test_newton_and_radi_equal_the_dense_oracle(name: str) -> None:
    """Two recursions with nothing but the tissue solve in common, and an oracle with not even that."""
    problem = problem_of(name)
    for method in (NewtonADI(), RADI()):
        found = method.solve(problem)
        assert found.residual < 2e-10  # 1e-10 of the recursion and what compression may add
        assert gain_error(problem, found, oracle(name)) < 1e-9  # a residual of 1e-10 leaves much less in the gain
        assert x_error(problem, found, oracle(name)) < 1e-9  # as of the gain; 2e-12 measured
        assert found.rank < problem.layout.states


@pytest.mark.parametrize("name", ["one_way", "two_way", "two_way_drag_in_space", "layers", "cube", "cube_two_way"])
def test_galerkin_gain_is_as_good_as_it_says(name: str) -> None:
    problem = problem_of(name)
    found = StructuredGalerkin().solve(problem)
    assert found.history[-1]["change"] <= 1e-6  # its own tolerance
    assert gain_error(problem, found, oracle(name)) < 1e-6  # the promise of the tolerance
    assert found.counts["solves"] <= 20
    last, exact = found.history[-1], oracle(name).gain
    # each part by its own norm: the change between two spaces says how far the later one is off
    assert tissue_gain_error(problem, exact, found.gain) <= max(last["change_tissue"], 1e-8)  # 1e-8: the oracle's
    hand = np.linalg.norm(found.gain.K_s - exact.K_s) / np.linalg.norm(exact.K_s)
    assert hand <= max(last["change_hand"], 1e-8)


@pytest.mark.parametrize(("beta", "weight"), [(0.02, 1.0), (0.002, 1.0), (0.002, 100.0), (0.002, 1e4), (2e-4, 1.0)])
def test_paper_scene_over_damping_and_weight(beta: float, weight: float) -> None:
    """Residual, agreement of two methods, and the identities that hold for every mesh and material."""
    problem = paper(f"effects.damping.beta={beta}", f"control.Q={weight}")
    newton, radi = NewtonADI().solve(problem), RADI().solve(problem)
    assert max(newton.residual, radi.residual) < 2e-10  # as above
    assert gain_error(problem, newton, radi) < 1e-8  # at Q = 1e4 the gain is 100 times the residual's scale
    assert newton.counts["newton_steps"] <= 2  # one, unless Q is large on a coarse mesh
    # whole body displaced: hand-relative state [I; 0; 0; 0], (K x_T)'(K x_T) = Q
    K_q, K_v = newton.gain.K_s[:, :2], newton.gain.K_s[:, 2:]
    assert np.allclose(K_q.T @ K_q, weight * np.eye(2), rtol=0, atol=1e-9 * weight)  # a residual of 2e-10
    # whole body moving: (K x_T)'(K v_T) = x_T'E'XE x_T, E x_T = [I; 0; 0; 0]
    E_x = newton.factor.hand[:2]
    assert np.allclose(K_q.T @ K_v, E_x @ E_x.T, rtol=0, atol=1e-8 * np.abs(K_q.T @ K_v).max())  # as above


@pytest.mark.slow
@pytest.mark.parametrize("beta", [0.02, 0.002, 2e-4])
def test_paper_size_against_the_oracle(beta: float) -> None:
    """2n = 880 for Q = 1, 100, 1e4."""
    for weight in (1.0, 100.0, 1e4):
        problem = paper("tissue.cells=[10,20]", f"effects.damping.beta={beta}", f"control.Q={weight}")
        reference = DenseRiccati(tolerance=1e-6).solve(problem)
        for method in (NewtonADI(), RADI()):
            found = method.solve(problem)
            assert found.residual < 2e-10  # as above
            assert gain_error(problem, found, reference) < 1e-6  # accuracy of the oracle
            assert x_error(problem, found, reference) < 1e-6  # as above
        galerkin = StructuredGalerkin().solve(problem)
        assert gain_error(problem, galerkin, reference) < 2e-6  # its own 1e-6 and the oracle's


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


@pytest.mark.ranks
def test_same_result_on_every_rank_count() -> None:
    """A rank by itself solves the same scene; the parallel gain is the same."""
    problem = problem_of("one_way")
    alone = make_problem(build(make_scene(*CASES["one_way"]), comm=MPI.COMM_SELF))
    reference = gain(alone, NewtonADI().solve(alone))
    for method in (NewtonADI(), NewtonADI(tissue="distributed"), RADI(), RADI(tissue="distributed")):
        found = method.solve(problem)
        assert found.about.endswith("by MUMPS" if method.tissue == "distributed" else "by SuperLU")
        error = np.linalg.norm(gain(problem, found) - reference) / np.linalg.norm(reference)
        assert error < 1e-9  # both stop at a residual of 1e-10
        assert len(set(problem.layout.comm.allgather(found.gain.K_s.tobytes()))) == 1


# --- roads and refusals


def test_rigid_start_needs_more_newton_steps_and_ends_at_the_same_gain() -> None:
    problem = paper()
    found = NewtonADI(modes=0).solve(problem)
    assert found.counts["newton_steps"] > 1
    assert gain_error(problem, found, NewtonADI().solve(problem)) < 1e-9  # both stop at a residual of 1e-10


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


def test_numbers_that_are_not_finite_stop_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    real = softgrasp.lqr.lowrank.adi.gram
    monkeypatch.setattr(softgrasp.lqr.lowrank.adi, "gram", lambda *blocks: real(*blocks) * np.nan)
    with pytest.raises(SolverError, match="diverges after 1 solves"):
        NewtonADI().solve(problem_of("one_way"))


def test_undamped_is_refused_with_the_way_out() -> None:
    problem = make_problem(build(make_scene({"control": NODE}), comm=MPI.COMM_WORLD))
    for method in (NewtonADI(), RADI(), StructuredGalerkin()):
        with pytest.raises(ControlError, match=r"effects\.damping\.beta"):
            method.solve(problem)


def test_large_undamped_scene_is_diagnosed_not_refused_for_its_size() -> None:
    """What is wrong with it is the damping, not the memory of the dense method."""
    problem = paper("tissue.cells=[18,36]", "effects.damping.beta=0.0")
    assert problem.layout.states > DenseRiccati().limit
    with pytest.raises(ControlError, match=r"no damping: .* all 1366 modes, .*beta >= .* control.method = 'modal'"):
        solve(problem)


def test_factor_that_does_not_fit_is_refused_before_it_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of("cube")
    needed = shifted_factor_bytes(problem.layout.n_e, 3)
    for free, fits in ((1.01 * needed, True), (0.99 * needed, False)):
        monkeypatch.setattr("psutil.virtual_memory", lambda free=free: SimpleNamespace(available=free))
        if fits:
            make_shifted(problem.system, "distributed").destroy()
        else:
            with pytest.raises(ResourceError, match=r"n_e = \d+ in 3D\) needs about .* GiB are free"):
                make_shifted(problem.system, "distributed")


def test_whole_matrices_and_factors_on_each_rank_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    system = paper("tissue.cells=[20,40]").system
    layout, needed = system.layout, gathered_bytes(system.layout.n_e, 2, 1, ahead=False)
    tissue = GatheredTissue(system)
    tissue.solve(-1 + 30j, np.zeros((layout.n_local, 2)))
    factor = tissue.cache[-1 + 30j][1]
    assert factor is not None
    held = HELD * factor.nnz * LU_BYTES
    held += sum(A.data.nbytes + A.indices.nbytes for A in (tissue.K, tissue.M, tissue.shells[0]))
    tissue.destroy()
    assert (
        1 <= needed / held < 1.5
    )  # the number of entries is estimated, 1.2 times what it is; indices are counted once
    for free, fits in ((1.01 * needed, True), (0.99 * needed, False)):
        monkeypatch.setattr("psutil.virtual_memory", lambda free=free: SimpleNamespace(available=free))
        if fits:
            make_shifted(system, "gathered").destroy()
        else:
            with pytest.raises(ResourceError, match=r"n_e = \d+ in 2D\) needs about .* GiB are free"):
                make_shifted(system, "gathered")


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
        NewtonADI(checkpoint=folder, checkpoint_every=5, checkpoint_after=0.0, progress=_stop_at(23)).solve(problem)
    seen: list[float] = []
    found = NewtonADI(checkpoint=folder, progress=lambda entry: seen.append(entry["solve"])).solve(problem)
    assert seen[0] == 21
    assert len(found.history) == found.counts["solves"]
    assert found.residual < 2e-10  # as above
    assert gain_error(problem, found, oracle("one_way")) < 1e-9  # a residual of 1e-10, as above


def test_foreign_restart_file_is_refused(mpi_tmp_path: Path) -> None:
    layers = problem_of("layers")
    tougher = tuple(replace(m, beta=1.1 * m.beta) for m in layers.system.materials)
    other = replace(layers, system=layers.system.with_materials(tougher))
    for name, mine, foreign in (("hand", problem_of("one_way"), problem_of("two_way")), ("layers", layers, other)):
        folder = mpi_tmp_path / name
        with pytest.raises(_StopError):
            NewtonADI(checkpoint=folder, checkpoint_every=5, checkpoint_after=0.0, progress=_stop_at(8)).solve(mine)
        with pytest.raises(CheckpointError, match="another control problem"):
            NewtonADI(checkpoint=folder).solve(foreign)


def test_every_damage_of_a_restart_file_of_newton_is_refused(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    problem, folder = problem_of("one_way"), mpi_tmp_path / "restart"
    with pytest.raises(_StopError):
        NewtonADI(checkpoint=folder, checkpoint_every=5, checkpoint_after=0.0, progress=_stop_at(8)).solve(problem)
    plant, random, nothing = Plant(problem), np.random.default_rng(3), np.zeros((0, 0))
    for path in (folder / f"newton-solve5-rank{comm.size - 1}.npz", folder / "newton.json"):
        good = path.read_bytes()
        bits = [(int(random.integers(len(good))), 1 << int(random.integers(8))) for _ in range(8)]
        flipped = [good[:i] + bytes([good[i] ^ bit]) + good[i + 1 :] for i, bit in bits]
        for bad in (*flipped, good[: len(good) // 2], b"", b"PK\x03\x04", b"[]"):
            comm.Barrier()
            if comm.rank == 0:
                path.write_bytes(bad)
            comm.Barrier()
            with pytest.raises(CheckpointError, match=rf"{path.name} .*remove the folder"):
                load_state(folder, plant, Iteration(AdjointRhs(nothing, nothing)), 1e-10)
        comm.Barrier()
        if comm.rank == 0:
            path.write_bytes(good)
        comm.Barrier()
    if comm.rank == 0:
        (folder / f"newton-solve5-rank{comm.size - 1}.npz").unlink()
    comm.Barrier()
    with pytest.raises(CheckpointError, match=r"cannot be read .*remove the folder"):
        NewtonADI(checkpoint=folder).solve(problem)


def test_choice_names_its_reason() -> None:
    small, paper_like = problem_of("one_way"), paper()
    assert choose(small).method == "dense"
    assert choose(paper_like).method == "newton_adi"
    layers = make_problem(build(make_scene(*CASES["layers"], tissue={"cells": [6, 12]}), comm=MPI.COMM_WORLD))
    assert choose(layers).method == "radi"
    assert solve(small, "galerkin").reason == "requested"
    assert choose(small, "newton-adi").method == choose(small, "newton_adi").method == "newton_adi"  # as scenes say it
    with pytest.raises(SolverError, match="unknown"):
        solve(small, "magic")  # type: ignore[arg-type]
