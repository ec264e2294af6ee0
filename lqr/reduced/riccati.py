"""The paper's reduced Riccati equations: project, solve, and check the gain on the full plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array, on_root, total
from softgrasp.lqr.dense.care import WeightedSystem, solve_reduced
from softgrasp.lqr.lowrank.compress import gram, triangular
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import (
    costates_to_absolute,
    descriptor,
    descriptor_adjoint,
    dynamics,
    gain_to_absolute,
    inputs_adjoint,
    outputs,
)
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.bases import RiccatiBasis, energy_scaled
from softgrasp.lqr.reduced.ranking import modal_excess
from softgrasp.lqr.spectrum.certificate import Abscissa
from softgrasp.lqr.spectrum.divided import Certificates
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, LoopQuality, ModalLoop, SampledRadius
from softgrasp.lqr.spectrum.sampled import SampledLoop, Sampling, midpoint_radius

NAN = float("nan")


@dataclass(frozen=True)
class ReducedRiccati:
    """Reduced equation of a basis, its solution P_hat = V P_N V' and gain."""

    basis: RiccatiBasis  # basis, scaled to energy
    matrices: WeightedSystem  # E_N, A_N, B_N, C_N with the weights
    P_N: Array  # solution of the reduced equation, (N, N)
    gain: Gain  # gain K_hat on the full plant


@dataclass(frozen=True, kw_only=True)
class GainQuality:
    """A gain against the optimal one, on the full plant; nan where there is none."""

    error_K: float = NAN  # noqa: N815  ||K - K_hat||_F / ||K||_F in the paper's coordinates
    # J(K_hat) / J(K) - 1 from the scene's start: on the modes kept, or with bounds of the full loop as it runs
    cost_excess: float = NAN
    abscissa_full: float = NAN  # largest real part of the full closed loop [1/s]
    reason: str = ""  # why there is no gain; empty when there is one
    certified: bool = True  # whether the sign of the abscissa is certain, see LoopQuality
    examined: bool = True  # whether the spectrum is that of the full plant; else of the modes kept
    sampled: SampledRadius | None = None  # radius from tick to tick; None where the instants are unknown
    gain: Gain | None = None  # gain K_hat; None where there is none
    cost_excess_at_most: float = NAN  # bound on the excess cost of the loop as it runs; nan where not requested
    cost_excess_proved: float = NAN  # proved part of that bound, see softgrasp.lqr.design.orders.with_bounds
    bounded_to: float = NAN  # end of the run behind the two bounds [s]

    @property
    def stable(self) -> bool:
        """Whether the full closed loop was computed and is stable. A gain without this mark is never offered."""
        fine = not self.reason and self.certified and self.abscissa_full < 0
        return fine and (self.sampled is None or self.sampled.stable)

    @property
    def promising(self) -> bool:
        """Whether there is a gain that nothing known of its poles rules out."""
        fine = not self.reason and self.abscissa_full < 0
        return fine and (self.sampled is None or self.sampled.value < 1)

    @property
    def ruled_out(self) -> bool:
        """Whether the gain is unstable, or the full plant does not certify that it is stable."""
        return not (self.stable if self.examined else self.promising)

    @property
    def unbounded(self) -> str:
        """Why the cost has no bound; empty where it has one."""
        if self.reason or np.isfinite(self.cost_excess_at_most):
            return self.reason and f"there is no gain: {self.reason}"
        if not self.promising:
            return "the full loop is unstable"
        if np.isnan(self.cost_excess_at_most):
            return "no bound was requested"
        if np.isfinite(self.cost_excess_proved):
            return f"the loop as it runs does not settle within {self.bounded_to:.4g} s"
        return "the cost of the run overflows"


@dataclass(frozen=True)
class GainReport(GainQuality):
    """Quality of the gain of one reduced equation."""

    method: str  # key of the basis
    N: int  # order of the reduced equation
    error_P: float = NAN  # noqa: N815  ||P - P_hat||_F / ||P||_F in the paper's coordinates
    time_are: float = NAN  # time of one solution of the reduced equation, nan unless the caller measures it [s]
    matrices: WeightedSystem | None = None  # reduced equation; None where it is not kept


def project_plant(problem: RiccatiProblem, basis: RiccatiBasis) -> WeightedSystem:
    """E_N = W'EU, A_N = W'AU, B_N = W'B, C_N = CU. Collective."""
    comm, W, U = problem.layout.comm, basis.W, basis.U
    return WeightedSystem(
        E=gram(comm, W, descriptor(problem, U)),
        A=gram(comm, W, dynamics(problem, U)),
        B=np.ascontiguousarray(inputs_adjoint(problem, W).T),
        C=outputs(problem, U),
        Q=problem.Q,
        R=problem.R,
    )


def full_gain(problem: RiccatiProblem, basis: RiccatiBasis, P_N: Array) -> Gain:
    """K_hat' = -E'W P_N (W'B) R^{-1}; no material enters but by P_N. Collective."""
    small = -P_N @ np.linalg.solve(problem.R, inputs_adjoint(problem, basis.W)).T
    return Gain.of_block(descriptor_adjoint(problem, basis.W).times(small))


