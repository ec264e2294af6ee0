"""Start of the low-rank solvers: the Riccati equation of hand and lowest modes, expanded by the modal filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from softgrasp.fem.petsc import Array, PETSc, on_root, total
from softgrasp.fem.solve.modes import KEPT_ENTRIES, lowest_modes
from softgrasp.fem.system import BlockSystem
from softgrasp.lqr.dense.care import (
    FAST_RESIDUAL,
    WeightedSystem,
    fast_solution,
    lyapunov,
    riccati_residual,
    solve_reduced,
)
from softgrasp.lqr.dense.modal import TissueMatrices, assemble_space, in_energy
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import MODAL_KEY, ControlError
from softgrasp.lqr.plant.operators import damp

MODES = 30
MORE_MODES = 60  # when the last of MODES is still lightly damped
LIGHT = 0.02  # damping ratio below which it is
FEW_MODES = 8  # whose Riccati equation starts Newton's method for all of them, from twice as many on
CORRECTIONS = 4  # Newton steps from the solution on a smaller space; more cost as much as a Schur form


@dataclass(frozen=True)
class ModalStart:
    """Gain and shifts of the modal problem."""

    gain: Block  # K' with unscaled z-row, hand (2 n_s, m), local rows (2 n_local, m)
    poles: np.ndarray  # closed-loop poles [1/s], most important first, one of each pair, Im >= 0, (k,)


class _SchurMass:
    """M_ee - G M_s^{-1} G': mass of the tissue with the free hand eliminated (two-way coupling)."""

    def __init__(self, system: BlockSystem, M_s: Array) -> None:
        self.M, self.G, self.comm = system.M_ee, system.G, system.layout.comm
        self.M_s = M_s

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.M.mult(x, y)
        y.array_w[:] -= self.G @ np.linalg.solve(self.M_s, total(self.comm, self.G.T @ x.array_r))

    multTranspose = mult  # noqa: N815  (name of PETSc)


def plant_modes(plant: Plant, k: int) -> tuple[Array, Array]:
    """Frequencies and modes of the coupled free motion: clamped one-way, with the hand floating two-way. Collective."""
    system = plant.system
    if k == 0:
        return np.zeros(0), np.zeros((plant.n_local, 0))
    if not plant.two_way:
        return lowest_modes(system, k)
    key = (system.K_ee.handle, system.K_ee.stateGet(), system.M_ee.handle, system.M_ee.stateGet(), plant.M_s.tobytes())
    kept = system.kept.get("floating modes")
    if kept is None or kept[0] != key or len(kept[1]) < k:
        most = max(k, min(MORE_MODES, system.layout.n_e))  # the certificate requests them after the start of a solver
        kept = key, *_floating(plant, most), system.K_ee, system.M_ee  # no other matrix can get their handles
        if most * system.layout.n_e <= KEPT_ENTRIES:
            system.kept["floating modes"] = kept
    return kept[1][:k].copy(), kept[2][:, :k].copy(order="F")


def _floating(plant: Plant, k: int) -> tuple[Array, Array]:
    """Modes of K_ee and M_ee - G M_s^{-1} G', computed. Collective."""
    system = plant.system
    shell = PETSc.Mat().createPython(system.M_ee.getSizes(), _SchurMass(system, plant.M_s), comm=system.layout.comm)
    shell.setUp()
    try:
        return lowest_modes(replace(system, M_ee=shell), k)
    finally:
        shell.destroy()


def restrict(plant: Plant, V: Array, omega: Array, M_V: Array) -> WeightedSystem:
    """Galerkin projection on z = V eta with V' K_ee V = diag(omega^2), in [q_s, v_s, omega eta, eta']. Collective."""
    r = len(omega)
    columns = [M_V, damp(plant.system, V, M_V), plant.G, plant.C_z]
    products = total(plant.comm, V.T @ np.hstack(columns))
    M, D, G, C_z = np.split(products, [r, 2 * r, 2 * r + plant.n_s], axis=1)
    folded = replace(plant.problem, C_s=plant.C_s)  # weights are in the outputs already
    tissue = TissueMatrices((M + M.T) / 2, np.diag(omega**2), (D + D.T) / 2, G, C_z)
    space = in_energy(assemble_space(folded, tissue), omega)
    B = np.zeros((space.N, plant.inputs))
    if plant.B_z is None:
        B[plant.n_s : 2 * plant.n_s] = plant.B
    else:
        B[2 * plant.n_s + r :] = total(plant.comm, V.T @ plant.B_z)
    return replace(space, B=B, Q=np.eye(len(space.C)), R=np.eye(plant.inputs))


