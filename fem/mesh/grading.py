"""Cell sizes that fall towards singular ends, and lines of a box that follow them (numpy only, not collective)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from softgrasp.fem.mesh.singular import Ends

Floats = npt.NDArray[np.float64]

# mu < alpha / p with alpha about 1/2 gives elements of order p their full order; below it the cells next to the end
# shrink so fast that the floor, not mu, decides where they stop.
BISECTION = {1: 0.45, 2: 0.15, 3: 0.1}
LINES = {1: 0.45, 2: 0.3, 3: 0.2}
STEEPEST = 50.0  # largest over smallest distance of lines: the aspect of cells, and the digits that solves lose by it
SLACK = 1.5  # a cell is split when it is larger than its size by this factor
SAMPLES = 400


@dataclass(frozen=True)
class SizeField:
    """h(r) = max(floor, h0 min(1, r / R)^(1 - mu)) at the distance r from the nearest end."""

    ends: Ends  # the singular ends
    h0: float  # size far from them [m]
    radius: float  # R [m]
    mu: float  # grading [1]; 1 is uniform
    floor: float  # smallest size [m]

    def __call__(self, x: Floats) -> Floats:
        """Size at points (n, d), (n,) [m]."""
        r = np.minimum(self.ends.distance(x), self.radius)
        return np.maximum(self.h0 * (r / self.radius) ** (1 - self.mu), min(self.floor, self.h0))


def graded_line(cuts: Sequence[float], ends: Sequence[float], n: int, mu: float, radius: float) -> Floats:
    """N + 1 coordinates with a line at every cut, whose distances fall as min(1, r / R)^(1 - mu) towards the ends.

    Each stretch between cuts takes its share of the n cells by int dx / h(x) and places them so that all are equal in
    this measure; no distance falls below 1 / `STEEPEST` of the largest size.

    Args:
        cuts: sorted coordinates, the first and last bound the line [m].
        ends: those towards which distances fall [m].
        n: number of cells; raised to the number of stretches.
        mu: grading, 0 < mu <= 1 [1].
        radius: R [m].
    """
    measures, places = [], []
    for a, b in pairwise(cuts):
        half = (b - a) / 2
        t = half * np.linspace(0.0, 1.0, SAMPLES + 1) ** 3  # dense where h is small
        x = np.concatenate([a + t, (b - t)[-2::-1]])
        r = np.full(len(x), np.inf)
        for end in ends:
            r = np.minimum(r, np.abs(x - end))
        density = 1 / np.maximum(np.minimum(1.0, r / radius) ** (1 - mu), 1 / STEEPEST)
        count = np.concatenate([[0.0], np.cumsum(np.diff(x) * (density[1:] + density[:-1]) / 2)])
        measures.append(count[-1])
        places.append((count, x))
    weights = np.array(measures)
    n = max(n, len(weights))
    share = np.maximum(1, np.floor(n * weights / weights.sum())).astype(int)
    while share.sum() < n:
        share[np.argmax(weights / share)] += 1
    while share.sum() > n:
        share[np.argmin(np.where(share > 1, weights / share, np.inf))] -= 1
    line = [np.array([cuts[0]])]
    for k, (count, x) in zip(share, places, strict=True):
        part = np.interp(np.arange(1, k + 1) / k * count[-1], count, x)
        part[-1] = x[-1]
        line.append(part)
    return np.concatenate(line)


def merged(cuts: Sequence[float], others: Sequence[float], gap: float) -> list[float]:
    """Sorted cuts, and those of the others that keep a distance from all before them."""
    result = list(cuts)
    for other in others:
        if all(abs(other - c) > gap for c in result):
            result.append(other)
    return sorted(result)
