"""Uniform meshes of a box for a study: multiples of one smallest mesh, and the order in which they converge."""

from __future__ import annotations

from math import ceil

import numpy as np
from scipy.optimize import brentq

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision.settings import Setting, least_steps

WORK = {2: 5e7, 3: 6e6}  # unknowns times steps of the finest run of a reference: 10 to 30 s on a quiet core
UNKNOWNS = {2: 150_000, 3: 60_000}
FEW_STEPS = 60  # least of a run
PARTS = 16  # of the scene's cells along an edge, at most, in one cell of the smallest mesh
STRETCH = 1.35  # of a cell of the smallest mesh against one of the scene's
MULTIPLES = sorted({m * 2**i for m in (4, 5, 6) for i in range(8)} | {1, 2, 3})  # neighbours differ by at most 3/2


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
    """Whether all coordinates lie on lines of a uniform mesh."""
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


def nested_meshes(scene: Scene) -> tuple[tuple[int, ...], ...]:
    """Multiples of the smallest mesh up to what the work allows, coarse to fine; empty on a mesh file.

    The scene's own number of cells plays no part in how fine they get.
    """
    if scene.tissue.cells is None:
        return ()
    unit, steps, d = smallest_mesh(scene), few_steps(scene), len(scene.tissue.cells)
    meshes: list[tuple[int, ...]] = []
    for k in MULTIPLES:
        cells = tuple(k * n for n in unit)
        unknowns = Setting(cells, 2, steps).unknowns(d)
        if not meshes or (unknowns <= UNKNOWNS[d] and unknowns * steps <= WORK[d]):
            meshes.append(cells)
    return tuple(meshes)


def halved_meshes(scene: Scene, most: int) -> tuple[tuple[int, ...], ...]:
    """Of these meshes, the finest ones that double the cells from one to the next."""
    meshes = nested_meshes(scene)
    doubled = [c for c in meshes if (c[0] // meshes[0][0]).bit_count() == 1]
    return tuple(doubled[-most:])


def few_steps(scene: Scene) -> int:
    """Steps of the runs on the finest meshes."""
    n = scene.time.steps
    return n // 2 if n >= 2 * max(FEW_STEPS, least_steps(scene)) else n


def corner_exponent(poisson: float) -> float:
    """Exponent alpha of u ~ r^alpha where a held side meets a free one at a right angle, plane strain.

    sin(alpha pi / 2)^2 = ((kappa + 1)^2 - 4 alpha^2) / (4 kappa), kappa = 3 - 4 nu [Williams 1952].
    """
    kappa = 3 - 4 * poisson

    def off(alpha: float) -> float:
        return float(np.sin(alpha * np.pi / 2) ** 2 - ((kappa + 1) ** 2 - 4 * alpha**2) / (4 * kappa))

    return float(brentq(off, 0.3, 1.0)) if off(1.0) > 0 else 1.0  # nu <= 0: no more than a kink in the strains


def singular_order(scene: Scene) -> float:
    """Order of the outputs in the cells of a uniform mesh, 2 alpha for every element order; not collective.

    u ~ r^alpha at the ends of the contact zone: 1/2 where it ends within a side, :func:`corner_exponent` where it ends
    with its side.
    """
    tissue, box = scene.tissue, scene.contact.box
    size, origin = tissue.size or [], tissue.origin or [0.0] * len(tissue.size or [])
    held = {axis for axis, _ in scene.contact.axes(len(size))}
    for axis in held:
        if box is None:
            break
        low, high = ([(c[a] - origin[a]) / size[a] for a in range(len(size))] for c in box)
        if any(low[a] > 1e-9 or high[a] < 1 - 1e-9 for a in range(len(size)) if a != axis):
            return 1.0
    materials = [tissue.material, *(layer.material for layer in tissue.layers.values())]
    return 2 * min(corner_exponent(m.lam / (2 * (m.lam + m.mu))) for m in materials)


def observed_order(sizes: list[float], changes: list[float]) -> float | None:
    """Order p of values a + c h^p at three sizes h, coarse to fine, from their two changes.

    None without one between 0.05 and 6.
    """
    if not min(changes) > 0:
        return None
    h = np.array(sizes) / sizes[-1]

    def off(p: float) -> float:
        return float((h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - changes[0] / changes[1])

    return float(brentq(off, 0.05, 6.0)) if off(0.05) < 0 < off(6.0) else None


def limit_weights(sizes: list[float], orders: list[float]) -> np.ndarray:
    """Weights w of values a + sum_i c_i h^p_i at as many sizes as terms, a = sum w v."""
    terms = np.array([[1.0, *((h / sizes[-1]) ** p for p in orders)] for h in sizes])
    return np.asarray(np.linalg.inv(terms)[0])
