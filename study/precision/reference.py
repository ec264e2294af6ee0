"""The solution that all settings are compared with, and how far it can be trusted itself.

    y* = y(m, S) + time part + space part,
    time part  = (y(m, S) - y(m, S/2)) / 3                       order 2 of the midpoint rule
    space part = y(M, s) + (y(M, s) - y(M/2, s)) / (2^p - 1) - y(m, s)

with nested P2 meshes M, M/2, M/4 ... , a middle one m, many steps S and few steps s; p is the order that three meshes
show. Space and time are refined apart, since both at once would cost the product. The error estimate adds up

    space: change of the extrapolated solution from the meshes (M/2, M/4, M/8) to (M, M/2, M/4)
    time:  the time part itself
    mixed: how much the time part changes from mesh m to m/2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.full import FullRuns, Series, largest
from softgrasp.study.precision.points import Setting, least_steps

WORK = {2: 4e7, 3: 3e6}  # unknowns times steps of the finest run: about 10 s on a quiet core
UNKNOWNS = {2: 150_000, 3: 40_000}
FINER = 4.5  # the finest mesh has at most so many times the scene's cells along an edge
FEW_STEPS = 60  # least of a run
ROUGH = 0.05  # error of a reference that is worth a warning
ORDERS = (0.4, 5.0)  # between which an observed order is believed


@dataclass(frozen=True)
class Reference:
    """The reference solution with its error estimate, relative to the largest displacement and deformation.

    Attributes:
        series: the solution.
        space, time, mixed: parts of the estimate, each (displacement, deformation).
        order: observed in space, None when three meshes do not show one.
        extrapolated: the space part was extrapolated.
        settings: that were run.
        note: one sentence.
    """

    series: Series
    space: tuple[float, float]
    time: tuple[float, float]
    mixed: tuple[float, float]
    order: float | None
    extrapolated: bool
    settings: tuple[Setting, ...]
    note: str

    @property
    def error(self) -> float:
        """Estimated relative error of the displacement."""
        return self.space[0] + self.time[0] + self.mixed[0]

    @property
    def error_deformation(self) -> float:
        """Estimated relative error of the deformation."""
        return self.space[1] + self.time[1] + self.mixed[1]


def edges(scene: Scene) -> list[list[float]]:
    """Coordinates that mesh lines should meet, as shares of each edge of the body: ends of contact and layers."""
    size, origin = scene.tissue.size or [], scene.tissue.origin or [0.0] * len(scene.tissue.size or [])
    boxes = [layer.box for layer in scene.tissue.layers.values()] + [scene.contact.box]
    found = []
    for a, (length, low) in enumerate(zip(size, origin, strict=True)):
        shares = {round((corner[a] - low) / length, 12) for box in boxes if box is not None for corner in box}
        found.append(sorted(s for s in shares if 0 < s < 1))
    return found


def fits(cells: int, shares: list[float]) -> bool:
    """Whether all coordinates lie on lines of a uniform mesh. Not collective."""
    return all(abs(cells * s - round(cells * s)) < 1e-6 for s in shares)


def fitted(target: float, shares: list[float]) -> int | None:
    """Number of cells nearest to a target whose lines meet all coordinates; None when none within a half does."""
    span = range(max(1, ceil(target / 1.6)), int(target * 1.6) + 2)
    good = [n for n in span if fits(n, shares)]
    return min(good, key=lambda n: (abs(n - target), -n)) if good else None


def nested_meshes(scene: Scene) -> tuple[tuple[int, ...], ...]:
    """Meshes that halve the cells from one to the next, coarse to fine; empty on a mesh file. Not collective.

    The coarsest has about a quarter of the scene's cells along an edge (a half, or all, when the ends of contact zone
    and layers lie on mesh lines only then). The finest is what the work allows.
    """
    cells = scene.tissue.cells
    if cells is None:
        return ()
    lines, d = edges(scene), len(cells)
    coarse: tuple[int, ...] = tuple(max(1, round(n / 4)) for n in cells)
    for part in (4, 2, 1):
        tried = [fitted(max(n / part, 1.0), shares) for n, shares in zip(cells, lines, strict=True)]
        if all(n is not None for n in tried):
            coarse = tuple(n for n in tried if n is not None)
            break
    steps = few_steps(scene)
    found = [coarse]
    while True:
        finer = tuple(2 * n for n in found[-1])
        unknowns = Setting(finer, 2, steps).unknowns(d)
        wide = max(f / c for f, c in zip(finer, cells, strict=True)) > FINER
        if wide or unknowns > UNKNOWNS[d] or unknowns * steps > WORK[d]:
            return tuple(found)
        found.append(finer)


def few_steps(scene: Scene) -> int:
    """Steps of the runs on the finest meshes. Not collective."""
    n = scene.time.steps
    return n // 2 if n >= 2 * max(FEW_STEPS, least_steps(scene)) else n


def observed_order(coarse: Array, middle: Array, fine: Array, d: int) -> float | None:
    """Order p with |middle - coarse| = 2^p |fine - middle|; None outside :data:`ORDERS`. Not collective."""
    first, second = largest(middle - coarse, d)[1], largest(fine - middle, d)[1]
    if not (first > 0 and second > 0):
        return None
    p = float(np.log2(first / second))
    return p if ORDERS[0] <= p <= ORDERS[1] else None


def extrapolate(values: list[Array], d: int) -> tuple[Array, float | None]:
    """Richardson limit of the last values of a sequence of halved meshes, and the order. Not collective."""
    p = observed_order(values[-3], values[-2], values[-1], d) if len(values) >= 3 else None
    if p is None:
        return values[-1], None
    return values[-1] + (values[-1] - values[-2]) / (2**p - 1), p


def make_reference(scene: Scene, runs: FullRuns) -> Reference:
    """Run the reference meshes and steps. Collective.

    Raises:
        SolverError: a run failed.
    """
    meshes: tuple[tuple[int, ...] | None, ...] = nested_meshes(scene) or (None,)
    few, base = few_steps(scene), scene.time.steps
    space = [Setting(cells, 2, few) for cells in meshes]
    if len(space) == 1:  # nothing to refine: P1 beside P2 tells what there is to know
        space = [Setting(space[0].cells, 1, few), space[0]]
    middle = space[max(len(space) - 3, 1 if len(space) > 2 else len(space) - 1)]
    below = space[max(space.index(middle) - 1, 0)]
    time = [Setting(middle.cells, middle.order, 2 * base), Setting(middle.cells, middle.order, 4 * base)]
    mixed = Setting(below.cells, below.order, 4 * base)
    found = {s: runs.series(runs.run(s, 1)) for s in (*space, *time, mixed)}
    result = combine(found, space, middle, below, base)
    if result.error > ROUGH:
        hint = " That is too much to judge by: the scene's steps or meshes do not resolve its motion; raise time.steps."
        result = replace(result, note=result.note + hint)
    if all(fits(n, shares) for n, shares in zip(scene.tissue.cells or (), edges(scene), strict=True)):
        return result
    hint = " The scene's own mesh has no lines at the ends of its contact zone or layers, which adds to its error."
    return replace(result, note=result.note + hint)


def combine(
    found: dict[Setting, Series], space: list[Setting], middle: Setting, below: Setting, base: int
) -> Reference:
    """y* and its error estimate from the runs. Not collective."""
    d = found[middle].dimension
    S, half = (Setting(middle.cells, middle.order, k * base) for k in (4, 2))
    fine = found[S]
    t, few = fine.times, found[middle].times

    def on(series: Series, times: Array) -> Array:
        return series.at(times)

    time_part = (fine.values - on(found[half], t)) / 3
    values = [found[s].values for s in space]
    limit, p = extrapolate(values, d)
    if len(values) >= 4 and p is not None:
        before, q = extrapolate(values[:-1], d)
        gap = limit - before if q is not None else values[-1] - values[-2]
    else:
        gap = limit - values[-1] if p is not None else values[-1] - values[-2]
    correction = Series(few, limit - found[middle].values, d)
    total = fine.values + time_part + on(correction, t)
    change = on(fine, few) - found[middle].values
    lower = found[Setting(below.cells, below.order, 4 * base)]
    mixed = change - (on(lower, few) - found[below].values) if below != middle else np.zeros_like(change)
    scale = largest(total, d)

    def relative(values: Array) -> tuple[float, float]:
        return tuple(g / s if s > 0 else 0.0 for g, s in zip(largest(values, d), scale, strict=True))  # type: ignore[return-value]

    space_error, time_error, mixed_error = (relative(v) for v in (gap, time_part, mixed))
    return Reference(
        series=Series(t, total, d),
        space=space_error,
        time=time_error,
        mixed=mixed_error,
        order=p,
        extrapolated=p is not None,
        settings=tuple(found),
        note=_note(space, middle, base, p, space_error[0] + time_error[0] + mixed_error[0]),
    )


def _note(space: list[Setting], middle: Setting, base: int, p: float | None, error: float) -> str:
    meshes = " to ".join([space[0].mesh, space[-1].mesh])
    if space[0].cells is None or len(space) < 3 or p is None:
        how = f"from {meshes}, not extrapolated, since their changes show no order"
        if space[0].cells is None:
            how = f"from {meshes}, whose difference is all that is known in space, since the mesh comes from a file"
    else:
        how = f"extrapolated in space from {meshes} with the observed order {p:.2f}"
    return (
        f"Reference: {how}, and in time with {4 * base} steps on {middle.mesh}; its own relative error is estimated as "
        f"{error:.1e}."
    )
