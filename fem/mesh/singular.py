"""Where the displacement of the tissue is singular, and how strongly (numpy only, not collective).

Near a corner of the boundary u ~ r^alpha; a mesh of uniform cells h then leaves an error of the outputs of the order
h^(2 alpha), whatever the polynomial order of the elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from softgrasp.fem.mesh.check import Flags, Floats, Integers, sort_facets

Kind = Literal["contact end", "re-entrant", "held corner", "layer end"]

KINDS: tuple[Kind, ...] = ("re-entrant", "contact end", "held corner")  # by the number of sides held
REGULAR = 0.8  # exponents above lose no order that a mesh of practical size would show: 2 alpha is nearly that of P1
STRAIGHT = 1e-6  # largest deviation of the angle of a flat boundary [rad]: rounding only


@dataclass(frozen=True)
class Ends:
    """Singular points (2D) or edges (3D) of a body."""

    at: Floats  # coordinates of the points, (n, 1, 2), or of both ends of the edges, (n, 2, 3) [m]
    angle: Floats  # angle of the body there, (n,) [rad]
    alpha: Floats  # real part of the exponent, (n,) [1]; 1/2 is assumed at ends of layers, where both materials decide
    kind: tuple[Kind, ...]  # kind of each end, n words

    def distance(self, x: Floats) -> Floats:
        """Distance of points (n, d) from the nearest end [m], (n,); inf if there is none."""
        nearest = np.full(len(x), np.inf)
        for end in self.at:
            a = end[0]
            r = x - a
            if len(end) == 2:
                edge = end[1] - a
                r = r - np.outer(np.clip(r @ edge / (edge @ edge), 0.0, 1.0), edge)
            np.minimum(nearest, np.einsum("ij,ij->i", r, r), out=nearest)
        return np.sqrt(nearest)


def expected_order(ends: Ends, order: int, graded: bool, edges: bool = False) -> float:
    """Order of the outputs in n_e^(1/d): 2 p on graded meshes, min(2 p, 2 alpha) on even ones.

    ``edges``: whether the mesh is bisected in 3D, where small cells along an edge are many: at most 3.
    """
    full = 2.0 * order
    if graded:
        return min(full, 3.0) if edges else full
    return min(full, 2 * float(ends.alpha.min(initial=full)))


def exponent(angle: float, nu: float, held: int) -> float:
    """Real part of the smallest exponent alpha > 0 of u ~ r^alpha at a corner in plane strain [W52].

    With kappa = 3 - 4 nu,

        sin^2(alpha w) = alpha^2 sin^2 w                                         both sides free,
        sin^2(alpha w) = ((kappa + 1)^2 - 4 alpha^2 sin^2 w) / (4 kappa)         one side held,
        sin^2(alpha w) = alpha^2 sin^2 w / kappa^2                               both sides held.

    Args:
        angle: angle w of the body [rad], 0 < w <= 2 pi.
        nu: Poisson's ratio [1].
        held: how many of the two sides are held, 0 to 2.

    Returns:
        alpha, at most 1 (beyond which nothing is singular).
    """
    kappa, s = 3 - 4 * nu, np.sin(angle)
    if held == 1:
        return _mixed(angle, kappa, s)
    if angle <= np.pi:  # nothing is singular there
        return 1.0
    from scipy.optimize import brentq  # slow to import, and few bodies have such a corner

    best, grid = 1.0, np.linspace(0.05, 1 - 1e-9, 400)
    for factor in (s, -s) if held == 0 else (s / kappa, -s / kappa):

        def gap(a: Any, factor: float = factor) -> Any:
            return np.sin(a * angle) - factor * a

        changes = np.flatnonzero(np.diff(np.sign(gap(grid))))
        if changes.size:
            best = min(best, float(brentq(gap, *grid[changes[0] : changes[0] + 2])))
    return best


def _mixed(angle: float, kappa: float, s: float) -> float:
    """Smallest root with one side held, by Newton from a grid of complex starts."""

    def gap(z: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
        return np.asarray(np.sin(z * angle) ** 2 - ((kappa + 1) ** 2 - 4 * z**2 * s**2) / (4 * kappa))

    z = (np.linspace(0.2, 1.1, 19)[:, None] + 1j * np.array([0.0, 0.05, 0.1, 0.2, 0.4])).ravel()
    for _ in range(30):  # what converges has rounding left after 25
        slope = angle * np.sin(2 * z * angle) + 2 * z * s**2 / kappa
        z = z - gap(z) / np.where(np.abs(slope) > 1e-12, slope, 1e-12)
        z = np.where(np.isfinite(z) & (np.abs(z) < 10), z, 10.0)
    real = z.real[(np.abs(gap(z)) < 1e-9) & (z.real > 0.02) & (np.abs(z) < 9)]
    return float(min(real.min(initial=1.0), 1.0))


def singular_ends(points: Floats, cells: Integers, held: Integers, layers: Integers, nu: Floats) -> Ends:
    """Ends of the contact zone, re-entrant corners or edges, and corners of layer interfaces.

    Args:
        points: shape (n_points, d) [m].
        cells: simplices, shape (n_cells, d + 1).
        held: contact facets, shape (n, d).
        layers: number of the layer of each cell, shape (n_cells,).
        nu: Poisson's ratio of each cell [1], shape (n_cells,).
    """
    d = points.shape[1]
    facets = sort_facets(cells)
    outer, (one, other) = facets.nodes[facets.outer], facets.pairs
    between = facets.nodes[:-1][facets.same][layers[one] != layers[other]]
    code = np.array([len(points) ** k for k in range(d)], dtype=np.int64)
    clamped = np.isin(outer @ code, np.sort(held, axis=1) @ code)
    ridges, angle = _angles(points, cells)
    parts = {"held": outer[clamped], "free": outer[~clamped], "inner": between}
    on = {name: _per_ridge(part, ridges, d) for name, part in parts.items()}
    ratio = np.zeros(len(ridges))
    for corner in combinations(range(d + 1), d - 1):
        np.maximum.at(ratio, _find(ridges, np.sort(cells[:, list(corner)], axis=1)), nu)
    chosen: list[int] = []
    alphas: list[float] = []
    kinds: list[Kind] = []
    boundary = on["held"] + on["free"] > 0
    odd = boundary & ((on["held"] > 0) | (np.abs(angle - np.pi) > STRAIGHT))
    cache: dict[tuple[int, int, int], float] = {}
    for i in np.flatnonzero(odd).tolist():
        sides = 1 if on["held"][i] and on["free"][i] else 0 if on["free"][i] else 2
        key = (round(angle[i] * 1e4), round(ratio[i] * 1e6), sides)
        if key not in cache:
            cache[key] = exponent(min(angle[i], 2 * np.pi), ratio[i], sides)
        if cache[key] < REGULAR:
            chosen.append(i)
            alphas.append(cache[key])
            kinds.append(KINDS[sides])
    for i in np.flatnonzero(_layer_ends(points, between, ridges, on["inner"], boundary, d)).tolist():
        if i not in chosen:
            chosen.append(i)
            alphas.append(0.5)
            kinds.append("layer end")
    index = np.array(chosen, dtype=np.int64)
    return Ends(points[ridges[index]].reshape(-1, d - 1, d), angle[index], np.array(alphas), tuple(kinds))


def _find(ridges: Integers, rows: Integers) -> Integers:
    """Numbers of the ridges that sorted rows are, (rows,)."""
    n = int(ridges.max(initial=0)) + 1
    code = np.array([n**k for k in reversed(range(ridges.shape[1]))], dtype=np.int64)
    return np.searchsorted(ridges @ code, rows @ code)


def _angles(points: Floats, cells: Integers) -> tuple[Integers, Floats]:
    """All vertices (2D) or edges (3D), (ridges, d - 1), and the sum of the cells' angles there [rad], (ridges,)."""
    d = points.shape[1]
    rows, values = [], []
    for corner in combinations(range(d + 1), d - 1):
        others = [i for i in range(d + 1) if i not in corner]
        a, b = (points[cells[:, i]] - points[cells[:, corner[0]]] for i in others)
        if d == 3:  # dihedral angle: both arms at right angles to the edge
            edge = points[cells[:, corner[1]]] - points[cells[:, corner[0]]]
            edge = edge / np.linalg.norm(edge, axis=1)[:, None]
            a, b = (v - np.einsum("ij,ij->i", v, edge)[:, None] * edge for v in (a, b))
        cosine = np.einsum("ij,ij->i", a, b) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        rows.append(np.sort(cells[:, list(corner)], axis=1))
        values.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    ridges, inverse = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    return ridges, np.bincount(inverse.ravel(), weights=np.concatenate(values), minlength=len(ridges))


