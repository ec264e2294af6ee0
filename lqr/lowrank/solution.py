"""From the columns of a solver to the public solution."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.lqr.lowrank.compress import compress
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiSolution, SolverName

STOP = 0.8  # share of the tolerance at which a recursion stops
DROP = 0.1  # share that the last compression may add
# Rounding in Z and in the solves lets the true residual exceed the tolerance a little; more means a garbage solve.
SLACK = 2.0


@dataclass
class Iterate:
    """What a low-rank solver hands over."""

    Z: Block  # columns in costate form
    gain: Block  # K' = (B'XE)', z-row as it stands
    method: SolverName
    about: str  # what it did, in words
    tol: float  # tolerance asked for
    history: list[dict[str, float]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    lean: bool = False  # Z has no columns to spare


def make_solution(plant: Plant, iterate: Iterate, start: float, check: bool = True) -> RiccatiSolution:
    """Compress, leave the costate scaling and recompute the residual from Z. Collective.

    Args:
        start: clock when the solver began [s].
        check: raise when the true residual misses the tolerance.

    Raises:
        SolverError: the true residual is more than twice the tolerance.
    """
    begin = time.perf_counter()
    n = plant.n_local
    Z = iterate.Z if iterate.lean else compress(plant, iterate.Z, DROP * iterate.tol * plant.scale)
    K = -np.linalg.solve(np.linalg.cholesky(plant.problem.R).T, iterate.gain.hand.T)
    tall = -iterate.gain.tall @ np.linalg.inv(np.linalg.cholesky(plant.problem.R))
    factor = Block(Z.hand, np.asfortranarray(np.concatenate([plant.stiff(Z.tall[:n]), Z.tall[n:]])))
    middle = time.perf_counter()
    value = residual(plant.problem, factor)
    end = time.perf_counter()
    seconds = iterate.seconds | {"compress": middle - begin, "residual": end - middle, "total": end - start}
    if check and not value <= SLACK * iterate.tol:
        raise SolverError(
            f"{iterate.method}: the residual recomputed from Z is {value:.1e}, tolerance "
            f"{iterate.tol:.0e}; rounding limits this problem: ask for a larger tolerance or add damping"
        )
    return RiccatiSolution(
        factor,
        Gain(K, np.asfortranarray(tall[:n]), np.asfortranarray(tall[n:])),
        value,
        iterate.method,
        iterate.about,
        history=tuple(iterate.history),
        counts=iterate.counts,
        seconds=seconds,
    )
