from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.petsc import on_root, total
from softgrasp.reduction.bases.engines import ENGINES, EngineName, factor, magnitude, small_svd, triangle
from softgrasp.reduction.bases.states import BasisError, Columns
from softgrasp.reduction.bases.svd_like import balanced, svd_like_pairs, symplectic_form
from softgrasp.reduction.bases.truncation import Part, Truncation, counts_of, needed
from tests.helpers.models import Array, close, same_everywhere

pytestmark = pytest.mark.ranks

EPS = np.finfo(float).eps
ACCURATE: tuple[EngineName, ...] = ("tsqr", "svd")


def rows_of(comm: MPI.Intracomm, X: Any) -> Any:
    """This rank's share of the rows."""
    n = len(X)
    return np.asfortranarray(X[n * comm.rank // comm.size : n * (comm.rank + 1) // comm.size])


def whole(comm: MPI.Intracomm, local: Any) -> Any:
    return np.vstack(comm.allgather(local))


def decaying(n: int, m: int, decades: float, rank: int | None = None, seed: int = 0) -> Array:
    """Random matrix with evenly spread singular values, zero from ``rank`` on."""
    random = np.random.default_rng(seed)
    U = np.linalg.qr(random.standard_normal((n, m)))[0]
    V = np.linalg.qr(random.standard_normal((m, m)))[0]
    s = 10.0 ** (-decades * np.arange(m) / (m - 1))
    s[rank or m :] = 0
    return (U * s) @ V


# --- accuracy


def test_gram_keeps_nothing_below_its_floor(comm: MPI.Intracomm) -> None:
    f = factor(comm, rows_of(comm, decaying(300, 60, 14)), "gram")
    s = small_svd(comm, f.R)[1]
    assert s[-1] > 5e-8 * s[0]  # 4 sqrt(eps) = 6e-8; below it is noise
    assert f.R.shape[0] < 40  # of 60, evenly over 14 decades: those above 6e-8 are 31


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("shape", [(400, 30), (60, 25), (25, 40), (20, 20), (5, 3)])
def test_factors_give_back_the_matrix(comm: MPI.Intracomm, engine: EngineName, shape: tuple[int, int]) -> None:
    full = np.random.default_rng(1).standard_normal(shape)
    X = rows_of(comm, full)
    before = X.copy()
    f = factor(comm, X, engine)
    assert np.array_equal(X, before)
    gram = total(comm, f.Q.T @ f.Q)
    assert np.abs(gram - np.eye(len(gram))).max() < 1e-13  # rounding of a QR
    assert close(f.scale * whole(comm, f.Q) @ f.R, full) < 1e-12  # condition below 1e3, rounding of the eigenvalues
    assert same_everywhere(comm, f.R)
    assert f.square * f.scale**2 == pytest.approx(np.sum(full**2), rel=1e-12)  # a sum of squares


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("kind", ["rank 3", "duplicates", "zero columns", "one column"])
def test_deficient_snapshots_have_the_right_rank(comm: MPI.Intracomm, engine: EngineName, kind: str) -> None:
    base = decaying(90, 12, 1, rank=3)
    full = {
        "rank 3": base,
        "duplicates": np.hstack([base[:, :3]] * 4),
        "zero columns": np.hstack([np.zeros((90, 4)), base[:, :3], np.zeros((90, 5))]),
        "one column": base[:, :1],
    }[kind]
    f = factor(comm, rows_of(comm, full), engine)
    u, s, _ = small_svd(comm, f.R)
    rank = int(np.sum(s > f.noise * s[0]))
    true = np.linalg.svd(full, compute_uv=False)
    assert rank == (1 if kind == "one column" else 3)
    assert close(s[:rank] * f.scale, true[:rank]) < 1e-13  # well conditioned
    U = whole(comm, f.Q @ u[:, :rank])
    assert close(U @ (U.T @ full), full) < 1e-12  # same span


@pytest.mark.parametrize("rows", [3, 40])  # fewer and more than columns on a rank of three
def test_triangle_folds_the_ranks_in_a_tree(comm: MPI.Intracomm, rows: int) -> None:
    X, top = decaying(rows * 3, 7, 3.0), np.ones((2, 7))
    R, expected = triangle(comm, rows_of(comm, X), top), np.linalg.qr(np.vstack([top, X]), mode="r")
    assert same_everywhere(comm, R)
    # triangles are equal but for the signs of rows; backward errors of 1e-16 grow by the condition 1e3
    assert np.abs(np.abs(R) - np.abs(expected)).max() < 1e-12


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("rows", [30, 61, 119, 120, 200])
def test_few_rows_a_rank_and_deficient_snapshots_keep_q_orthonormal(
    comm: MPI.Intracomm, engine: EngineName, rows: int
) -> None:
    full = decaying(rows, 24, 12, rank=9) @ np.eye(24, 40)
    sizes = [rows, 0, 0] if rows == 30 else [rows // 2, rows - rows // 2, 0]  # a rank may have none
    sizes = [*sizes[: comm.size - 1], rows - sum(sizes[: comm.size - 1])]
    start = sum(sizes[: comm.rank])
    f = factor(comm, np.asfortranarray(full[start : start + sizes[comm.rank]]), engine)
    gram = total(comm, f.Q.T @ f.Q)
    assert np.abs(gram - np.eye(len(gram))).max() < 1e-13  # rounding of a QR
    limit = 1e-7 if engine == "gram" else 1e-13  # its floor; rounding
    assert np.abs(f.scale * whole(comm, f.Q) @ f.R - full).max() < limit


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("size", [1e-300, 1e-160, 1e150, 1e300])
def test_scaled_snapshots_have_the_same_basis(comm: MPI.Intracomm, engine: EngineName, size: float) -> None:
    full = decaying(80, 10, 4)
    f = factor(comm, rows_of(comm, full * size), engine)
    s = small_svd(comm, f.R)[1]
    assert f.scale * s / size == pytest.approx(np.linalg.svd(full, compute_uv=False), rel=1e-9)  # eps * 1e4, and 1e2
    gram = total(comm, f.Q.T @ f.Q)
    assert np.abs(gram - np.eye(len(gram))).max() < 1e-13  # rounding of a QR


@pytest.mark.parametrize("engine", ["svd", "gram"])
def test_leading_triplets_of_engines_that_make_no_more(comm: MPI.Intracomm, engine: EngineName) -> None:
    full = decaying(200, 50, 12)
    f = factor(comm, rows_of(comm, full), engine, 8)
    s = small_svd(comm, f.R)[1][:8]
    assert f.R.shape[0] <= 22  # of 50
    # sigma_8 is 2e-2; the tolerance of the solver is 1e-13, Gram leaves eps over the square of sigma_8
    assert s * f.scale == pytest.approx(np.linalg.svd(full, compute_uv=False)[:8], rel=1e-10)
    assert f.square * f.scale**2 == pytest.approx(np.sum(full**2), rel=1e-12)  # a sum of squares


# --- refusals


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_is_refused_on_all_ranks(comm: MPI.Intracomm, engine: EngineName, bad: float) -> None:
    X = np.ones((20, 3), order="F")
    if comm.rank == comm.size - 1:
        X[4, 1] = bad
    with pytest.raises(BasisError, match="NaN or infinity"):
        factor(comm, X, engine)


def test_zero_and_unknown_are_refused(comm: MPI.Intracomm) -> None:
    with pytest.raises(BasisError, match="all snapshots are zero"):
        factor(comm, np.zeros((20, 3), order="F"))
    with pytest.raises(BasisError, match="'qr' is unknown; choose one of tsqr"):
        factor(comm, np.ones((20, 3), order="F"), "qr")  # type: ignore[arg-type]


def test_work_on_rank_0_fails_everywhere(comm: MPI.Intracomm) -> None:
    def fail() -> float:
        raise BasisError("no")

    with pytest.raises(BasisError, match="no"):
        on_root(comm, fail)
    assert on_root(comm, lambda: comm.rank) == 0


def test_magnitude_is_the_power_of_two_above_all_ranks(comm: MPI.Intracomm) -> None:
    assert magnitude(comm, np.full(3, -3.0 * (comm.rank + 1))) == 2.0 ** np.frexp(3.0 * comm.size)[1]
    assert magnitude(comm, np.zeros(3), np.zeros(0)) == 1.0


# --- SVD-like decomposition


def symplectic_error(S: Array) -> float:
    k = S.shape[1] // 2
    J = np.eye(2 * k, k=k) - np.eye(2 * k, k=-k)
    return float(np.abs(symplectic_form(S, S) - J).max())


def gone(S: Array, X: Array) -> float:
    """Norm of X - S S^+ X."""
    k = S.shape[1] // 2
    return float(np.linalg.norm(X - S[:, k:] @ symplectic_form(S[:, :k], X) + S[:, :k] @ symplectic_form(S[:, k:], X)))


def canonical_matrix(r: int, sigma: Array, isotropic: int, seed: int = 2) -> Array:
    """S D Q with symplectic S (orthosymplectic times shears), D = diag(sigma; sigma; isotropic part)."""
    random = np.random.default_rng(seed)
    U = np.linalg.qr(random.standard_normal((r, r)) + 1j * random.standard_normal((r, r)))[0]
    B = random.standard_normal((r, r)) / r
    S = np.block([[U.real, -U.imag], [U.imag, U.real]]) @ np.block(
        [[np.eye(r), B + B.T], [np.zeros((r, r)), np.eye(r)]]
    )
    k = len(sigma)
    D = np.zeros((2 * r, 2 * k + isotropic))
    D[:k, :k] = D[r : r + k, k : 2 * k] = np.diag(sigma)
    D[k : k + isotropic, 2 * k :] = np.eye(isotropic)
    return S @ D @ np.linalg.qr(random.standard_normal((2 * k + isotropic,) * 2))[0]


def test_svd_like_finds_small_pairs_that_one_eigenproblem_loses(comm: MPI.Intracomm) -> None:
    sigma = 10.0 ** -np.arange(0, 9.5, 0.5)  # sigma^2 spans 18 decades
    X = canonical_matrix(25, sigma, 0)
    S, w = svd_like_pairs(comm, X)
    k = len(sigma)
    assert S.shape == (50, 2 * k)
    assert symplectic_error(S) < 1e-12  # goal of the issue
    assert np.sum(w**2) == pytest.approx(np.sum(X**2), rel=1e-10)  # |X|_F^2 = sum w^2 [BBH19]
    assert gone(S, X) < 1e-12  # X lies in the span of S; its smallest pair is 1e-9
    found = np.sort(w / np.sqrt(np.sum(S[:, :k] ** 2 + S[:, k:] ** 2, axis=0)))[::-1]
    assert found == pytest.approx(sigma, rel=1e-5)  # eps sigma_1 / sigma_k, times |S|^2 ~ 10


@pytest.mark.parametrize("p", [0.0, 2.0])
def test_svd_like_finds_partners_for_directions_without(comm: MPI.Intracomm, p: float) -> None:
    X = canonical_matrix(12, np.array([1.0, 0.1]), 3)
    S, w = svd_like_pairs(comm, X)
    assert S.shape == (24, 10)  # two pairs, and three directions with partners from outside
    assert symplectic_error(S) < 1e-12  # goal of the issue
    assert gone(S, X) < 1e-12 * np.linalg.norm(X)  # rounding
    flat = np.vstack([np.eye(5), p * np.eye(5)])  # X'JX = 0
    S, w = svd_like_pairs(comm, flat)
    assert S.shape == (10, 10)
    assert symplectic_error(S) < 1e-12  # goal of the issue
    assert np.sum(w**2) == pytest.approx(np.sum(flat**2), rel=1e-12)  # |X|_F^2 = sum w^2 [BBH19]


def test_svd_like_takes_no_pair_of_almost_parallel_lagrangian_vectors(comm: MPI.Intracomm) -> None:
    q = np.eye(6)
    X = np.hstack([np.vstack([q, 0 * q]), np.vstack([0 * q, np.diag([1e-6] * 5 + [1.0])])])
    S, _ = svd_like_pairs(comm, X)
    assert symplectic_error(S) < 1e-12  # pairs of norm 1e3 would leave eps * 1e6
    assert np.abs(S).max() < 20  # square root of the bound on |s|^2 + |t|^2
    assert gone(S, X) < 1e-12 * np.linalg.norm(X)  # rounding


@pytest.mark.parametrize("seed", [151, 188])
def test_svd_like_splits_directions_that_have_no_polar_factor_together(comm: MPI.Intracomm, seed: int) -> None:
    """Long pairs and directions without partner: remainders grew to infinity, or columns became dependent."""
    random, r = np.random.default_rng(seed), 8
    H = random.normal(size=(2 * r, 2 * r))
    H = (H + H.T) / 2
    J = np.eye(2 * r, k=r) - np.eye(2 * r, k=-r)
    S = scipy.linalg.expm(6.0 * J @ H / np.linalg.norm(H, 2))  # symplectic
    n = random.integers(2, 5)
    w = 10.0 ** -np.sort(random.uniform(0, 6, r))
    X = np.hstack([S[:, :n] * w[:n], S[:, r : r + n] * w[:n], S[:, n:r] * w[n:]])
    X = X @ np.linalg.qr(random.normal(size=(30, X.shape[1])))[0].T
    found, _ = svd_like_pairs(comm, X)
    assert symplectic_error(found) < 1e-9  # rounding of pairs of squared length 1e4
    assert gone(found, X) < 1e-8 * np.linalg.norm(X)


def test_svd_like_stops_at_the_limit_with_the_heaviest_pairs(comm: MPI.Intracomm) -> None:
    X = canonical_matrix(20, 10.0 ** -np.arange(0, 7.5, 0.5), 0)
    S, w = svd_like_pairs(comm, X)
    few, v = svd_like_pairs(comm, X, 4)
    assert len(v) < len(w)
    assert v[:4] == pytest.approx(w[:4], rel=1e-9)  # the same pairs; rounding
    k, m = len(w), len(v)
    for j in range(4):
        pairs = S[:, [j, k + j]], few[:, [j, m + j]]
        assert scipy.linalg.subspace_angles(*pairs).max() < 1e-6  # square root of rounding


@pytest.mark.parametrize("share", [1e-3, 1e-8])
def test_svd_like_stops_when_the_energy_is_kept(comm: MPI.Intracomm, share: float) -> None:
    X = canonical_matrix(20, 10.0 ** -np.arange(0, 7.5, 0.5), 0)
    w = svd_like_pairs(comm, X)[1]
    few = svd_like_pairs(comm, X, 0, share)[1]
    assert len(few) < len(w)
    assert few == pytest.approx(w[: len(few)], rel=1e-6)  # the heaviest, in order; rounding over the smallest of them
    square = float(np.sum(X**2))
    assert needed(few, square, share) == needed(w, square, share)


def test_svd_like_does_not_depend_on_units(comm: MPI.Intracomm) -> None:
    X = canonical_matrix(10, np.array([1.0, 0.3, 0.1, 0.01]), 0)
    t = np.repeat([1e5, 1e-5], 10)[:, None]
    S, T = svd_like_pairs(comm, X)[0], svd_like_pairs(comm, t * X)[0] / t
    assert gone(S, T) < 1e-9 * np.linalg.norm(T)  # same span: eps * 1e4 of the smallest pair, times |S|^2


def test_balanced_pairs_keep_product_and_span() -> None:
    S, T = np.random.default_rng(5).standard_normal((2, 12, 7)) * [[[1.0]], [[30.0]]]
    S_b, T_b = balanced(S, T)
    assert np.linalg.norm(S_b, axis=0) == pytest.approx(np.linalg.norm(T_b, axis=0), rel=1e-12)  # rounding
    assert np.diag(symplectic_form(S_b, T_b)) == pytest.approx(
        np.diag(symplectic_form(S, T)), rel=1e-12, abs=1e-12
    )  # rounding
    for j in range(7):
        assert (
            scipy.linalg.subspace_angles(np.c_[S[:, j], T[:, j]], np.c_[S_b[:, j], T_b[:, j]]).max() < 1e-6
        )  # sqrt eps


# --- truncation


def part(sigma: list[float], rank: int | None = None) -> Part:
    s = np.array(sigma)

    def columns(k: int) -> tuple[Columns, ...]:
        raise AssertionError("nobody asked for columns")

    return Part("states", s, float(np.sum(s**2)), len(s) if rank is None else rank, columns)


def test_needed_counts_the_tail() -> None:
    s = np.array([1.0, 0.1, 0.01, 1e-9])
    square = float(np.sum(s**2))
    assert needed(s, square, 0.02) == 1
    assert needed(s, square, 0.009) == 2
    assert needed(s, square, 5e-18) == 3  # total minus a running sum would not see 1e-18
    assert needed(s, square, 1e-19) == 4
    assert needed(s[:2], square, 1e-6) is None  # 1e-4 of the total is not among the values
    assert needed(np.zeros(0), 0.0, 0.5) == 0


def test_parts_share_columns_equally() -> None:
    a, b = part([10.0, 1.0, 0.1]), part([1e-3, 9e-4, 8e-4])
    assert counts_of([a, b], 1, 0, Truncation(N=1), "x") == (1, 0)
    assert counts_of([a, b], 1, 0, Truncation(N=4), "x") == (2, 2)  # by sigma^2 over its sum the second would get 3
    assert counts_of([a, b], 1, 4, Truncation(N=9), "x") == (3, 2)
    assert counts_of([part([1.0, 0.5], 1), b], 1, 0, Truncation(N=4), "x") == (
        1,
        3,
    )  # what a part cannot carry goes to the other
    assert counts_of([part([1.0, 0.5, 0.1])], 2, 4, Truncation(N=8), "x") == (2,)
    assert counts_of([a, b], 1, 0, Truncation(energy=0.98), "x") == (3, 3)  # alone the first needs 1
    assert counts_of([a, b], 1, 0, Truncation(tol=0.2), "x") == (3, 3)
    assert counts_of([a, b], 1, 0, Truncation(tol=0.6), "x") == (2, 2)
    assert counts_of([part([1.0, 0.5], 1), b], 1, 0, Truncation(tol=0.6), "x") == (1, 2)


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ({"N": 3}, "N = 3 does not fit; it must be the 4 columns of the hand plus an even number"),
        ({"N": 4}, "N = 4 does not fit"),
        ({"N": 7}, "N = 7 does not fit"),
        ({"N": 12}, "more than the snapshots carry above rounding .6 . 4 of the hand.; request N <= 10"),
        ({"tol": 1e-3}, "cannot be kept to 1.0e-06 of its energy with the 3 singular values"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(rule: dict[str, Any], words: str) -> None:
    with pytest.raises(BasisError, match=words):
        counts_of([part([1.0, 0.5, 0.1, 0.01], 3)], 2, 4, Truncation(**rule), "psd_fixed")


@pytest.mark.parametrize("rule", [{}, {"N": 4, "tol": 0.1}, {"energy": 1.0}, {"tol": 0.0}, {"N": 0}])
def test_rules_that_make_no_sense_are_refused(rule: dict[str, Any]) -> None:
    with pytest.raises(BasisError):
        Truncation(**rule)