def _per_ridge(facets: Integers, ridges: Integers, d: int) -> Integers:
    """Number of the facets (sorted rows) that meet at each ridge, (ridges,)."""
    count = np.zeros(len(ridges), dtype=np.int64)
    for corner in combinations(range(d), d - 1):
        np.add.at(count, _find(ridges, facets[:, list(corner)]), 1)
    return count


def _layer_ends(points: Floats, facets: Integers, ridges: Integers, inner: Integers, boundary: Flags, d: int) -> Flags:
    """Whether interfaces of layers reach the boundary, branch, or turn at each ridge, (ridges,)."""
    normals = np.zeros((len(ridges), d, d))  # sum of n n' of the facets at a ridge: of rank 1 where they are level
    if len(facets):
        edges = points[facets[:, 1:]] - points[facets[:, :1]]
        normal = np.cross(edges[:, 0], edges[:, 1]) if d == 3 else np.stack([-edges[:, 0, 1], edges[:, 0, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        for corner in combinations(range(d), d - 1):
            np.add.at(normals, _find(ridges, facets[:, list(corner)]), normal[:, :, None] * normal[:, None, :])
    turned = np.zeros(len(ridges), dtype=np.bool_)
    two = inner == 2
    turned[two] = np.linalg.eigvalsh(normals[two])[:, -2] > STRAIGHT
    return ((inner > 0) & boundary) | (inner > 2) | turned
