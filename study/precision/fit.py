"""Pareto fronts and slopes of work-precision points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.study.precision.points import WorkPoint
from softgrasp.study.reduce.linear.result import unbeaten
from softgrasp.study.shell import power_law

GAIN = 0.01  # of the error: what a slower point must gain to be on the front


@dataclass(frozen=True)
class Slope:
    """error ~ factor * x^power, fitted by least squares in logarithms."""

    question: str  # question of the points
    series: str  # series of the points
    against: str  # what x is
    power: float  # exponent
    count: int  # points behind it
    expected: float | None = None  # exponent of the theory, where there is one


def usable[P: WorkPoint](points: Sequence[P]) -> list[P]:
    """Points that may be used and have a finite error and time."""
    return [p for p in points if p.ok and np.isfinite(p.error) and np.isfinite(p.seconds) and p.seconds > 0]


def pareto[P: WorkPoint](points: Sequence[P], x: str = "seconds", y: str = "error") -> list[P]:
    """Points that no other beats in the attributes x and y at once, by x; less than :data:`GAIN` counts as none."""
    good = [(getattr(p, x), getattr(p, y), p) for p in points if p.ok]
    return [p for *_, p in unbeaten([c for c in good if np.isfinite(c[0]) and np.isfinite(c[1]) and c[0] > 0], GAIN)]


def series_of[P: WorkPoint](points: Sequence[P], name: Callable[[P], str] | None = None) -> dict[str, list[P]]:
    """Points by their line, or by another name, in the order of the first ones."""
    lines: dict[str, list[P]] = {}
    for p in points:
        lines.setdefault(p.series if name is None else name(p), []).append(p)
    return lines


def slope(
    line: Sequence[WorkPoint],
    against: str,
    x: str,
    y: str,
    series: str = "",
    expected: float | None = None,
    root: int = 1,
) -> list[Slope]:
    """The slope of one attribute y against another, x^(1 / root), over a line; nothing where they do not give one."""
    power = power_law([getattr(p, x) ** (1 / root) for p in line], [getattr(p, y) for p in line])
    if power is None:
        return []
    return [Slope(line[0].question, series or line[0].series, against, power, len(line), expected)]


def slopes(points: Sequence[WorkPoint], *relations: tuple[str, str, str]) -> tuple[Slope, ...]:
    """Of every series of usable points and relation: what against what in words, and the attributes x and y."""
    lines = series_of([p for p in points if p.ok]).values()
    return tuple(s for line in lines for relation in relations for s in slope(line, *relation))


def interpolate(x: float, xs: Sequence[float], ys: Sequence[float], power: float | None = None) -> float:
    """y(x), linear between logarithms; outside by the end's slope, or by ``power`` when it is given."""
    order = np.argsort(xs)
    a, b = np.log(np.array(xs, dtype=float)[order]), np.log(np.maximum(np.array(ys, dtype=float)[order], 1e-300))
    at = float(np.log(x))
    if len(a) == 1:
        return float(np.exp(b[0] + (power or 0.0) * (at - a[0])))
    if a[0] <= at <= a[-1]:
        return float(np.exp(np.interp(at, a, b)))
    i, j = (0, 1) if at < a[0] else (-1, -2)
    slope = power if power is not None else (b[i] - b[j]) / (a[i] - a[j])
    return float(np.exp(b[i] + slope * (at - a[i])))
