"""Motions that no setting of reduced contact was chosen with: drawn from a seed before any model ran on them.

They land on a half-space below, at other speeds, places and depths than the scene; the last two land twice.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import quintic

SEED = 281128
COUNT = 5
TWICE = 2  # of them land twice
SAMPLES = 400  # of a table over the whole time


def drawn_motions(target: tuple[float, float], duration: float, end: float, seed: int = SEED) -> list[Array]:
    """Tables t, x, y of the hand, (SAMPLES + 1, 3) each [s, m]: rest-to-rest moves one after another.

    Args:
        target: of the scene [m]; its second component is the way down.
        duration: of the scene's move [s].
        end: of the run [s]; at least 1.5 durations.
        seed: of all draws.
    """
    rng, tables = np.random.default_rng(seed), []
    aside, down = abs(target[0]) or abs(target[1]) / 2, target[1]
    t = np.linspace(0.0, end, SAMPLES + 1)
    for i in range(COUNT):
        place = np.array([aside * rng.uniform(-2, 2), down * rng.uniform(0.95, 1.15)])
        if i < COUNT - TWICE:
            moves = [(duration * rng.uniform(0.6, 1.4), place)]
        else:
            first, lift, last = duration * rng.uniform((0.4, 0.2, 0.3), (0.6, 0.3, 0.45))
            high = place * [1, 1 - rng.uniform(0.1, 0.3)]
            again = np.array([place[0] + aside * rng.uniform(-0.5, 0.5), down * rng.uniform(0.95, 1.15)])
            moves = [(first, place), (lift, high), (last, again)]
        path, begin, here = np.zeros((len(t), 2)), 0.0, np.zeros(2)
        for seconds, there in moves:
            path += np.outer(quintic(np.maximum(t - begin, 0.0), seconds)[0], there - here)
            begin, here = begin + seconds, there
        tables.append(np.column_stack([t, path]))
    return tables


def written(table: Array, folder: Path, name: str = "drawn") -> list[str]:
    """Overrides of a scene whose hand follows a table, which is written to a file."""
    file = folder / f"{name}.csv"
    np.savetxt(file, table, delimiter=",")
    return [f"motion={{profile='csv', csv='{file}'}}"]
