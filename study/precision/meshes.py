"""Meshes of a study: even ones of a box that halve their cells, and tolerances of graded ones."""

from __future__ import annotations

from math import ceil

import numpy as np

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.settings import Setting, least_steps

POINT_WORK = {2: 8e6, 3: 1e6}  # unknowns times steps of a point of the diagram
FEW_STEPS = 60  # least of a run
PARTS = 16  # of the scene's cells along an edge, at most, in one cell of the smallest mesh
STRETCH = 1.35  # of a cell of the smallest mesh against one of the scene's
EVEN = 4  # meshes of each order
ORDERS = (1, 2, 3)
FASTEST, SLOWEST = 0.2, 0.6  # errors of graded meshes fall about as their tolerances, by 0.3
# Tolerances of the a-priori graded meshes of the diagram, by dimension and order.
GOALS = {
    2: {1: (0.3, 0.1, 0.03), 2: (0.1, 0.03, 0.01, 3e-3, 1e-3), 3: (0.1, 0.03, 0.01, 3e-3, 1e-3)},
    3: {1: (0.3, 0.1), 2: (0.3, 0.03, 0.01), 3: (0.3, 0.03, 0.01)},
}


def edges(scene: Scene) -> list[list[float]]:
    """Coordinates that mesh lines should meet, as shares of each edge of the body: ends of contact and layers."""
    size, origin = scene.tissue.size or [], scene.tissue.origin or [0.0] * len(scene.tissue.size or [])
    boxes = [layer.box for layer in scene.tissue.layers.values()] + [scene.contact.box]
    lines = []
    for a, (length, low) in enumerate(zip(size, origin, strict=True)):
        shares = {round((corner[a] - low) / length, 12) for box in boxes if box is not None for corner in box}
        lines.append(sorted(s for s in shares if 0 < s < 1))
    return lines


def fits(cells: int, shares: list[float]) -> bool:
    """Whether all coordinates lie on lines of an even mesh."""
    return all(abs(cells * s - round(cells * s)) < 1e-6 for s in shares)


def fitted(target: float, shares: list[float]) -> int | None:
    """Number of cells nearest to a target whose lines meet all coordinates; None when none within a half does."""
    span = range(max(1, ceil(target / 1.6)), int(target * 1.6) + 2)
    good = [n for n in span if fits(n, shares)]
    return min(good, key=lambda n: (abs(n - target), -n)) if good else None


def smallest_mesh(scene: Scene) -> tuple[int, ...]:
    """The fewest cells in about the scene's shape whose lines meet the ends of contact zone and layers.

    Where no mesh meets them all, a quarter of the scene's cells along an edge.
    """
    cells, lines = scene.tissue.cells or [], edges(scene)
    for part in range(PARTS, 0, -1):
        counts = [fitted(n / part, shares) for n, shares in zip(cells, lines, strict=True)]
        unit = tuple(n for n in counts if n is not None)
        stretch = [u * part / n for u, n in zip(unit, cells, strict=False)]
        if len(unit) == len(cells) and max(stretch) <= STRETCH * min(stretch):
            return unit
    return tuple(max(1, round(n / 4)) for n in cells)


def even_meshes(scene: Scene, order: int) -> list[tuple[int, ...] | None]:
    """The finest even meshes of a box, each with half the cells of the next; of a mesh file, the file."""
    if scene.tissue.cells is None:
        return [None]
    unit, d = smallest_mesh(scene), len(scene.tissue.cells)
    meshes = [unit]
    while True:
        cells = tuple(2 * n for n in meshes[-1])
        if Setting(cells, order, 1).unknowns(d) * few_steps(scene) > POINT_WORK[d]:
            return list(meshes[-EVEN:])
        meshes.append(cells)


def few_steps(scene: Scene) -> int:
    """Steps of the runs on fine meshes."""
    n = scene.time.steps
    return n // 2 if n >= 2 * max(FEW_STEPS, least_steps(scene)) else n


def contraction(changes: list[float]) -> float:
    """By what errors fall from mesh to mesh, from the last changes of the solution: the larger ones are cautious."""
    if len(changes) < 2 or not changes[-2] > 0:
        return SLOWEST
    return float(np.clip(changes[-1] / changes[-2], FASTEST, SLOWEST))