def reduce_riccati(problem: RiccatiProblem, basis: RiccatiBasis) -> ReducedRiccati:
    """A_N'P_N E_N + E_N'P_N A_N - E_N'P_N B_N R^{-1} B_N'P_N E_N + C_N'Q C_N = 0 and its gain [SBRH21]. Collective.

    The basis is scaled to energy first, and the equation is solved on rank 0.

    ``basis``: costates W and states U of N columns.

    Raises ControlError: the reduced equation has no stabilising solution.
    """
    basis = energy_scaled(problem, basis)
    matrices = project_plant(problem, basis)
    P_N = on_root(problem.layout.comm, lambda: solve_reduced(matrices))
    return ReducedRiccati(basis, matrices, P_N, full_gain(problem, basis, P_N))


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


def gain_error(problem: RiccatiProblem, gain: Gain, gain_hat: Gain) -> float:
    """||K - K_hat||_F / ||K||_F in the paper's coordinates. Collective."""
    system, K, K_hat = problem.system, gain.block, gain_hat.block
    difference = gain_to_absolute(system, Block(K.hand - K_hat.hand, K.tall - K_hat.tall))
    return norm(problem, difference) / norm(problem, gain_to_absolute(system, K))


def tissue_gain_error(problem: RiccatiProblem, gain: Gain, gain_hat: Gain) -> float:
    """||K - K_hat||_F / ||K||_F of the tissue's rows alone: those of a heavy hand are large. Collective."""
    K, K_hat, none = gain.block, gain_hat.block, np.zeros((0, len(gain.K_s)))
    return norm(problem, Block(none, K.tall - K_hat.tall)) / (norm(problem, Block(none, K.tall)) or 1.0)


