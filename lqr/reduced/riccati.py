"""The paper's reduced Riccati equations: solve, lift, and say what the gain is worth on the full plant."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.lqr.dense.small_care import ReducedMatrices, solve_reduced
from softgrasp.lqr.lowrank.compress import gram, triangular
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.coordinates import costates_to_absolute, factor_of, gain_of, gain_to_absolute
from softgrasp.lqr.plant.operators import descriptor, descriptor_adjoint, dynamics, inputs_adjoint, outputs
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import RiccatiBasis, energy_scaled
from softgrasp.lqr.spectrum.certificate import certified_abscissa
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, LoopQuality, ModalLoop, SampledRadius
from softgrasp.lqr.spectrum.sampled import SampledLoop, Sampling, midpoint_radius


@dataclass(frozen=True)
class ReducedRiccati:
    """P_hat = V P_N V' and its gain.

    Attributes:
        basis: the basis, scaled to energy.
        matrices: E_N, A_N, B_N, C_N with the weights.
        P_N: (N, N).
        gain: K_hat, transposed, hand-relative coordinates.
        seconds: to solve the reduced equation once the matrices are there, best of three.
    """

    basis: RiccatiBasis
    matrices: ReducedMatrices
    P_N: Array
    gain: Block
    seconds: float


@dataclass(frozen=True)
class GainReport:
    """What a reduced gain is worth.

    Attributes:
        method: key of the basis.
        N: order of the reduced equation.
        error_P: ||P - P_hat||_F / ||P||_F in the paper's coordinates.
        error_K: ||K - K_hat||_F / ||K||_F in the paper's coordinates.
        cost_excess: J(K_hat) / J(K) - 1 from the scene's start on the full plant.
        abscissa_full: largest real part of the full closed loop [1/s].
        time_are: seconds for the reduced equation.
        reason: why there is no gain; empty when there is one.
        certified: the sign of the abscissa is certain, see :class:`lqr.spectrum.modal_loop.LoopQuality`.
        sampled: the loop from tick to tick, where its instants are known.
    """

    method: str
    N: int
    error_P: float  # noqa: N815
    error_K: float  # noqa: N815
    cost_excess: float
    abscissa_full: float
    time_are: float
    reason: str = ""
    certified: bool = True
    sampled: SampledRadius | None = None

    @property
    def stable(self) -> bool:
        """Whether the full closed loop was computed and is stable. A gain without this mark is never offered."""
        fine = not self.reason and self.certified and self.abscissa_full < 0
        return fine and (self.sampled is None or self.sampled.stable)


def project(problem: RiccatiProblem, basis: RiccatiBasis) -> ReducedMatrices:
    """E_N = W'EU, A_N = W'AU, B_N = W'B, C_N = CU. Collective."""
    comm, W, U = problem.layout.comm, basis.W, basis.U
    return ReducedMatrices(
        E=gram(comm, W, descriptor(problem, U)),
        A=gram(comm, W, dynamics(problem, U)),
        B=np.ascontiguousarray(inputs_adjoint(problem, W).T),
        C=outputs(problem, U),
        Q=problem.Q,
        R=problem.R,
    )


def lift_gain(problem: RiccatiProblem, basis: RiccatiBasis, P_N: Array) -> Block:
    """K_hat' = -E'W P_N (W'B) R^{-1}, transposed, hand-relative. Collective."""
    small = -P_N @ np.linalg.solve(problem.R, inputs_adjoint(problem, basis.W)).T
    return descriptor_adjoint(problem, basis.W).times(small)


def reduce_riccati(problem: RiccatiProblem, basis: RiccatiBasis) -> ReducedRiccati:
    """Scale to energy, project, solve the reduced equation on rank 0, lift. Collective.

    Raises:
        ControlError: the reduced equation has no stabilising solution.
    """
    basis = energy_scaled(problem, basis)
    matrices = project(problem, basis)

    def solve() -> tuple[Array, float]:
        best = np.inf
        for _ in range(3):
            begin = time.perf_counter()
            P_N = solve_reduced(matrices)
            best = min(best, time.perf_counter() - begin)
        return P_N, best

    P_N, seconds = on_root(problem.layout.comm, solve)
    return ReducedRiccati(basis, matrices, P_N, lift_gain(problem, basis, P_N), seconds)


def factor_error(problem: RiccatiProblem, Z: Block, basis: RiccatiBasis, P_N: Array) -> float:
    """||Z Z' - V P_N V'||_F / ||Z Z'||_F in the paper's coordinates, by QR of [Z, V]. Collective."""
    V = costates_to_absolute(problem.system, basis.W)
    R = triangular(problem.layout.comm, Block.join([Z, V]))
    R_Z, R_V = R[:, : Z.columns], R[:, Z.columns :]
    P = R_Z @ R_Z.T
    return float(np.linalg.norm(P - R_V @ P_N @ R_V.T) / np.linalg.norm(P))


