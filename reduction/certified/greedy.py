"""The lazy POD-Greedy [HO08]: train where the bound is largest, until it is below a tolerance everywhere on a grid.

Bounds hardly ever grow with the basis, so that old values of the bound are nearly upper bounds: only points that could
be the largest are evaluated again. Nothing here depends on what is trained.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array

TOGETHER = 8  # points evaluated at once; of the last ones some need not have been
STALLED, GAIN = 3, 0.99  # rounds without the largest bound falling below this share of the least so far


@dataclass(frozen=True)
class GreedyStep:
    """One step of the greedy."""

    at: int  # number of the trained point
    k: int  # number of modes afterwards
    bound: float  # largest relative bound on the grid afterwards
    worst: int  # number of the point with the largest bound
    evaluations: int  # number of bounds computed so far
    seconds: float  # time since the start, without the pause of resumed runs [s]


@dataclass(frozen=True)
class Greedy:
    """State of a greedy after some rounds; enough to go on from, together with the basis."""

    rounds: tuple[GreedyStep, ...]  # steps so far
    known: Array  # last known bound of every point, infinite where there is none, (points,)
    reason: str = ""  # key of :data:`REASONS` for the stop; empty while it goes on

    @property
    def reached(self) -> bool:
        """Whether the tolerance was reached."""
        return self.reason == "tolerance"


def greedy(
    train: Callable[[int], int],
    bound: Callable[[Sequence[int]], Sequence[float]],
    state: Greedy,
    first: int,
    tolerance: float,
    most: int,
    progress: Callable[[Greedy], None] = lambda state: None,
) -> Greedy:
    """Train until the largest bound is at most the tolerance. As collective as ``train`` and ``bound`` are.

    Deterministic: of equal bounds the first point counts.

    Args:
        train: runs the full model at a point, extends the basis and returns its number of modes.
        bound: relative bounds of the basis at some points.
        state: to go on from; :func:`start` for a new one.
        first: point of the first round.
        tolerance: of the relative bound.
        most: modes that are not exceeded.
        progress: called with the state after every round.

    Returns:
        The last state, with the reason: "tolerance"; "stagnation", when three rounds of this call gained nothing;
        "size", when there are no modes left to add; "exhausted", when a run adds no mode to the basis.
    """
    begin = time.perf_counter() - (state.rounds[-1].seconds if state.rounds else 0.0)
    evaluations = state.rounds[-1].evaluations if state.rounds else 0
    rounds, known, reason = list(state.rounds), state.known.copy(), ""
    at, since = rounds[-1].worst if rounds else first, max(len(rounds) - 1, 0)
    k = rounds[-1].k if rounds else 0
    if rounds and rounds[-1].bound <= tolerance:
        reason = "tolerance"
    while not reason:
        more = train(at)
        fresh = np.zeros(len(known), dtype=bool)
        while True:
            order = np.argsort(-known, kind="stable")
            if fresh[order[0]] and (known[order[0]] > tolerance or fresh.all()):
                break
            todo = [int(i) for i in order if not fresh[i]][:TOGETHER]  # below the tolerance all are looked at
            known[todo] = bound(todo)
            fresh[todo] = True
            evaluations += len(todo)
        worst = int(order[0])
        rounds.append(GreedyStep(at, more, float(known[worst]), worst, evaluations, time.perf_counter() - begin))
        reason = _reason(rounds[since:], tolerance, more == k, more >= most)
        at, k = worst, more
        progress(Greedy(tuple(rounds), known.copy(), reason))
    return Greedy(tuple(rounds), known, reason)


def start(points: int) -> Greedy:
    """State before the first round."""
    return Greedy((), np.full(points, np.inf))


def _reason(rounds: Sequence[GreedyStep], tolerance: float, nothing: bool, full: bool) -> str:
    values = [r.bound for r in rounds]
    if values[-1] <= tolerance:
        return "tolerance"
    if full or nothing:
        return "size" if full else "exhausted"
    before, last = values[:-STALLED], values[-STALLED:]
    if before and np.isfinite(min(before)) and min(last) > GAIN * min(before):
        return "stagnation"
    return ""


REASONS = {
    "tolerance": "the bound is at most the tolerance at every point",
    "stagnation": f"{STALLED} rounds gained nothing: what is left is rounding, or moves in too many modes",
    "size": "the basis has as many modes as reduction.max_N allows",
    "exhausted": "the worst run adds no mode to the basis: what is left is rounding",
}
"""Why a greedy stopped, in words."""