class GainCheck:
    """Compares reduced gains with the optimal one on the full plant.

    Args:
        solution: the Riccati solution of the full plant.
        start: start minus target of hand and tissue, hand-relative, one column.
        loop: the full closed loop; made here when None.
        law: instants of the loop; None checks the continuous law alone.
    """

    def __init__(
        self,
        problem: RiccatiProblem,
        solution: RiccatiSolution,
        start: Block,
        loop: ModalLoop | None = None,
        law: Sampling | None = None,
    ) -> None:
        self.problem, self.solution, self.K = problem, solution, solution.gain.block
        Z = solution.factor
        self.Z_absolute = costates_to_absolute(problem.system, Z)
        self.start = start
        self.loop = ModalLoop(problem) if loop is None else loop
        self.law, self.ticks = law, SampledLoop(problem, self.loop)
        self.certificates = Certificates(problem, solution.gain)
        self._best: LoopQuality | SolverError | None = None
        self.optimal = float(np.sum(gram(problem.layout.comm, Z, descriptor(problem, start)) ** 2))
        if not self.optimal > 0:
            raise ControlError("the start is the target: nothing moves, so the cost of a gain cannot be compared")

    @cached_property
    def best(self) -> LoopQuality:
        """Closed loop of the full plant under the optimal gain. Collective at the first request.

        Raises SolverError: see :meth:`stabilities`.
        """
        if self._best is None:
            (self._best,) = self.stabilities([self.solution.gain])
        return self._with_cost(self._best, self.K)

    def quality(self, gain: Gain) -> LoopQuality:
        """Abscissa, excess cost and sampled radius of any gain. Collective.

        The cost is that of the continuous law, on the modes that ``loop`` keeps. Raises SolverError: see
        :meth:`stabilities`.
        """
        return self._with_cost(self.stabilities([gain])[0], gain.block)

    def _with_cost(self, quality: LoopQuality | SolverError, K: Block) -> LoopQuality:
        if isinstance(quality, SolverError):
            raise quality
        excess = self._modal(self.loop, K).cost_excess if quality.abscissa < 0 else np.inf
        return replace(quality, cost_excess=excess)

    def stabilities(self, gains: Sequence[Gain]) -> list[LoopQuality | SolverError]:
        """Abscissa and sampled radius of any gains, without their cost. Collective.

        Plants of no more modes than ``loop`` keeps use all. Larger ones have the abscissa from
        :class:`softgrasp.lqr.spectrum.divided.Certificates`; where the certificate fails, all modes are used up to
        :data:`softgrasp.lqr.spectrum.modal_loop.DENSE_LIMIT`. Beyond, a gain of which no eigenvalue converges has the
        error in its place.
        """
        if self.loop.complete:
            return [self._of_poles(gain.block, self.loop) for gain in gains]
        return [self._judged(*pair) for pair in zip(gains, self.certificates.of(gains), strict=True)]

    def _judged(self, gain: Gain, spectrum: Abscissa | SolverError) -> LoopQuality | SolverError:
        """Quality of a gain by its certificate, or by all modes where it fails and they fit. Collective."""
        K, fits = gain.block, self.problem.layout.n_e <= DENSE_LIMIT
        if isinstance(spectrum, SolverError):
            if not fits:
                return spectrum
            self.loop = self.ticks.modes(whole=True)  # nor would it converge for the next gain
            return self._of_poles(K, self.loop)
        if fits and not spectrum.certified:
            return self._of_poles(K, self.ticks.modes(whole=True))
        poles = spectrum.eigenvalues
        try:
            return self._sampled(K, LoopQuality(spectrum.value, NAN, spectrum.certified, spectrum.exact, poles))
        except SolverError as error:
            return error

    def _of_poles(self, K: Block, loop: ModalLoop) -> LoopQuality:
        """Quality of a gain from the modes that a loop keeps; certain where they are all. Collective."""
        poles = loop.poles(K)
        value = float(poles.real.max()) if np.isfinite(poles).all() else np.inf
        quality = LoopQuality(value, NAN, loop.complete, loop.complete, poles)
        if self.law is None or not self.law.every or loop.complete:
            return self._sampled(K, quality)
        return replace(quality, sampled=self.ticks.of_modes(K, loop, self.law))

    def excesses(self, gains: Sequence[Gain]) -> Array:
        """J(K_hat) / J(K) - 1 of the loop as it is sampled, held and late, on the modes kept, (gains,). Collective."""
        n_s = self.problem.layout.n_s
        hand = np.vstack([np.eye(n_s, 2 * n_s, n_s), np.linalg.solve(self.problem.M_s, self.solution.gain.K_s)])
        settle = 6 / max(-float(np.linalg.eigvals(hand).real.max()), np.finfo(float).tiny)
        blocks = [gain.block for gain in gains]
        return modal_excess(self.loop, blocks, self.K, self.start, self.law, settle) / self.optimal

    def _modal(self, loop: ModalLoop, K: Block) -> LoopQuality:
        """Abscissa and excess cost of a gain on the modes that a loop keeps. Collective."""
        return loop.quality(K, self.K, self.start, self.optimal)

    def _sampled(self, K: Block, quality: LoopQuality) -> LoopQuality:
        """The quality with the radius from tick to tick; for the law at the midpoint by the poles. Collective."""
        if self.law is None:
            return quality
        if self.law.every:
            return replace(quality, sampled=self.ticks.radius_of(K, self.law))
        radius = SampledRadius(midpoint_radius(quality.poles, self.law.dt), quality.certified, quality.exact)
        return replace(quality, sampled=radius)

    def report(self, basis: RiccatiBasis) -> GainReport:
        """Errors, poles and cost of the gain of one basis. Collective.

        A reduced equation without solution is reported, not raised; a gain whose spectrum does not converge is not
        certified.
        """
        report = self.first_look(basis)
        if report.gain is None:
            return report
        try:
            return self.with_quality(report, report.gain)
        except SolverError:
            return replace(report, certified=False, examined=True)

    def first_look(self, basis: RiccatiBasis, *, error_P: bool = True) -> GainReport:  # noqa: N803
        """Errors of P and of the gain, and its poles on the modes kept: no solve with the full plant. Collective."""
        try:
            reduced = reduce_riccati(self.problem, basis)
        except ControlError as error:
            return GainReport(basis.name, basis.N, reason=str(error))
        distance = factor_error(self.problem, self.Z_absolute, reduced.basis, reduced.P_N) if error_P else NAN
        error_K, gain = gain_error(self.problem, self.solution.gain, reduced.gain), reduced.gain  # noqa: N806
        known = self._of_poles(gain.block, self.loop)
        return GainReport(
            basis.name, basis.N, distance, matrices=reduced.matrices, gain=gain, error_K=error_K,
            abscissa_full=known.abscissa, certified=known.certified, sampled=known.sampled,
            examined=self.loop.complete,
        )  # fmt: skip

    def examined(self, reports: Sequence[GainReport]) -> list[GainReport]:
        """The reports with the spectrum of the full plant; not certified where it does not converge. Collective.

        The optimal gain is examined beside them if it was not before.
        """
        gains = {i: r.gain for i, r in enumerate(reports) if not r.examined and r.gain is not None}
        first = [self.solution.gain] if self._best is None and gains else []
        known = self.stabilities([*first, *gains.values()])
        if first:
            self._best, *known = known
        result = list(reports)
        for i, quality in zip(gains, known, strict=True):
            if isinstance(quality, SolverError):
                result[i] = replace(reports[i], certified=False, examined=True)
                continue
            result[i] = replace(
                reports[i], abscissa_full=quality.abscissa, certified=quality.certified, sampled=quality.sampled,
                examined=True,
            )  # fmt: skip
        return result

    def with_quality[Figures: GainQuality](self, report: Figures, gain: Gain) -> Figures:
        """The report with errors, poles and cost of a gain. Collective. Raises SolverError: see :meth:`quality`."""
        quality = self.quality(gain)
        return replace(
            report, gain=gain, error_K=gain_error(self.problem, self.solution.gain, gain),
            cost_excess=quality.cost_excess, abscissa_full=quality.abscissa, certified=quality.certified,
            sampled=quality.sampled, examined=True,
        )  # fmt: skip