def norm(problem: RiccatiProblem, X: Block) -> float:
    """Frobenius norm of a tall block. Collective."""
    square = float(np.sum(X.hand**2)) + float(total(problem.layout.comm, np.array([np.sum(X.tall**2)]))[0])
    return float(np.sqrt(square))


def gain_error(problem: RiccatiProblem, K: Block, K_hat: Block) -> float:
    """||K - K_hat||_F / ||K||_F in the paper's coordinates. Collective."""
    system = problem.system
    difference = gain_to_absolute(system, Block(K.hand - K_hat.hand, K.tall - K_hat.tall))
    return norm(problem, difference) / norm(problem, gain_to_absolute(system, K))


class GainJudge:
    """Compares reduced gains with the optimal one on the full plant.

    Args:
        problem: the plant.
        solution: the Riccati solution of the full plant.
        start: start minus target of hand and tissue, hand-relative, one column.
        loop: the full closed loop; made here when None.
        law: instants of the loop; None judges the continuous law alone.
    """

    def __init__(
        self,
        problem: RiccatiProblem,
        solution: RiccatiSolution,
        start: Block,
        loop: ModalLoop | None = None,
        law: Sampling | None = None,
    ) -> None:
        self.problem = problem
        self.Z, self.K = factor_of(solution), gain_of(solution)
        self.Z_absolute = costates_to_absolute(problem.system, self.Z)
        self.start = start
        self.loop = ModalLoop(problem) if loop is None else loop
        self.whole: ModalLoop | None = None
        self.law, self.ticks = law, SampledLoop(problem, self.loop)
        self.optimal = float(np.sum(gram(problem.layout.comm, self.Z, descriptor(problem, start)) ** 2))
        if not self.optimal > 0:
            raise ControlError("the start is the target: nothing moves, so the cost of a gain cannot be compared")

    def quality(self, gain: Block) -> LoopQuality:
        """Abscissa, cost excess and sampled radius of any gain. Collective.

        Large scenes take the abscissa from :func:`lqr.spectrum.certificate.certified_abscissa` and the cost from the
        lowest modes; where the certificate fails, all modes are taken as long as a dense spectrum is affordable.
        """
        if self.loop.complete:
            return self._sampled(gain, self.loop.quality(gain, self.K, self.start, self.optimal))
        spectrum = certified_abscissa(self.problem, gain)
        if not spectrum.certified and self.problem.layout.n_e <= DENSE_LIMIT:
            return self.by_all_modes(gain)
        found = self.loop.quality(gain, self.K, self.start, self.optimal)
        excess = found.cost_excess if spectrum.value < 0 else np.inf
        poles = spectrum.eigenvalues
        return self._sampled(gain, LoopQuality(spectrum.value, excess, spectrum.certified, spectrum.exact, poles))

    def by_all_modes(self, gain: Block) -> LoopQuality:
        """The same from the whole spectrum, up to :data:`lqr.spectrum.modal_loop.DENSE_LIMIT` modes. Collective."""
        if self.whole is None:
            self.whole = self.loop if self.loop.complete else ModalLoop(self.problem, DENSE_LIMIT)
            self.ticks = SampledLoop(self.problem, self.whole)
        return self._sampled(gain, self.whole.quality(gain, self.K, self.start, self.optimal))

    def _sampled(self, gain: Block, found: LoopQuality) -> LoopQuality:
        """With the radius from tick to tick; that of the law at the midpoint follows from the poles. Collective."""
        if self.law is None:
            return found
        if self.law.every:
            return replace(found, sampled=self.ticks.judge(gain, self.law))
        radius = SampledRadius(midpoint_radius(found.poles, self.law.dt), found.certified, found.exact)
        return replace(found, sampled=radius)

    def report(self, basis: RiccatiBasis) -> GainReport:
        """All figures of one basis; a reduced equation without solution is reported, not raised. Collective."""
        nothing = float("nan")
        try:
            reduced = reduce_riccati(self.problem, basis)
        except ControlError as error:
            return GainReport(basis.name, basis.N, nothing, nothing, nothing, nothing, nothing, str(error))
        found = self.quality(reduced.gain)
        return GainReport(
            method=basis.name,
            N=basis.N,
            error_P=factor_error(self.problem, self.Z_absolute, reduced.basis, reduced.P_N),
            error_K=gain_error(self.problem, self.K, reduced.gain),
            cost_excess=found.cost_excess,
            abscissa_full=found.abscissa,
            time_are=reduced.seconds,
            certified=found.certified,
            sampled=found.sampled,
        )


def hand_start(problem: RiccatiProblem, displacement: Sequence[float] | Array) -> Block:
    """Whole body at rest, displaced rigidly by hand coordinates [m, rad], (n_s,), as one column. Not collective."""
    n_s = problem.layout.n_s
    hand = np.zeros((2 * n_s, 1))
    hand[:n_s, 0] = displacement
    return Block(hand, np.zeros((2 * problem.layout.n_local, 1)))
