"""Riccati equations of systems without a hand: triple chain, and lightly damped blocks with the poles of FOM.

Every residual is that of matrices written here, in first-order form, and shares nothing with the package.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.system import Damping
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.diagnosis import diagnose
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.plant.second_order import second_order
from softgrasp.lqr.riccati import solve

COMM = MPI.COMM_WORLD


@dataclass(frozen=True)
class Example:
    """M z'' + D z' + K z = B u, y = C'z, whole on every rank."""

    M: sp.csr_matrix
    D: sp.csr_matrix
    K: sp.csr_matrix
    B: Array
    C: Array
    damping: Damping | None = None

    @property
    def n(self) -> int:
        return int(self.M.shape[0])

    def problem(self) -> RiccatiProblem:
        matrices = [distributed(A) for A in (self.M, self.D, self.K)]
        rows = slice(*matrices[0].getOwnershipRange())
        return second_order((matrices[0], matrices[1], matrices[2]), self.B[rows], self.C[rows], damping=self.damping)

    def first_order(self) -> tuple[Array, Array, Array, Array]:
        n, zero, one = self.n, np.zeros((self.n, self.n)), np.eye(self.n)
        E = scipy.linalg.block_diag(one, self.M.toarray())
        A = np.block([[zero, one], [-self.K.toarray(), -self.D.toarray()]])
        B, C = np.vstack([0 * self.B, self.B]), np.vstack([self.C, 0 * self.C]).T
        assert len(A) == 2 * n
        return E, A, B, C

    def residual(self, Z: Array) -> float:
        E, A, B, C = self.first_order()
        X = Z @ Z.T
        G = E.T @ X @ B
        R = A.T @ X @ E + E.T @ X @ A - G @ G.T + C.T @ C
        return float(np.linalg.norm(R, 2) / np.linalg.norm(C @ C.T, 2))


def distributed(A: sp.csr_matrix) -> PETSc.Mat:
    n = A.shape[0]
    first = n * COMM.rank // COMM.size
    last = n * (COMM.rank + 1) // COMM.size
    part = A.tocsr()[first:last]
    part.sort_indices()
    return PETSc.Mat().createAIJ(((last - first, n),) * 2, csr=(part.indptr, part.indices, part.data), comm=COMM)


def triple_chain(n_1: int, alpha: float, beta: float, viscosity: float) -> Example:
    """Three chains of n_1 masses tied to one end mass [TV09], forced and seen everywhere."""
    masses, springs, m_0, k_0 = (1.0, 2.0, 3.0), (10.0, 20.0, 1.0), 10.0, 50.0
    n = 3 * n_1 + 1
    M = sp.diags(np.append(np.repeat(masses, n_1), m_0)).tocsr()
    chain = sp.diags([-1.0, 2.0, -1.0], [-1, 0, 1], shape=(n_1, n_1))
    K = sp.lil_matrix((n, n))
    for j, k in enumerate(springs):
        rows = slice(j * n_1, (j + 1) * n_1)
        K[rows, rows] = k * chain
        end = (j + 1) * n_1 - 1
        K[end, n - 1] = K[n - 1, end] = -k
    K[n - 1, n - 1] = sum(springs) + k_0
    K = K.tocsr()
    dampers = np.zeros(n)
    dampers[[0, n_1 - 1, 2 * n_1]] = viscosity
    D = alpha * M + beta * K + sp.diags(dampers)
    proportional = None if viscosity else Damping(alpha=alpha, beta=beta)
    return Example(M, D.tocsr(), K, np.ones((n, 1)), np.ones((n, 1)), proportional)


def blocks(real: int, decay: float) -> Example:
    """Poles -decay +- 100i, 200i, 400i and -1, -2, ..., -2 real, a mode each, as those of Penzl's FOM.

    FOM itself has zeros that a displacement output cannot make: the poles are its own, the residues are not.
    """
    pairs = [(decay**2 + w**2, 2 * decay) for w in (100.0, 200.0, 400.0)]
    pairs += [((2 * k - 1) * 2.0 * k, 4.0 * k - 1) for k in range(1, real + 1)]
    stiffness, damping = np.array(pairs).T
    B = np.append(np.full(3, 10.0), np.ones(real))[:, None]
    n = len(pairs)
    # a sparse orthogonal change of coordinates hides that the modes are known
    angle = np.linspace(0.3, 1.2, n // 2)
    U = sp.identity(n, format="lil")
    for i, a in enumerate(angle):
        j = n - 1 - i
        U[i, i] = U[j, j] = np.cos(a)
        U[i, j], U[j, i] = np.sin(a), -np.sin(a)
    U = U.tocsr()
    forced = U @ B
    K, D = (U @ sp.diags(x) @ U.T for x in (stiffness, damping))
    return Example(sp.identity(n, format="csr"), ((D + D.T) / 2).tocsr(), ((K + K.T) / 2).tocsr(), forced, 30 * forced)


CASES = {
    "chain-proportional": triple_chain(25, 0.02, 0.02, 0.0),
    "chain-dampers": triple_chain(20, 0.02, 0.02, 5.0),
    "chain-light": triple_chain(30, 0.002, 0.002, 5.0),  # defeats shifts from projections alone
    "blocks": blocks(100, 1.0),
    "blocks-light": blocks(60, 0.05),
}


def whole(solution: RiccatiSolution) -> tuple[Array, Array]:
    """Z and K in global rows, on every rank."""
    Z = np.vstack([np.concatenate(COMM.allgather(np.array(part))) for part in np.vsplit(solution.factor.tall, 2)])
    K = np.vstack([np.concatenate(COMM.allgather(np.array(part))) for part in (solution.gain.K_z, solution.gain.K_v)])
    return Z, K.T


def oracle(example: Example) -> tuple[Array, Array]:
    """X and K by SciPy in coordinates scaled to energy: sqrt(K) z, sqrt(M) z'."""
    E, A, B, C = example.first_order()
    n = example.n
    L_K, L_M = np.linalg.cholesky(example.K.toarray()), np.linalg.cholesky(example.M.toarray())
    S = scipy.linalg.block_diag(np.linalg.inv(L_K.T), np.linalg.inv(L_M.T))  # x = S xi
    L = scipy.linalg.block_diag(L_K.T, np.linalg.inv(L_M))
    assert np.abs(L @ E @ S - np.eye(2 * n)).max() < 1e-12  # rounding
    Y = scipy.linalg.solve_continuous_are(L @ A @ S, L @ B, (C @ S).T @ C @ S, np.eye(B.shape[1]))
    X = L.T @ Y @ L
    return X, -B.T @ X @ E