def solve_small(plant: Plant, space: WeightedSystem, guess: Array | None = None) -> Array:
    """X of a restricted plant, (N, N), solved on rank 0. Collective.

    ``guess``: an X near the solution, (N, N). Raises ControlError: not stabilisable or not detectable.
    """

    def solve() -> Array:
        start = _few_modes(space, space.N // 2 - plant.n_s) if guess is None else guess
        X = None if start is None else _corrected(space, start)
        return solve_reduced(space) if X is None else X

    return on_root(plant.comm, solve)


def _few_modes(m: WeightedSystem, r: int) -> Array | None:
    """X of the lowest of r modes alone, zero for the others; None where all are few.

    With the two Newton steps that follow it needs a third of the time of one Schur form for all modes.
    """
    N, k = m.N, FEW_MODES
    if r < 2 * k:
        return None
    at = np.r_[: N - 2 * r + k, N - r : N - r + k]
    solution = fast_solution(replace(m, E=m.E[np.ix_(at, at)], A=m.A[np.ix_(at, at)], B=m.B[at], C=m.C[:, at]))
    if solution is None:
        return None
    X = np.zeros((N, N))
    X[np.ix_(at, at)] = solution
    return X


def _corrected(space: WeightedSystem, X: Array) -> Array | None:
    """Newton's method from a stabilising X near the solution; None when it is not."""
    n = len(space.E)
    lu, pivots, info = scipy.linalg.lapack.dgetrf(space.E)
    if info:
        return None
    solved, _ = scipy.linalg.lapack.dgetrs(lu, pivots, np.hstack([space.A, space.B]))
    A, B = solved[:, :n], solved[:, n:]
    G, H, Y = B @ B.T, space.C.T @ space.C, space.E.T @ X @ space.E
    for _ in range(CORRECTIONS):
        residual = riccati_residual(A, G, H, Y)
        if np.linalg.norm(residual) <= FAST_RESIDUAL * np.linalg.norm(H):
            half, _ = scipy.linalg.lapack.dgetrs(lu, pivots, Y, trans=1)
            X, _ = scipy.linalg.lapack.dgetrs(lu, pivots, half.T, trans=1)
            return np.asarray((X + X.T) / 2)
        T, U = scipy.linalg.schur(A - G @ Y, output="real", check_finite=False)
        if not np.diag(T).max() < 0:
            return None
        Y = Y + lyapunov(T, U, residual)
    return None


def _ordered(space: WeightedSystem, s: int, gain: Array) -> np.ndarray:
    """Closed-loop poles by |c_k|^2 / (|Re p_k| omega_k^2), what a mode adds to the cost; s freedoms of the hand."""
    poles, vectors = np.linalg.eig(np.linalg.solve(space.E, space.A - space.B @ gain))
    kinetic = np.real(np.einsum("ij,ij->j", vectors.conj(), space.E @ vectors))
    stored = (vectors[:s], vectors[2 * s : s + space.N // 2])
    potential = np.sum(np.abs(stored[0]) ** 2, axis=0) + np.sum(np.abs(stored[1]) ** 2, axis=0)
    seen = np.sum(np.abs(space.C @ vectors) ** 2, axis=0)
    score = seen / (np.abs(poles.real) * np.maximum(kinetic - potential, 1e-12 * kinetic))
    # the hand first: its poles carry most of the cost and its energy is in q_s, which has none
    hand = np.sum(np.abs(vectors[:s]) ** 2, axis=0) / np.sum(np.abs(vectors) ** 2, axis=0)
    score = np.where(hand > 0.5, np.inf, score)
    order = np.lexsort((np.abs(poles), -score))
    keep = [i for i in order if poles[i].imag >= 0]
    return np.asarray(poles[keep])


def filtered_gain(plant: Plant, gain: Array, V: Array, omega: Array, M_V: Array) -> Block:
    """K'x of the small gain B'XE through the modal filter: other modes are neither seen nor moved.

    eta = V'M~ z and, two-way, q_s + M_s^{-1} G'(z - V eta) instead of q_s; M~ = M_ee - G M_s^{-1} G'. For modes
    (V'M~V = I) the closed loop is block triangular, so every mode that was stable stays so. Collective.
    """
    s, r = plant.n_s, len(omega)
    K_s, K_q, K_v = np.split(gain, [2 * s, 2 * s + r], axis=1)
    z, v = M_V @ (omega[:, None] * K_q.T), M_V @ K_v.T
    if plant.two_way:
        g = total(plant.comm, V.T @ plant.G)
        rest = np.linalg.solve(plant.M_s, (plant.G - M_V @ g).T).T
        z, v = z + rest @ K_s[:, :s].T, v + rest @ K_s[:, s:].T
    return Block(np.ascontiguousarray(K_s.T), np.vstack([z, v]))


def check_damped(plant: Plant) -> None:
    """The tissue is damped at all. Raises ControlError: it is not."""
    if not plant.system.damping.active:
        raise ControlError(
            "without damping X has no low rank and the high modes cannot be stabilised in double precision; "
            f"set effects.damping.beta, or control only the lowest modes with {MODAL_KEY}"
        )


def modal_start(plant: Plant, modes: int | None = None) -> ModalStart:
    """Riccati equation of the hand and the lowest ``modes`` modes. Collective.

    ``modes``: number of modes, 0 for the hand alone; None: :data:`MODES`, or more when damping is light.

    Raises ControlError: there is no damping at all, or the small problem has no stabilising solution.
    """
    check_damped(plant)
    count = MODES if modes is None else modes
    omega, Phi = plant_modes(plant, min(count, plant.layout.n_e))
    M_Phi = plant.mass(Phi)
    space = restrict(plant, Phi, omega, M_Phi)
    if modes is None and plant.layout.n_e > MORE_MODES:
        light = bool(-space.A[-1, -1] < 2 * LIGHT * omega[-1])  # of the last mode
        if plant.comm.bcast(light):
            return modal_start(plant, MORE_MODES)
    X = solve_small(plant, space)
    gain = on_root(plant.comm, lambda: space.B.T @ X @ space.E)
    if plant.two_way:
        M_Phi = M_Phi - plant.G @ np.linalg.solve(plant.M_s, total(plant.comm, plant.G.T @ Phi))
    poles = on_root(plant.comm, lambda: _ordered(space, plant.n_s, gain))
    return ModalStart(filtered_gain(plant, gain, Phi, omega, M_Phi), poles)
