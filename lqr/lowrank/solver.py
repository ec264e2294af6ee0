"""Base of the low-rank solvers: plant, start and tissue solves, and the solution from the columns of its factor."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.lqr.lowrank.compress import compress
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.lowrank.shifted import ShiftedTissue, make_shifted
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution, SolverName

Progress = Callable[[dict[str, float]], None]
STOP = 0.8  # share of the tolerance at which a recursion stops
DROP = 0.1  # share that the last compression may add
# Rounding in Z and in the solves lets the true residual exceed the tolerance a little; more means a garbage solve.
SLACK = 2.0


@dataclass
class Iterate:
    """Result of the iteration."""

    Z: Block  # factor X ~ Z Z' in costate form, hand (2 n_s, rank), local rows (2 n_local, rank)
    gain: Block  # K' = (B'XE)' with unscaled z-row, hand (2 n_s, m), local rows (2 n_local, m)
    about: str  # method, order and kind of tissue solver, in words
    history: list[dict[str, float]]  # residual or change of each iteration, one dictionary each
    counts: dict[str, int]  # number of tissue solves ("solves") and of iterations by name
    seconds: dict[str, float] = field(default_factory=dict)  # time by stage [s]


@dataclass(frozen=True, kw_only=True)
class LowRankSolver[Start](ABC):
    """Solve A'XE + E'XA - E'XB R^{-1} B'XE + C'QC = 0 for X = Z Z'."""

    method: ClassVar[SolverName]  # name of the solver in scenes and results
    by_residual: ClassVar[bool] = True  # whether Z is compressed and accepted by its true residual
    tol: float = 1e-10  # bound on the true relative residual, 2-norm, hand-relative coordinates
    tissue: str = "auto"  # gathered, distributed or auto, see softgrasp.lqr.lowrank.shifted; for galerkin also definite
    progress: Progress | None = None  # called on every rank with every history entry

    def solve(self, problem: RiccatiProblem) -> RiccatiSolution:
        """Run to the tolerance. Collective. The problem is not changed.

        Raises:
            ControlError: weights or data are refused, no damping, not stabilisable or not detectable.
            SolverError: not converged within the bounds, or, where ``by_residual``, the true residual is more than
                twice the tolerance.
            CheckpointError: the restart file belongs to another run.
        """
        begin = time.perf_counter()
        plant = Plant(problem)
        start = self.prepare(plant)
        seconds = {"start": time.perf_counter() - begin}
        tissue = self.tissue_solver(plant, start)
        try:
            iterate = self.iterate(plant, tissue, start)
        finally:
            tissue.destroy()
        counts = {"newton_steps": 0, "adi_steps": 0, "factorisations": tissue.factors} | iterate.counts
        seconds |= iterate.seconds | tissue.seconds
        middle, n = time.perf_counter(), plant.n_local
        Z = compress(plant, iterate.Z, DROP * self.tol * plant.scale) if self.by_residual else iterate.Z
        lower = np.linalg.cholesky(problem.R)
        K = -np.linalg.solve(lower.T, iterate.gain.hand.T)
        tall = -iterate.gain.tall @ np.linalg.inv(lower)
        factor = Block(Z.hand, np.asfortranarray(np.concatenate([plant.stiff(Z.tall[:n]), Z.tall[n:]])))
        seconds["compress"] = time.perf_counter() - middle
        middle = time.perf_counter()
        value = residual(problem, factor)
        end = time.perf_counter()
        seconds |= {"residual": end - middle, "total": end - begin}
        if self.by_residual and not value <= SLACK * self.tol:
            raise SolverError(
                f"{self.method}: the residual recomputed from Z is {value:.1e}, tolerance "
                f"{self.tol:.0e}; rounding limits this problem: request a larger tolerance or add damping"
            )
        gain = Gain(K, np.asfortranarray(tall[:n]), np.asfortranarray(tall[n:]))
        return RiccatiSolution(
            factor, gain, value, self.method, iterate.about,
            history=tuple(iterate.history), counts=counts, seconds=seconds,
        )  # fmt: skip

    @abstractmethod
    def prepare(self, plant: Plant) -> Start:
        """Preparation before the tissue solves. Collective."""

    def tissue_solver(self, plant: Plant, start: Start) -> ShiftedTissue:
        """What solves with S(p). Collective."""
        return make_shifted(plant.system, self.tissue)

    @abstractmethod
    def iterate(self, plant: Plant, tissue: ShiftedTissue, start: Start) -> Iterate:
        """The iteration, to the tolerance. Collective."""

    def record(self, history: list[dict[str, float]], entry: dict[str, float]) -> None:
        """Append an entry to the history and report it to the observer."""
        history.append(entry)
        if self.progress is not None:
            self.progress(entry)