@pytest.mark.parametrize("name", list(CASES))
def test_newton_radi_and_dense_agree(name: str) -> None:
    """Three roads and SciPy, on any rank count: the same X and gain; residuals from matrices of this file."""
    example = CASES[name]
    problem = example.problem()
    X, K = oracle(example)
    for solver in (NewtonADI(tol=1e-9), RADI(tol=1e-9), DenseRiccati()):
        found = solver.solve(problem)
        Z, gain = whole(found)
        true = example.residual(Z)
        assert true < 3e-9  # twice the tolerance, and rounding of the dense products
        assert found.residual == pytest.approx(true, rel=0.2, abs=3e-10)  # eps |A| |X| of the dense products
        assert np.linalg.norm(Z @ Z.T - X) < 1e-6 * np.linalg.norm(X), found.method  # a residual of 1e-9 leaves 2e-7
        assert np.linalg.norm(gain - K) < 1e-6 * np.linalg.norm(K), found.method  # as above
        E, A, B, _ = example.first_order()
        assert np.linalg.eigvals(np.linalg.solve(E, A + B @ gain)).real.max() < 0
        assert found.gain.K_s.shape == (1, 0)
        assert found.factor.hand.shape == (0, found.rank)


def test_long_chain_without_a_dense_matrix() -> None:
    """1802 states, modes by SLEPc: two roads agree, and a residual by QR of [A'Z, E'Z, C'] from sparse matrices."""
    example = triple_chain(300, 0.02, 0.02, 5.0)
    problem, gains = example.problem(), []
    for solver in (NewtonADI(tol=1e-8), RADI(tol=1e-8)):
        Z, gain = whole(solver.solve(problem))
        q, v = Z[: example.n], Z[example.n :]
        moved = np.vstack([-example.K @ v, q - example.D @ v])
        weighted, C = np.vstack([q, example.M @ v]), np.vstack([example.C, 0 * example.C])
        seen, rank = example.B.T @ v, Z.shape[1]
        U = np.hstack([moved, weighted, C])
        S = np.zeros((2 * rank + 1, 2 * rank + 1))
        S[:rank, rank:-1] = S[rank:-1, :rank] = np.eye(rank)
        S[rank:-1, rank:-1] = -seen.T @ seen
        S[-1, -1] = 1.0
        r = np.linalg.qr(U, mode="r")
        assert np.linalg.norm(r @ S @ r.T, 2) < 2e-8 * example.n  # twice the tolerance; |C'C| = n
        gains.append(gain)
    assert np.linalg.norm(gains[0] - gains[1]) < 1e-7 * np.linalg.norm(gains[0])  # two residuals of 1e-8


def test_galerkin_of_the_chain() -> None:
    example = CASES["chain-proportional"]
    _, gain = whole(StructuredGalerkin(tol=1e-6).solve(example.problem()))
    _, K = oracle(example)
    assert np.linalg.norm(gain - K) < 1e-4 * np.linalg.norm(K)  # its change between two spaces is 1e-6


def test_choice_and_diagnosis() -> None:
    for name, method in (("chain-proportional", "dense"), ("blocks", "radi")):
        problem = CASES[name].problem()
        assert diagnose(problem).solvable
        assert solve(problem, tol=1e-8).method == method
    lost = triple_chain(8, 0.0, 0.0, 0.0).problem()
    assert not diagnose(lost).solvable
    with pytest.raises(ControlError, match="damping"):
        NewtonADI().solve(lost)


def test_limits_raise_and_inputs_stay() -> None:
    example = CASES["chain-dampers"]
    problem = example.problem()
    assert problem.B_z is not None
    copies = [problem.C_z.copy(), problem.B_z.copy(), problem.system.K_ee.getValuesCSR()[2].copy()]
    for solver in (NewtonADI(max_iterations=1, tol=1e-9), RADI(max_iterations=1)):
        with pytest.raises(SolverError, match="residual"):
            solver.solve(problem)
    after = [problem.C_z, problem.B_z, problem.system.K_ee.getValuesCSR()[2]]
    assert all(np.array_equal(a, b) for a, b in zip(copies, after, strict=True))


def test_what_is_refused() -> None:
    n = 6
    one = distributed(sp.identity(n, format="csr"))
    rows = one.getOwnershipRange()
    ones = np.ones((rows[1] - rows[0], 1))
    skew = distributed(sp.diags([1.0, 2.0, -1.0], [-1, 0, 1], shape=(n, n)).tocsr())
    with pytest.raises(SolverError, match="D is not symmetric"):
        second_order((one, skew, one), ones, ones)
    with pytest.raises(SolverError, match="local rows"):
        second_order((one, one, one), np.ones((n + 1, 1)), ones)
    with pytest.raises(SolverError, match="must match M"):
        second_order((one, distributed(sp.identity(n + 1, format="csr")), one), ones, ones)
