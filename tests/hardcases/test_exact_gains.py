"""The yardstick of the Riccati cases: exact gains against 256-bit arithmetic, and gains that must not pass."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import acb_mat, arb_mat, ctx

from softgrasp.fem.petsc import Array
from softgrasp.lqr.dense.modal import DenseRiccati, relative_space
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from tests.hardcases import riccati as hard_riccati
from tests.hardcases.cases import HardCase
from tests.hardcases.gains import GainBounds, exact_gain, worst_part_error
from tests.hardcases.riccati import gain_rows, problem_of

pytestmark = pytest.mark.serial


def gain_by_eigenvectors(problem: RiccatiProblem) -> Array:
    """K from the stable eigenvectors [U; V] of the Hamiltonian matrix, X = V U^{-1} [L79], in 256-bit arithmetic."""
    space = relative_space(problem)
    assert space is not None
    E, A, B, C, Q, R = (arb_mat(M.tolist()) for M in (space.E, space.A, space.B, space.C, problem.Q, problem.R))
    a, b = E.solve(A), E.solve(B)
    n = a.nrows()
    blocks = ((a, -b * R.solve(b.transpose())), (-(C.transpose() * Q * C), -a.transpose()))
    hamiltonian = [[blocks[i // n][j // n][i % n, j % n] for j in range(2 * n)] for i in range(2 * n)]
    values, vectors = acb_mat(hamiltonian).eig(right=True, algorithm="approx")
    stable = [j for j in range(2 * n) if float(values[j].real.mid()) < 0]
    assert len(stable) == n
    U, V = (acb_mat([[vectors[i, j].mid() for j in stable] for i in range(m, m + n)]) for m in (0, n))
    X = U.transpose().solve(V.transpose(), algorithm="approx").transpose()
    K = acb_mat(R).solve(acb_mat(b.transpose()) * X)
    return -np.array([[float(K[i, j].real.mid()) for j in range(n)] for i in range(K.nrows())])


@pytest.mark.parametrize(("beta", "r"), [(0.002, 1e-12), (0.002, 1e12), (2e-14, 1.0)])
def test_exact_gain_against_eigenvectors_in_256_bits(beta: float, r: float) -> None:
    """No step in common: neither Newton's method nor modes nor a start in doubles."""
    problem = problem_of("tissue.cells=[1, 2]", beta=beta)
    problem = replace(problem, R=r * problem.R)
    precision, ctx.prec = ctx.prec, 256
    try:
        K = gain_by_eigenvectors(problem)
    finally:
        ctx.prec = precision
    # both are rounded to doubles at their very end
    assert worst_part_error(exact_gain(problem), K, problem.layout.n_s) <= np.finfo(float).eps


def without_tissue(solve: Callable[..., RiccatiSolution]) -> Callable[..., RiccatiSolution]:
    def bare(self: Any, problem: RiccatiProblem) -> RiccatiSolution:
        answer = solve(self, problem)
        K = answer.gain
        return replace(answer, gain=replace(K, K_z=np.zeros_like(K.K_z), K_v=np.zeros_like(K.K_v)))

    return bare


@pytest.mark.parametrize("rows", [hard_riccati.weight_rows, hard_riccati.output_rows, hard_riccati.lqr_damping_rows])
def test_a_gain_that_leaves_the_tissue_out_fails(
    rows: Callable[[bool], Iterator[HardCase]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gain for the hand is right to the last digit, the gain for the tissue is zero."""
    for method in (DenseRiccati, NewtonADI):
        monkeypatch.setattr(method, "solve", without_tissue(method.solve))
    measured = [row for row in rows(True) if row.ours.value is not None]
    assert measured
    assert [row.case for row in measured if row.ok] == []


def shaken(share: float) -> Callable[..., RiccatiSolution]:
    """A low-rank solver whose gain for the tissue is right to so many digits only."""

    def solve(self: Any, problem: RiccatiProblem) -> RiccatiSolution:
        answer = low_rank(self, problem)
        K = answer.gain
        return replace(answer, gain=replace(K, K_z=(1 + share) * K.K_z, K_v=(1 - share) * K.K_v))

    low_rank = NewtonADI.solve
    return solve


def test_a_gain_that_loses_digits_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine digits in the gain are too few at R = 1, where the residual of the answer warrants eleven."""
    problem = problem_of()
    monkeypatch.setattr(NewtonADI, "solve", shaken(1e-9))
    (row,) = gain_rows("R = 1", 1.0, problem, solvers=("low rank",))
    assert row.ours.value == pytest.approx(1e-9, rel=0.01)  # the true error is a hundred times smaller
    assert row.verdict == "fail"


def test_a_factor_beyond_the_tolerance_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """The gain is right, but the factor that comes with it solves the equation to 1e-6 only."""
    low_rank = NewtonADI.solve

    def solve(self: Any, problem: RiccatiProblem) -> RiccatiSolution:
        answer = low_rank(self, problem)
        return replace(answer, factor=answer.factor.times((1 + 1e-6) * np.eye(answer.rank)))

    monkeypatch.setattr(NewtonADI, "solve", solve)
    (row,) = gain_rows("R = 1", 1.0, problem_of(), solvers=("low rank",))
    assert row.ours.value == math.inf


def test_first_order_moves_the_gain_as_the_equation_does() -> None:
    """Another weight of the outputs is a residual of the old solution: both gains exact, the bound between them."""
    problem = problem_of()
    exact, share = exact_gain(problem), 1e-7
    moved = exact_gain(replace(problem, Q=(1 + share) * problem.Q))
    solution = DenseRiccati().solve(replace(problem, Q=(1 + share) * problem.Q))
    bound, residual = GainBounds(problem, exact).of_factor(solution.factor)
    assert residual == pytest.approx(share, rel=1e-4)  # of the rounding in Z
    change = worst_part_error(moved, exact, problem.layout.n_s)
    assert change < bound * (1 + 1e-6)  # of second order in the share
    assert bound < 10 * change  # signs of the entries are all that it leaves out


def test_error_of_a_gain_is_that_of_its_worst_part() -> None:
    exact = np.array([[1e6, 1e5, 1e-3, 1e-4]])  # gains for q_s, v_s, z, v_z
    assert worst_part_error(exact, exact, 1) == 0
    assert worst_part_error(exact * [1, 1, 1.5, 1], exact, 1) == pytest.approx(0.5)
    assert worst_part_error(exact * [1, 1, 0, 0], exact, 1) == 1
    bare = np.array([[3.0, 4.0, 0.0, 0.0]])
    assert worst_part_error(np.array([[3.0, 4.0, 1e-3, 0.0]]), bare, 1) == pytest.approx(
        2e-4
    )  # over the norm of all, 5
