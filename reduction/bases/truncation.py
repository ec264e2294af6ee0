"""How many vectors: N given, by energy, or by a tolerance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.reduction.bases.states import BasisError, Columns

PAPER_ENERGY = 0.999  # of the POD functional [SBRH21]


@dataclass(frozen=True)
class Part:
    """Vectors of one quantity in the order of their importance, by units: one column each, or a symplectic pair."""

    title: str  # quantity that it spans, for messages
    sigma: Array  # importance of the units over ``scale``, descending (singular values)
    total: float  # sum of all sigma^2, also of those that were not computed
    rank: int  # number of units that are more than noise
    # function that makes the leading k units, one set of columns per half of the pair; collective
    columns: Callable[[int], tuple[Columns, ...]]
    scale: float = 1.0  # power of two divided out of sigma, so that squares neither overflow nor vanish
    rate: float = 1.0  # weight c between displacement and momentum, see `reduction/bases/inner.py`


@dataclass(frozen=True)
class Truncation:
    """Exactly one of the three determines the number of vectors."""

    N: int | None = None  # dimension of the whole basis, with the hand's columns
    energy: float | None = None  # share of sum sigma^2 to keep at least in every part, 0 < energy < 1
    # relative projection error sqrt(sum of dropped sigma^2 / total) to reach in every part, 0 < tol < 1
    tol: float | None = None

    def __post_init__(self) -> None:
        if sum(x is not None for x in (self.N, self.energy, self.tol)) != 1:
            raise BasisError("give exactly one of N, energy and tol")
        for key, value in (("energy", self.energy), ("tol", self.tol)):
            if value is not None and not 0 < value < 1:
                raise BasisError(f"{key} = {value} must lie between 0 and 1")
        if self.N is not None and self.N < 1:
            raise BasisError(f"N = {self.N} must be at least 1")

    @property
    def share(self) -> float:
        """Share of sum sigma^2 that may be dropped."""
        if self.energy is not None:
            return 1.0 - self.energy
        return (self.tol or 0.0) ** 2


def needed(sigma: Array, total: float, share: float) -> int | None:
    """Smallest k whose dropped tail is at most ``share`` of the total; None if sigma ends before."""
    if total <= 0:
        return 0
    # from the small end: total minus a running sum would lose the tail to rounding
    unknown = max(total - float(np.sum(sigma**2)), 0.0) if len(sigma) else total
    tail = np.append(np.cumsum((sigma**2)[::-1])[::-1], 0.0)
    # what was not computed is in the tail unless it is only rounding of the total
    tail += unknown if unknown > 1e-14 * total * max(len(sigma), 1) else 0.0
    good = np.flatnonzero(tail <= share * total)
    return int(good[0]) if len(good) else None


def _allocate(parts: Sequence[Part], width: int, N: int, hand: int, name: str) -> tuple[int, ...]:
    """Share N - hand columns equally among the parts, the first ones getting one more where it does not divide.

    What a part cannot carry goes to the others. Displacement and velocity need equally many vectors, whatever their
    singular values: a displacement without its velocity cannot move.
    """
    free = N - hand
    if free < width or free % width:
        least = f"the {hand} columns of the hand plus " if hand else ""
        more = "an even number, at least 2" if width == 2 else "at least 1"
        raise BasisError(f"N = {N} does not fit; it must be {least}{more}", name)
    want, ranks = free // width, [part.rank for part in parts]
    if want > sum(ranks):
        carried = " + ".join([*(str(width * r) for r in ranks), *([f"{hand} of the hand"] if hand else [])])
        most = hand + width * sum(ranks)
        raise BasisError(
            f"N = {N} is more than the snapshots carry above rounding ({carried}); request N <= {most}", name, most
        )
    counts = [0] * len(parts)
    for _ in range(want):
        # the emptiest part that has a vector left, the first of several
        i = min((i for i, rank in enumerate(ranks) if counts[i] < rank), key=lambda i: counts[i])
        counts[i] += 1
    return tuple(counts)


def counts_of(parts: Sequence[Part], width: int, hand: int, rule: Truncation, name: str) -> tuple[int, ...]:
    """Units of every part by the rule; parts are equal, so that each keeps at least its share.

    Args:
        width: columns of one unit.
        hand: columns of the hand.

    Raises:
        BasisError: N is smaller than the hand's columns, no multiple of the unit, or the rule needs more than the
            rank.
    """
    if rule.N is not None:
        return _allocate(parts, width, rule.N, hand, name)
    counts = []
    for part in parts:
        k = needed(part.sigma, part.total, rule.share)
        if k is None or k > part.rank:
            raise BasisError(
                f"the {part.title} cannot be kept to {rule.share:.1e} of its energy with the {part.rank} "
                "singular values above rounding; request a larger tol, or an N",
                name,
            )
        counts.append(k)
    if not any(counts):
        raise BasisError(f"the snapshots of the {' and of the '.join(p.title for p in parts)} are zero", name)
    return tuple(min(max(counts), part.rank) for part in parts)
