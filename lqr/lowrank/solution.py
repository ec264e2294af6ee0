"""From the columns of a solver to the public solution."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.lqr.lowrank.compress import compress
from softgrasp.lqr.lowrank.plant import Block, Plant
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.plant.problem import RiccatiSolution

STOP = 0.8  # share of the tolerance at which a recursion stops
DROP = 0.1  # share that the last compression may add
# Rounding in Z and in the solves lets the true residual exceed the tolerance a little; more means a garbage solve.
SLACK = 2.0


@dataclass
class Outcome:
    """What a low-rank solver hands over.

    Attributes:
        Z: columns in costate form.
        gain: K' = (B'XE)', z-row as it stands.
        method: name and reason.
        tol: tolerance asked for.
        lean: Z has no columns to spare.
    """

    Z: Block
    gain: Block
    method: str
    tol: float
    history: list[dict[str, float]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    lean: bool = False


def make_solution(plant: Plant, outcome: Outcome, check: bool = True) -> RiccatiSolution:
    """Compress, leave the costate scaling and recompute the residual from Z. Collective.

    Args:
        plant: the plant.
        outcome: columns and gain.
        check: raise when the true residual misses the tolerance.

    Raises:
        SolverError: the true residual is more than twice the tolerance.
    """
    begin = time.perf_counter()
    n = plant.n_local
    Z = outcome.Z if outcome.lean else compress(plant, outcome.Z, DROP * outcome.tol * plant.scale)
    K = -np.linalg.solve(np.linalg.cholesky(plant.problem.R).T, outcome.gain.hand.T)
    tall = -outcome.gain.tall @ np.linalg.inv(np.linalg.cholesky(plant.problem.R))
    result = RiccatiSolution(
        Z_s=Z.hand,
        Z_z=np.asfortranarray(plant.stiff(Z.tall[:n])),
        Z_v=np.asfortranarray(Z.tall[n:]),
        K_s=K,
        K_z=np.asfortranarray(tall[:n]),
        K_v=np.asfortranarray(tall[n:]),
        residual=np.inf,
        method=outcome.method,
        history=tuple(outcome.history),
        counts=outcome.counts,
    )
    middle = time.perf_counter()
    value = residual(plant.problem, result)
    seconds = outcome.seconds | {"compress": middle - begin, "residual": time.perf_counter() - middle}
    if check and not value <= SLACK * outcome.tol:
        raise SolverError(
            f"{outcome.method.split(':')[0]}: the residual recomputed from Z is {value:.1e}, tolerance "
            f"{outcome.tol:.0e}; rounding limits this problem: ask for a larger tolerance or add damping"
        )
    return replace(result, residual=value, seconds=seconds)
