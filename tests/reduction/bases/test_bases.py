"""Structure of all bases, how many vectors, coordinates and coupling, Craig-Bampton."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from softgrasp.fem.run.states.snapshots import Snapshots
from softgrasp.fem.solve.statics import solve_columns
from softgrasp.reduction.bases.engines import ENGINES, EngineName
from softgrasp.reduction.bases.inner import INNERS, InnerName, orthonormality
from softgrasp.reduction.bases.registry import METHODS, PAPER_METHODS, make_bases, make_basis
from softgrasp.reduction.bases.states import BasisError, states_of
from softgrasp.reduction.bases.svd_like import symplectic_repair
from softgrasp.reduction.bases.truncation import Truncation
from softgrasp.reduction.projection import project
from tests.helpers.models import close, gather_rows
from tests.helpers.snapshots import (
    CANONICAL,
    ORTHONORMAL,
    SNAPSHOT_METHODS,
    Case,
    basis_halves,
    case,
    dense,
    gap,
    halves,
    snapshot_rows,
    symplecticity,
)

# --- structure of all bases


@pytest.mark.parametrize("inner", INNERS)
def test_columns_are_orthonormal_in_their_inner_product(inner: InnerName) -> None:
    c = case()
    for key in ORTHONORMAL:
        for basis in make_bases(key, c.states, (8, 20), inner):
            assert basis.inner == inner
            # goals of the issue: V'V = I to 1e-12, weighted to 1e-10
            assert orthonormality(basis, c.model.system) < (1e-12 if inner == "euclidean" else 1e-10), key


@pytest.mark.parametrize("inner", INNERS)
def test_canonical_bases_are_symplectic(inner: InnerName) -> None:
    c = case()
    for key in CANONICAL:
        for basis in make_bases(key, c.states, (8, 14, 40), inner):
            assert symplecticity(basis) < 1e-12, key  # goal of the issue
            q, p = basis_halves(basis)
            B = q.T @ p
            k = B.shape[0] // 2
            J = np.eye(2 * k, k=k) - np.eye(2 * k, k=-k)
            assert np.abs(B - B.T - J).max() < 1e-12, key  # the same from the gathered rows


@pytest.mark.parametrize("key", ["componentwise_pod", "pod_fixed_relative", "psd_qv", "psd_fixed", "craig_bampton"])
def test_blocks_have_their_shapes_and_the_hand_its_columns(key: str) -> None:
    c, method = case(), METHODS[key]
    layout = c.model.system.layout
    basis = make_basis(key, c.states, 12)
    assert basis.N == 12
    assert basis.name == key
    assert (basis.coordinates, basis.frame, basis.structure) == (method.coordinates, method.frame, method.structure)
    for block, rows in ((basis.V_sq, layout.n_s), (basis.V_sv, layout.n_s)):
        assert block.shape == (rows, 12)
    for block in (basis.V_q, basis.V_p):
        assert block.shape == (layout.n_local, 12)
        assert block.flags.f_contiguous
    V = dense(basis)
    assert np.linalg.matrix_rank(V) == 12
    if method.fixed:
        n_s = layout.n_s
        assert np.array_equal(V[: 2 * n_s, : 2 * n_s], np.eye(2 * n_s))
        assert not V[: 2 * n_s, 2 * n_s :].any()
        assert not V[2 * n_s :, : 2 * n_s].any()


def test_a_sweep_gives_the_same_as_one_by_one() -> None:
    c = case()
    for key in SNAPSHOT_METHODS:
        large, small = make_bases(key, c.states, (16, 8))
        alone = make_basis(key, c.states, 8)
        assert close(dense(small), dense(alone)) < 1e-9, key  # the same columns; rounding over the gaps
        V = dense(large)
        left = dense(small) - V @ np.linalg.lstsq(V, dense(small), rcond=None)[0]
        assert np.linalg.norm(left) < 1e-12 * np.linalg.norm(V), key  # nested, to rounding


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("key", ["global_pod", "componentwise_pod_fixed", "psd_fixed", "psd_svd_like_fixed"])
def test_engines_give_one_subspace(key: str, engine: EngineName) -> None:
    c = case()
    size = 8
    first = make_basis(key, c.states, size)
    # Gram leaves out what is below 6e-8 of the snapshots; pairs feel it over their sigma_k^2 ~ 1e-2, and vectors joined
    # from two halves over their sigma_k ~ 1e-2
    tolerance = 1e-4 if engine == "gram" and key in ("global_pod", "psd_svd_like_fixed") else 1e-7
    assert gap(dense(first), dense(make_basis(key, c.states, size, engine=engine))) < tolerance


# --- how many


@pytest.mark.parametrize("key", PAPER_METHODS)
def test_energy_of_the_paper_is_kept(key: str) -> None:
    c = case()
    basis = make_basis(key, c.states)
    q, p = halves(c, key)
    V_q, V_p = basis_halves(basis)
    V, X = np.vstack([V_q, V_p]), np.vstack([q, p])
    parts = [(V, X)] if "componentwise" not in key else [(V_q, q), (V_p, p)]
    for W, Y in parts:
        W = W[:, np.abs(W).max(axis=0) > 0]
        kept = np.linalg.norm(W.T @ Y) ** 2 / np.linalg.norm(Y) ** 2
        # the complex SVD keeps 99.9 % of |q|^2 + |p|^2 too, because V'V = I
        assert kept >= 0.999 - 1e-12
    assert basis.N < 20


def test_tolerance_bounds_the_projection_error() -> None:
    c = case()
    X = np.vstack(halves(c, "pod_fixed"))
    coarse, fine = make_bases("pod_fixed", c.states, (Truncation(tol=1e-2), Truncation(tol=1e-5)))
    for basis, tol in ((coarse, 1e-2), (fine, 1e-5)):
        V = np.vstack(basis_halves(basis))
        assert np.linalg.norm(X - V @ (V.T @ X)) <= tol * np.linalg.norm(X) * (1 + 1e-6)  # rounding of the tail
        less = V[:, :-1]
        assert np.linalg.norm(X - less @ (less.T @ X)) > tol * np.linalg.norm(X)  # no vector too many
    assert coarse.N < fine.N


def test_n_of_the_full_dimension_is_the_whole_space() -> None:
    c = case()
    full = 2 * (c.n + c.model.system.layout.n_s)
    layout = c.model.system.layout
    # every unit vector once: columns of the identity, cut to this rank's rows
    Z = np.asfortranarray(np.eye(2 * c.n, full)[_own(c)])
    hand = np.eye(2 * layout.n_s, full, k=2 * c.n)
    steps = np.arange(full)
    s = Snapshots(layout, steps, 0.1 * steps, hand[: layout.n_s], hand[layout.n_s :], Z)
    for key in ("global_pod", "pod_fixed", "psd", "psd_fixed", "componentwise_pod", "psd_cotangent_lift_fixed"):
        V = dense(make_basis(key, states_of(c.model.system, s), full, "euclidean"))
        assert V.shape == (full, full)
        assert np.linalg.cond(V) < 1 + 1e-10  # orthogonal to rounding


def _own(c: Case) -> Any:
    """Rows of [z; v] that this rank owns, in global numbers."""
    layout = c.model.system.layout
    mine = np.arange(layout.start, layout.start + layout.n_local)
    return np.r_[mine, c.n + mine]


# --- coordinates, frames and coupling


@pytest.mark.parametrize("frame", ["absolute", "relative"])
@pytest.mark.parametrize("coordinates", ["qv", "qp"])
def test_blocks_follow_the_paper(coordinates: Any, frame: Any) -> None:
    c = case()
    blocks = c.states.columns(coordinates, frame)
    s_q, s_p, e_q, e_p = snapshot_rows(c, coordinates, frame)
    assert np.array_equal(blocks.s_q, s_q)
    assert np.array_equal(blocks.s_p, s_p)
    assert close(gather_rows(c.model.system.layout, blocks.e_q), e_q) < 1e-13  # rounding
    assert close(gather_rows(c.model.system.layout, blocks.e_p), e_p) < 1e-12  # rounding, with M T cancelling


def test_two_way_momentum_of_the_hand_is_that_of_the_whole_mass_matrix() -> None:
    c = case(two_way=True)
    system, q_s, v_s = c.model.system, c.snapshots.q_s, c.snapshots.v_s
    assert q_s.any()
    M_es = c.G - c.M @ c.T
    tissue = system.M_rigid - M_es.T @ c.T - c.T.T @ M_es - c.T.T @ c.M @ c.T  # R' M_h R on the contact nodes
    p_s = (system.M_hand + tissue) @ v_s + M_es.T @ (c.v + c.T @ v_s)
    assert close(c.states.columns("qp", "absolute").s_p, p_s) < 1e-12  # rounding
    assert symplecticity(make_basis("psd", c.states, 8)) < 1e-12  # goal of the issue
    for key in ("psd_relative", "psd_svd_like_relative"):
        with pytest.raises(BasisError, match="no canonical momentum"):
            make_basis(key, c.states, 8)


# --- Craig-Bampton


def test_craig_bampton_is_mass_orthonormal_and_diagonal_in_energy() -> None:
    c = case()
    alone = states_of(c.model.system)
    basis = make_basis("craig_bampton", alone, 4 + 2 * 6)
    assert basis.structure == "second_order"
    assert orthonormality(basis, c.model.system) < 1e-10  # goal of the issue
    q, v = basis_halves(basis)
    Phi = q[:, :6]
    assert np.array_equal(Phi, v[:, 6:])
    omega2 = scipy.linalg.eigh(c.K, c.M, eigvals_only=True)[:6]
    reduced = Phi.T @ c.K @ Phi
    assert np.diag(reduced) == pytest.approx(omega2, rel=1e-8)  # what softgrasp.fem.solve.modes lets pass
    assert np.abs(reduced - np.diag(np.diag(reduced))).max() < 1e-7 * omega2[-1]  # residual of the modes
    with pytest.raises(BasisError, match="give N"):
        make_basis("craig_bampton", alone)
    with pytest.raises(BasisError, match="leave inner out"):
        make_basis("craig_bampton", alone, 8, "energy")


def test_craig_bampton_frequencies_bound_the_full_ones_and_converge() -> None:
    """A free hand that feels the tissue: the interface modes matter, and no reduced mode is a full one."""
    c = case(two_way=True)
    system = c.model.system
    n_s = system.layout.n_s
    M = np.block([[system.M_hand + system.M_rigid, c.G.T], [c.G, c.M]])
    exact = np.sqrt(scipy.linalg.eigvalsh(scipy.linalg.block_diag(np.zeros((n_s, n_s)), c.K), M)[n_s:])
    errors = []
    for modes in (2, 4, 8, 16, 32, 48):
        basis = make_basis("craig_bampton", states_of(system), 2 * (n_s + modes))
        values = project(basis, system).at().spectrum.eigenvalues.imag
        found = np.sort(values[values > 0])
        assert len(found) == modes
        assert (found > exact[:modes] * (1 - 1e-9)).all()  # Rayleigh's principle; the modes are right to 1e-8
        errors.append(float(found[0] / exact[0] - 1))
    assert errors[0] > 1e-4  # far above rounding: the bound says something
    assert all(late < early for early, late in pairwise(errors))
    assert errors[-1] < errors[0] / 100  # a mode of frequency w adds a share of about 1 / w^4


def test_solving_columns_undoes_the_matrix() -> None:
    c = case()
    system = c.model.system
    X = c.snapshots.Z[: system.layout.n_local, 5:8]
    Y = gather_rows(system.layout, solve_columns(system.K_ee, system.layout, X))
    assert close(c.K @ Y, gather_rows(system.layout, X)) < 1e-11  # condition below 1e4


def test_singular_pairs_are_refused_in_one_sentence() -> None:
    with pytest.raises(BasisError, match="use a smaller N or another basis"):
        symplectic_repair(np.zeros((4, 4)))
