"""The bound beyond the circle against dense algebra, on random plants that are made to be hard for it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.system import BlockSystem, Damping
from softgrasp.lqr.dense.care import WeightedSystem
from softgrasp.lqr.dense.modal import relative_space
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.spectrum.tail import TailBound, why_no_bound

COMM = MPI.COMM_SELF
KINDS = ["kelvin", "rayleigh", "space", "layers", "two-way", "two-way-alpha", "two-way-layers"]
N_S, N = 2, 14
LOWEST = 4  # modes that the bound takes one by one, so that the rest matters


def matrix(A: Array) -> PETSc.Mat:
    result = PETSc.Mat().createAIJ(A.shape, nnz=len(A), comm=COMM)
    result.setValues(range(len(A)), range(len(A)), A.ravel())
    result.assemble()
    return result


def plant(kind: str, rng: np.random.Generator, light: bool) -> RiccatiProblem:
    """Frequencies over two decades, one of them twice; a hand lighter than the tissue it carries."""
    X = rng.standard_normal((N, N))
    M = X @ X.T / N + 0.1 * np.eye(N)
    omega = np.sort(10 ** rng.uniform(0, 2, N))
    omega[1] = omega[0]
    modal = np.linalg.cholesky(M) @ np.linalg.qr(rng.standard_normal((N, N)))[0]
    K_1 = (modal * omega**2) @ modal.T
    Y = rng.standard_normal((N, 5))
    K_2 = 0.1 * np.linalg.norm(K_1) / np.linalg.norm(Y @ Y.T) * (Y @ Y.T)
    G = rng.standard_normal((N, N_S))
    M_rigid = 1.1 * G.T @ np.linalg.solve(M, G)
    two_way, layered = kind.startswith("two-way"), kind.endswith("layers")
    # of the lowest mode: 1e-5 of critical, or overdamped
    beta, alpha = (2e-5, 1e-5) if light else (3.0, 30.0)
    betas = (beta, 7 * beta) if layered else (beta, beta)
    damping = Damping(
        alpha=0.0 if kind in ("kelvin", "two-way") else alpha,
        beta=0.0 if layered else beta,
        in_space=kind == "space",
        matrix=matrix(betas[0] * K_1 + betas[1] * K_2) if layered else None,
    )
    layout = BlockLayout(COMM, 1, N_S, N, N, 0, np.arange(N)[:, None] / N, np.zeros(1))
    materials = tuple(LayerMaterial(1.0, 1.0, 1.0, b) for b in betas)
    system = BlockSystem(
        layout, (), materials, matrix(M), matrix(K_1 + K_2 * layered), np.zeros_like(G), G, 0.2 * M_rigid, M_rigid,
        damping, two_way=two_way,
    )  # fmt: skip
    return RiccatiProblem(system, np.eye(N_S), np.zeros_like(G), np.eye(N_S), np.eye(N_S))


def gains(problem: RiccatiProblem, space: WeightedSystem, rng: np.random.Generator) -> list[Array]:
    """On everything; on the hand alone; on the velocity of one mode, which the bound all but reaches."""
    G, M_s = space.E[-N:, N_S : 2 * N_S], problem.M_s
    M = space.E[-N:, -N:] - problem.system.two_way * G @ np.linalg.solve(M_s, G.T)
    Phi = scipy.linalg.eigh(-space.A[-N:, 2 * N_S : 2 * N_S + N], M)[1]
    result = [rng.standard_normal((N_S, len(space.A))) * np.repeat([1.0, 0.1], [2 * N_S, 2 * N])]
    result.append(np.hstack([-M_s, -2 * M_s, np.zeros((N_S, 2 * N))]))
    for phi in (Phi[:, 0], Phi[:, LOWEST]):
        mode = np.outer(np.linalg.solve(M_s, G.T @ phi), M @ phi)
        result.append(np.hstack([np.zeros((N_S, len(space.A) - N)), mode]))
    return result


@pytest.mark.serial
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("light", [True, False], ids=["light", "heavy"])
def test_no_loop_gain_exceeds_the_bound(kind: str, light: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the edge of the region, at the resonances; and no eigenvalue lies where the bound is below 1."""
    monkeypatch.setattr("softgrasp.lqr.spectrum.tail.MODES", LOWEST)
    rng = np.random.default_rng(KINDS.index(kind))
    problem = plant(kind, rng, light)
    assert not why_no_bound(problem)
    space = relative_space(problem)
    assert space is not None
    A, B = np.linalg.solve(space.E, space.A), np.linalg.solve(space.E, space.B)
    own = np.linalg.eigvals(A)
    own = own[np.argsort(np.abs(own))][2 * N_S :]  # behind the zeros of the hand
    slow = np.sort(-own.real)
    tightest, finite = 0.0, 0
    for K in gains(problem, space, rng):
        tail = TailBound(problem, Block(K[:, : 2 * N_S].T.copy(), K[:, 2 * N_S :].T.copy()))
        closed = np.linalg.eigvals(A + B @ K)
        cases = [
            (a, r)
            for a in (0.0, 0.5 * slow[0], 0.9 * slow[0], 1.01 * slow[0], 0.999 * slow[5])
            for r in (1.05 * a, *(tail.omega[0] * np.array([0.05, 0.9, 1.2, 100.0, 3000.0])))
        ]
        cases += [(0.9999 * 1.001 * p, 1.001 * p) for p in slow]
        for a, r in cases:
            bound = tail.bound(r, a)
            if not np.isfinite(bound):
                continue
            finite += 1
            heights = np.concatenate([r * np.geomspace(1e-3, 1e3, 60), np.abs(own.imag), np.abs(closed.imag)])
            line = -a + 1j * heights
            arc = (1 + 1e-12) * r * np.exp(1j * np.linspace(0, np.pi / 2 + np.arcsin(a / r), 12))
            points = np.concatenate([line[np.abs(line) >= r], arc])
            loop = K @ np.linalg.solve(points[:, None, None] * np.eye(len(A)) - A, B)
            tightest = max(tightest, np.linalg.norm(loop, 2, axis=(1, 2)).max() / bound)
            assert bound >= 1 or not ((closed.real > -a) & (np.abs(closed) >= r)).any()
    assert tightest <= 1 + 1e-6  # rounding of the solves beside a pole
    # one mode by itself all but reaches the bound; Cauchy-Schwarz over modes that damping couples is far off
    assert tightest > (0.01 if tail.coupled else 0.9)
    assert finite >= 10
