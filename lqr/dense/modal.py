"""The plant in its modes, their closed-loop poles, and the whole Riccati equation, dense: the low-rank oracle."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse

from softgrasp.fem.errors import ResourceError, SolverError, raise_on_all_ranks
from softgrasp.fem.layout import BlockLayout
from softgrasp.fem.petsc import Array, PETSc, rows_on_root, times_columns, to_scipy, total
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.lqr.dense.care import WeightedSystem, care_of
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import EPS, MODAL_KEY, ControlError, check_finite, check_weights, square_root
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import damp
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution

DENSE_MODES = 600  # a tenth of a second; SLEPc on several ranks is slower there
FACTOR_TOLERANCE = 1e-10  # of the singular values of Z, hence 1e-20 of those of X
# A rate below this share of the largest frequency is rounding: an error eps |H| of the Hamiltonian matrix moves a pole
# by as much, and a dense eigenvalue solver makes some ten times that.
LOST = 30 * EPS
# Damping ratio of the first mode from which the low-rank solvers converge in a few hundred solves (measured: 4e-4 does,
# 4e-5 does not).
ENOUGH = 4e-4
NOISE = 100 * EPS  # of the largest row of Z: an entry of X beside it is rounding of X


@dataclass(frozen=True)
class TissueMatrices:
    """Dense operators of the tissue, in global numbering or any basis of k columns of z."""

    M: Array  # mass M_ee, (k, k)
    K: Array  # stiffness K_ee, (k, k)
    D: Array  # damping D_ee, (k, k)
    G: Array  # coupling to the hand, (k, n_s)
    C_z: Array  # outputs of z, transposed, (k, p)
    B_z: Array | None = None  # forces of the inputs, (k, m), where there is no hand; else None


@dataclass(frozen=True)
class ModalPlant:
    """The plant in xi = [q_s, v_s, omega eta, eta'], z = Phi eta, Phi' M_ee Phi = I: |xi_e|^2 / 2 is the energy.

    E xi' = A xi + B u with E = L E_rel S, A = L A_rel S, B = L B_rel, C = C_rel S, S = blkdiag(I, I, Phi/omega, Phi),
    L = blkdiag(I, I, omega Phi'M, Phi'); X_rel = L' X L and K_rel = K S^{-1}.
    """

    omega: Array  # natural frequencies [1/s], ascending, (k,)
    Phi: Array  # modes, (n_e, k)
    massed: Array  # M_ee Phi, (n_e, k)
    D: Array  # Phi' D_ee Phi, (k, k)
    g: Array  # Phi' G, (k, n_s); without a hand Phi' B_z, (k, m)
    c: Array  # outputs of the modes, (p, k)
    space: WeightedSystem  # dense plant in the coordinates xi


def gather_matrix(layout: BlockLayout, A: PETSc.Mat) -> Array | None:
    """A distributed tissue matrix, dense on rank 0, None elsewhere. Collective."""
    return rows_on_root(layout.comm, to_scipy(A).toarray())


def gather_tissue(problem: RiccatiProblem) -> TissueMatrices | None:
    """All tissue operators, dense on rank 0, None elsewhere. Collective."""
    system, layout = problem.system, problem.layout
    M, K = gather_matrix(layout, system.M_ee), gather_matrix(layout, system.K_ee)
    matrix = system.damping.matrix
    extra = None if matrix is None else gather_matrix(layout, matrix)
    G, C_z = (rows_on_root(layout.comm, a) for a in (system.G, problem.C_z))
    B_z = None if problem.B_z is None else rows_on_root(layout.comm, problem.B_z)
    if M is None or K is None or G is None or C_z is None:
        return None
    D = system.damping.alpha * M + (system.damping.beta * K if extra is None else extra)
    return TissueMatrices(M, K, D, G, C_z, B_z)


def assemble_space(problem: RiccatiProblem, tissue: TissueMatrices) -> WeightedSystem:
    """E, A, B, C of x = [q_s, v_s, z, v_z].

    With drag = "space" and two-way coupling the hand row carries alpha M_rigid and alpha G' as well.
    """
    system, M, G, B_z = problem.system, tissue.M, tissue.G, tissue.B_z
    n_s, n = system.layout.n_s, len(M)
    s, v, z, w = (slice(a, b) for a, b in ((0, n_s), (n_s, 2 * n_s), (2 * n_s, 2 * n_s + n), (2 * n_s + n, None)))
    E = np.eye(2 * (n_s + n))
    A = np.zeros_like(E)
    E[v, v], E[w, w], E[w, v] = problem.M_s, M, G
    A[s, v], A[z, w] = np.eye(n_s), np.eye(n)
    A[w, z], A[w, w] = -tissue.K, -tissue.D
    if system.damping.in_space:
        A[w, v] = -system.damping.alpha * G
    if system.two_way:
        E[v, w] = G.T
        if system.damping.in_space:
            A[v, v], A[v, w] = -system.damping.alpha * system.M_rigid, -system.damping.alpha * G.T
    B = np.zeros((len(E), n_s if B_z is None else B_z.shape[1]))
    if B_z is None:
        B[v] = np.eye(n_s)
    else:
        B[w] = B_z
    C_z = tissue.C_z.T
    C = np.hstack([problem.C_s, np.zeros_like(problem.C_s), C_z, np.zeros_like(C_z)])
    return WeightedSystem(E, A, B, C, problem.Q, problem.R)


def relative_space(problem: RiccatiProblem) -> WeightedSystem | None:
    """E, A, B, C in hand-relative coordinates, dense on rank 0, None elsewhere. Collective."""
    tissue = gather_tissue(problem)
    return None if tissue is None else assemble_space(problem, tissue)


def modal_plant(
    problem: RiccatiProblem, omega: Array, Phi: Array, massed: Array, parts: tuple[Array, Array, Array]
) -> ModalPlant:
    """The plant restricted to modes. ``parts``: Phi' D_ee Phi, Phi' G (without a hand Phi' B_z) and C_z' Phi."""
    D, g, c = parts
    G, B_z = (g, None) if problem.B_z is None else (g[:, :0], g)
    space = assemble_space(problem, TissueMatrices(np.eye(len(omega)), np.diag(omega**2), D, G, c.T, B_z))
    return ModalPlant(omega, Phi, massed, D, g, c, in_energy(space, omega))


def in_energy(space: WeightedSystem, omega: Array) -> WeightedSystem:
    """L E S, L A S, B, C S with S = blkdiag(I, 1/omega, I), L = blkdiag(I, omega, I), of [q_s, v_s, eta, eta']."""
    k = len(omega)
    L = np.concatenate([np.ones(len(space.E) - 2 * k), omega, np.ones(k)])
    S = 1 / L
    return replace(space, E=L[:, None] * space.E * S, A=L[:, None] * space.A * S, C=space.C * S)


def dense_modes(problem: RiccatiProblem, tissue: TissueMatrices) -> ModalPlant:
    """The plant in all its modes, K_ee phi = omega^2 M_ee phi.

    Raises SolverError: the stiffness is not positive definite: the contact zone does not fix the body.
    """
    squares, Phi = scipy.linalg.eigh(tissue.K, tissue.M)
    _check_held(float(squares[0]), float(squares[-1]))
    inputs = tissue.G if tissue.B_z is None else tissue.B_z
    parts = (Phi.T @ tissue.D @ Phi, Phi.T @ inputs, tissue.C_z.T @ Phi)
    return modal_plant(problem, np.sqrt(squares), Phi, tissue.M @ Phi, parts)


def modes_of_plant(problem: RiccatiProblem, k: int) -> tuple[Array, Array, Array]:
    """The k lowest modes: LAPACK on rank 0 up to :data:`DENSE_MODES` unknowns, else SLEPc. Collective.

    Returns omega (k,), Phi and M_ee Phi, local rows (n_local, k).
    """
    system, layout = problem.system, problem.layout
    if layout.n_e > DENSE_MODES:
        omega, Phi = lowest_modes(system, k)
        return omega, Phi, times_columns(system.M_ee, Phi)
    key = (system.K_ee.handle, system.K_ee.stateGet(), system.M_ee.handle, system.M_ee.stateGet())
    kept = system.kept.get("dense modes")
    if kept is None or kept[0] != key or len(kept[1]) < k:
        kept = key, *_modes_on_root(problem, k), system.K_ee, system.M_ee  # no other matrix can get their handles
        system.kept["dense modes"] = kept
    Phi = kept[2][:, :k].copy(order="F")
    return kept[1][:k].copy(), Phi, times_columns(system.M_ee, Phi)


def _modes_on_root(problem: RiccatiProblem, k: int) -> tuple[Array, Array]:
    """Frequencies, and modes with local rows, by LAPACK. Collective."""
    system, layout = problem.system, problem.layout
    M, K = gather_matrix(layout, system.M_ee), gather_matrix(layout, system.K_ee)
    modes: tuple[Array, Array] | None = None
    with raise_on_all_ranks(layout.comm):
        if M is not None and K is not None:
            squares, vectors = scipy.linalg.eigh(K, M, subset_by_index=[0, k - 1])
            _check_held(squares[0], float(np.linalg.norm(K, 1) / np.diag(M).max()))
            modes = np.sqrt(squares), vectors
    omega, whole = layout.comm.bcast(modes)
    return omega, np.asfortranarray(whole[layout.start : layout.start + layout.n_local])


def lowest_plant(problem: RiccatiProblem, k: int) -> ModalPlant:
    """The plant in its k lowest modes, Phi and massed with local rows. Collective."""
    comm, (omega, Phi, massed) = problem.layout.comm, modes_of_plant(problem, k)
    inputs = problem.system.G if problem.B_z is None else problem.B_z
    D, g, c = (total(comm, part) for part in (Phi.T @ damp(problem.system, Phi), Phi.T @ inputs, problem.C_z.T @ Phi))
    return modal_plant(problem, omega, Phi, massed, (D, g, c))


def _check_held(lowest: float, largest: float) -> None:
    if not lowest > 1e-12 * largest:  # rounding of eigh is about n eps of the largest
        raise SolverError(f"the stiffness has the eigenvalue {lowest:.1e}; the contact zone must fix the body")


@dataclass(frozen=True)
class ModeRates:
    """Decay of each mode in the closed loop.

    Re p_k = -sqrt(delta_k^2 + f_k^2), |p_k| = omega_k, delta_k = phi_k' D phi_k / 2,
    f_k = |R^{-1/2} M_s^{-1} g_k| |Q^{1/2} c_k| / (2 omega_k)
    """

    omega: Array  # natural frequencies [1/s], (k,)
    own: Array  # delta_k, decay by the tissue's damping [1/s], (k,)
    feedback: Array  # f_k, decay by optimal feedback without that damping [1/s], (k,)
    size: float  # frequency scale of the whole plant, for rounding [1/s]

    @property
    def rate(self) -> Array:
        """-Re p_k [1/s]."""
        return np.asarray(np.hypot(self.own, self.feedback))

    @property
    def lost(self) -> Array:
        """Which modes double precision cannot distinguish from undamped ones."""
        return np.asarray(self.rate <= LOST * self.size)

    @property
    def poles(self) -> np.ndarray:
        """One pole p_k of each pair, Im >= 0; overdamped modes give the slower real pole."""
        imag = np.sqrt(np.maximum(self.omega**2 - self.rate**2, 0.0))
        slow = np.where(self.rate > self.omega, self.omega**2 / (2 * self.rate), self.rate)
        return np.asarray(-np.where(imag > 0, self.rate, slow) + 1j * imag)


def closed_loop_rates(problem: RiccatiProblem, plant: ModalPlant, largest: float = 0.0) -> ModeRates:
    """Estimate the closed-loop pole of every mode; good to 3 or 4 digits when modes do not overlap.

    ``largest``: largest frequency of the whole plant [1/s]; that of the modes when 0.
    """
    # (m, k); two-way: the rigid inertia moves too
    force = np.linalg.solve(problem.M_s, plant.g.T) if problem.B_z is None else plant.g.T
    weighted = scipy.linalg.solve_triangular(np.linalg.cholesky(problem.R), force, lower=True)
    seen = square_root(problem.Q) @ plant.c
    product = np.linalg.norm(weighted, axis=0) * np.linalg.norm(seen, axis=0)
    # what symmetry makes zero is rounding in the arrays
    noise = (
        1e3 * EPS * np.linalg.norm(weighted, axis=0).max(initial=0.0) * np.linalg.norm(seen, axis=0).max(initial=0.0)
    )
    product = np.where(product > noise, product, 0.0)
    size = max(largest, float(plant.omega.max(initial=0.0)))
    return ModeRates(plant.omega, np.diag(plant.D) / 2, product / (2 * plant.omega), size)


def lost_sentence(rates: ModeRates) -> str:
    """The modes that feedback cannot stabilise, the damping that would be enough, and the way out."""
    lost = np.flatnonzero(rates.lost)
    shown = ", ".join(f"{i + 1} (omega = {rates.omega[i]:.4g}/s)" for i in lost[:3])
    more = f" and {len(lost) - 3} more" if len(lost) > 3 else ""
    return (
        f"{len(lost)} of {len(rates.omega)} modes cannot be stabilised in double precision, mode {shown}{more}: they "
        "are neither damped nor both reached by the hand and seen by the outputs; set effects.damping.beta >= "
        f"{enough_damping(rates):.2g} s, or control only the lowest modes with {MODAL_KEY}"
    )


def enough_damping(rates: ModeRates) -> float:
    """Kelvin-Voigt time beta [s] that gives the first mode the damping ratio :data:`ENOUGH`."""
    return float(2 * ENOUGH / rates.omega.min())


def factor_psd(X: Array) -> Array:
    """Z with Z Z' = X for X symmetric positive semidefinite to rounding, columns in descending order.

    Small rows keep their own relative accuracy: X is scaled to unit diagonal first. Lifting multiplies the rows of
    fast modes by omega^2, and rounding relative to the largest entry of X would be seen in the residual. Rows of modes
    that no output sees are nothing but rounding, which scaling would blow up: they are zero.
    """
    scale = np.sqrt(np.maximum(np.diag(X), 0.0))
    noise = scale <= NOISE * scale.max(initial=0.0)
    scale[noise] = 1.0
    X = np.where(noise[:, None] | noise, 0.0, X)
    values, vectors = np.linalg.eigh(X / scale[:, None] / scale)
    keep = values > 0.1 * len(X) * EPS * values[-1]
    Z = scale[:, None] * vectors[:, keep] * np.sqrt(values[keep])
    _, sigma, right = np.linalg.svd(Z, full_matrices=False)
    return np.asarray(Z @ right[sigma > FACTOR_TOLERANCE * sigma[0]].T)


def dense_residual(problem: RiccatiProblem, space: WeightedSystem, Z: Array) -> float:
    """||A'XE + E'XA - E'XB R^{-1} B'XE + C'QC||_2 / ||C'QC||_2 for X = Z Z'."""
    moved, driven = space.E.T @ Z, space.A.T @ Z
    gain = moved @ (Z.T @ space.B)
    C = square_root(problem.Q) @ space.C
    cross = driven @ moved.T
    residual = cross + cross.T - gain @ np.linalg.solve(problem.R, gain.T) + C.T @ C
    return float(np.abs(np.linalg.eigvalsh(residual)).max() / (np.linalg.norm(C @ C.T, 2) or 1.0))


@dataclass(frozen=True)
class DenseRiccati:
    """Solve the Riccati equation of a small scene in energy-scaled modal coordinates, on rank 0."""

    tolerance: float = 1e-8  # bound on the true relative residual in hand-relative coordinates
    # largest number of states; the work grows with its cube, memory is about 400 byte times its square
    limit: int = 2500

    def solve(self, problem: RiccatiProblem) -> RiccatiSolution:
        """All modes by LAPACK, Schur form, Newton steps; the result is spread over the ranks. Collective.

        Raises:
            ResourceError: more states than ``limit``.
            ControlError: weights or data are refused, or feedback cannot stabilise some mode.
            SolverError: the true residual misses ``tolerance``.
        """
        layout, comm = problem.layout, problem.layout.comm
        if layout.states > self.limit:
            raise ResourceError(
                f"dense: {layout.states} states are more than {self.limit}; use newton_adi, radi or galerkin instead"
            )
        check_weights(problem.Q, problem.R, problem.C_s.shape[0], problem.inputs)
        tissue = gather_tissue(problem)
        result: RiccatiSolution | None = None
        with raise_on_all_ranks(comm):
            if tissue is not None:
                result = self._solve_on_root(problem, tissue)
        return spread(layout, result)

    def _solve_on_root(self, problem: RiccatiProblem, tissue: TissueMatrices) -> RiccatiSolution:
        begin = time.perf_counter()
        check_finite(M=tissue.M, K=tissue.K, D=tissue.D, G=tissue.G, C=tissue.C_z)
        plant = dense_modes(problem, tissue)
        rates = closed_loop_rates(problem, plant)
        if rates.lost.any():
            raise ControlError(lost_sentence(rates))
        middle = time.perf_counter()
        solution = care_of(plant.space)
        n_s, k = problem.layout.n_s, len(plant.omega)
        hand, q, v = slice(0, 2 * n_s), slice(2 * n_s, 2 * n_s + k), slice(2 * n_s + k, None)
        small = factor_psd(solution.X)
        Z = np.vstack([small[hand], plant.massed @ (plant.omega[:, None] * small[q]), plant.Phi @ small[v]])
        K_z = plant.massed @ (plant.omega[:, None] * solution.K[:, q].T)
        K_v = plant.massed @ solution.K[:, v].T
        residual = dense_residual(problem, assemble_space(problem, tissue), Z)
        if not residual <= self.tolerance:
            raise SolverError(
                f"dense: the true residual is {residual:.1e}, allowed is {self.tolerance:.1e}; raise control.tolerance "
                "or weigh Q and R nearer to each other"
            )
        return RiccatiSolution(
            Block(Z[: 2 * n_s], Z[2 * n_s :]),
            Gain(solution.K[:, hand], K_z, K_v),
            residual,
            "dense",
            counts={"newton_steps": solution.newton_steps, "adi_steps": 0, "solves": 0},
            seconds={"modes": middle - begin, "schur": time.perf_counter() - middle},
        )


def spread(layout: BlockLayout, result: RiccatiSolution | None) -> RiccatiSolution:
    """Give every rank its rows of a solution that rank 0 has whole. Collective."""
    ranges = layout.comm.gather((layout.start, layout.start + layout.n_local))
    pieces: list[RiccatiSolution] | None = None
    if result is not None and ranges is not None:
        pieces = []
        for a, b in ranges:
            Z, K, n_e = result.factor, result.gain, layout.n_e
            tall = np.asfortranarray(np.concatenate([Z.tall[a:b], Z.tall[n_e + a : n_e + b]]))
            gain = Gain(K.K_s, np.asfortranarray(K.K_z[a:b]), np.asfortranarray(K.K_v[a:b]))
            pieces.append(replace(result, factor=Block(Z.hand, tall), gain=gain))
    part: RiccatiSolution = layout.comm.scatter(pieces)
    return part
