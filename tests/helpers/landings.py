"""Motions that chose no setting of reduced contact: of eight kinds, drawn from a seed after all settings were fixed.

They land on a half-space below, at other speeds, places and depths than the scene, once or twice; they sway on the way
or once down, bounce, press slowly, swing or drag. No part of a motion along the half-space is faster to and fro than
one over twice the way of the scene in 0.6 of its time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import quintic

SEED = 29110634
KINDS = ("land", "sway when down", "sway and land", "land twice", "press slowly", "bounce", "swing", "drag")
SAMPLES = 600  # of a table over the whole time
PEAK = 10 / np.sqrt(3)  # acceleration of a move over its way and time [1]
LIMIT = PEAK * 2 / 0.6**2  # largest acceleration along the half-space, over the way and time of the scene [1]

Place = tuple[float, float]


def drawn_motions(target: Place, duration: float, end: float, count: int, seed: int = SEED) -> list[tuple[str, Array]]:
    """Kinds and tables t, x, y of the hand, (SAMPLES + 1, 3) each [s, m].

    Args:
        target: of the scene [m]; its second component is the way down.
        duration: of the scene's move [s].
        end: of the run [s]; at least 1.5 durations.
        count: number of motions; their kinds take turns.
        seed: of all draws.
    """
    rng, found = np.random.default_rng(seed), []
    aside, down = abs(target[0]) or abs(target[1]) / 2, target[1]
    t = np.linspace(0.0, end, SAMPLES + 1)

    def part(low: float, high: float) -> float:
        """A part of the duration [s]."""
        return duration * float(rng.uniform(low, high))

    def quick(seconds: float, way: float) -> float:
        """At least the time that a way along the half-space takes within LIMIT [s]."""
        return max(seconds, duration * float(np.sqrt(PEAK * abs(way) / aside / LIMIT)))

    for i in range(count):
        kind = KINDS[i % len(KINDS)]
        x, y = aside * float(rng.uniform(-2, 2)), down * float(rng.uniform(0.95, 1.15))
        again = down * float(rng.uniform(0.95, 1.15))
        periods = float(np.exp(rng.uniform(np.log(0.5), np.log(5))))  # of a sway, in the duration
        wide = aside * float(rng.uniform(0.2, 1)) * min(0.5, LIMIT / (2 * np.pi * periods) ** 2)
        phase, less = float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(0.5, 1))
        wave = 2 * np.pi * periods * t / duration
        sway, heave = np.zeros(len(t)), np.zeros(len(t))
        if kind == "land":
            moves = [(part(0.6, 1.4), (x, y))]
        elif kind == "sway when down":
            moves = [(part(0.6, 0.9), (x, y))]
            sway = wide * _window(t, moves[0][0], end, 0.2 * duration) * np.sin(wave + phase)
        elif kind == "sway and land":
            moves = [(part(0.9, 1.4), (x, y))]
            sway = wide * _window(t, 0.0, moves[0][0], 0.2 * duration) * np.sin(wave + phase)
        elif kind == "land twice":
            other = x + aside * float(rng.uniform(-0.5, 0.5))
            moves = [
                (quick(part(0.4, 0.6), x), (x, y)),
                (part(0.2, 0.3), (x, y * float(rng.uniform(0.6, 0.9)))),
                (quick(part(0.3, 0.45), other - x), (other, again)),
            ]
        elif kind == "press slowly":
            moves = [(end * float(rng.uniform(0.9, 1)), (x * less, y))]
        elif kind == "bounce":
            moves = [(part(0.6, 0.8), (x, y))]
            lift = down * float(rng.uniform(0.02, 0.15)) * _window(t, moves[0][0], end, 0.2 * duration)
            heave = lift * (np.cos(wave) - 1) / 2
        elif kind == "swing":
            high = (x, down * float(rng.uniform(0, 0.7)))
            moves = [(quick(part(0.4, 0.7), x), high), (quick(part(0.5, 0.8), x * (1 + less)), (-x * less, y))]
        else:
            way = aside * float(rng.uniform(-1, 1))
            moves = [(part(0.6, 0.8), (x / 2, y)), (quick(part(0.4, 0.7), way), (x / 2 + way, again))]
        found.append((kind, np.column_stack([t, _path(t, moves) + np.column_stack([sway, heave])])))
    return found


def _path(t: Array, moves: list[tuple[float, Place]]) -> Array:
    """Rest-to-rest moves one after another, of seconds and ends, (len(t), 2)."""
    path, begin, here = np.zeros((len(t), 2)), 0.0, np.zeros(2)
    for seconds, there in moves:
        path += np.outer(quintic(np.maximum(t - begin, 0.0), seconds)[0], there - here)
        begin, here = begin + seconds, np.array(there)
    return path


def _window(t: Array, begin: float, end: float, fade: float) -> Array:
    """1 between two instants, and 0 outside of them."""
    up, down = (quintic(np.maximum(t - first, 0.0), fade)[0] for first in (begin, end - fade))
    return np.asarray(up * (1 - down))


def written(table: Array, folder: Path, name: str = "drawn") -> list[str]:
    """Overrides of a scene whose hand follows a table, which is written to a file."""
    file = folder / f"{name}.csv"
    np.savetxt(file, table, delimiter=",")
    return [f"motion={{profile='csv', csv='{file}'}}"]
