"""Where the displacement of the tissue is singular, and how strongly (numpy only, not collective).

Near a corner of the boundary u ~ r^alpha; a mesh of uniform cells h then leaves an error of the outputs of the order
h^(2 alpha), whatever the polynomial order of the elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
import numpy.typing as npt

from softgrasp.fem.mesh.check import Flags, Floats, Integers, on_boundary, sort_facets, with_nodes

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


def exponents(angle: Floats, nu: Floats, held: Integers) -> Floats:
    """Real parts of the smallest exponents alpha > 0 of u ~ r^alpha at corners in plane strain [W52].

    With kappa = 3 - 4 nu,

        sin^2(alpha w) = alpha^2 sin^2 w                                         both sides free,
        sin^2(alpha w) = ((kappa + 1)^2 - 4 alpha^2 sin^2 w) / (4 kappa)         one side held,
        sin^2(alpha w) = alpha^2 sin^2 w / kappa^2                               both sides held.

    Args:
        angle: angles w of the body [rad], 0 < w <= 2 pi, (n,).
        nu: Poisson's ratios [1], (n,).
        held: how many of the two sides are held, 0 to 2, (n,).

    Returns:
        alpha, at most 1 (beyond which nothing is singular), (n,).
    """
    alpha = np.ones(len(angle))
    mixed = held == 1
    alpha[mixed] = _mixed(angle[mixed], 3 - 4 * nu[mixed])
    alike = np.flatnonzero(~mixed & (angle > np.pi))  # at smaller angles nothing is singular
    w = angle[alike]
    factor = np.sin(w) / np.where(held[alike] == 0, 1.0, 3 - 4 * nu[alike])
    alpha[alike] = np.minimum(_crossing(w, factor), _crossing(w, -factor))
    return alpha


def _crossing(w: Floats, factor: Floats) -> Floats:
    """Smallest roots a < 1 of sin(a w) = factor a, by bisection where a grid changes sign first; 1 without any."""
    grid = np.linspace(0.05, 1 - 1e-9, 400)
    signs = np.sign(np.sin(np.multiply.outer(w, grid)) - np.multiply.outer(factor, grid))
    changes = np.diff(signs, axis=1) != 0
    first = changes.argmax(axis=1)
    low, high, before = grid[first], grid[first + 1], signs[np.arange(len(w)), first]
    for _ in range(40):  # leaves 2e-15
        middle = (low + high) / 2
        beyond = np.sign(np.sin(middle * w) - factor * middle) != before
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return np.where(changes.any(axis=1), high, 1.0)


def _mixed(w: Floats, kappa: Floats) -> Floats:
    """Smallest roots with one side held, by Newton from a grid of complex starts, at most 1."""
    w, kappa = w[:, None], kappa[:, None]
    s = np.sin(w)

    def gap(z: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
        return np.asarray(np.sin(z * w) ** 2 - ((kappa + 1) ** 2 - 4 * z**2 * s**2) / (4 * kappa))

    starts = (np.linspace(0.2, 1.1, 19)[:, None] + 1j * np.array([0.0, 0.05, 0.1, 0.2, 0.4])).ravel()
    z = np.tile(starts, (len(w), 1))
    for _ in range(30):  # what converges has rounding left after 25
        slope = w * np.sin(2 * z * w) + 2 * z * s**2 / kappa
        z = z - gap(z) / np.where(np.abs(slope) > 1e-12, slope, 1e-12)
        z = np.where(np.isfinite(z) & (np.abs(z) < 10), z, 10.0)
    roots = (np.abs(gap(z)) < 1e-9) & (z.real > 0.02) & (np.abs(z) < 9)
    return np.asarray(np.where(roots, z.real, 1.0).min(axis=1, initial=1.0))


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
    on = on_boundary(cells, len(points)) | _between(cells, layers, len(points))
    some = with_nodes(cells, on, d - 1)  # all that meet at a vertex or edge of the boundary or between layers
    cells, layers, nu = cells[some], layers[some], nu[some]
    facets = sort_facets(cells, on)
    outer, (one, other) = facets.nodes[facets.outer], facets.pairs
    between = facets.nodes[:-1][facets.same][layers[one] != layers[other]]
    code = np.array([len(points) ** k for k in range(d)], dtype=np.int64)
    clamped = np.isin(outer @ code, np.sort(held, axis=1) @ code)
    ridges, angle, ratio = _ridges(points, cells, nu, on)
    parts = {"held": outer[clamped], "free": outer[~clamped], "inner": between}
    at_ridges = {name: _per_ridge(part, ridges, d) for name, part in parts.items()}
    chosen: list[int] = []
    alphas: list[float] = []
    kinds: list[Kind] = []
    boundary = at_ridges["held"] + at_ridges["free"] > 0
    odd = boundary & ((at_ridges["held"] > 0) | (np.abs(angle - np.pi) > STRAIGHT))
    at = np.flatnonzero(odd)
    sides = np.where(at_ridges["held"][at] == 0, 0, np.where(at_ridges["free"][at] == 0, 2, 1))
    keys = np.column_stack([np.round(angle[at] * 1e4), np.round(ratio[at] * 1e6), sides])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    one = at[first]
    alpha = exponents(np.minimum(angle[one], 2 * np.pi), ratio[one], sides[first])[inverse.ravel()]
    for i, a, side in zip(at.tolist(), alpha.tolist(), sides.tolist(), strict=True):
        if a < REGULAR:
            chosen.append(i)
            alphas.append(a)
            kinds.append(KINDS[side])
    others = np.flatnonzero(_layer_ends(points, between, ridges, at_ridges["inner"], boundary, d))
    others = others[~np.isin(others, chosen)]
    chosen += others.tolist()
    alphas += [0.5] * len(others)
    kinds += ["layer end"] * len(others)
    index = np.array(chosen, dtype=np.int64)
    return Ends(points[ridges[index]].reshape(-1, d - 1, d), angle[index], np.array(alphas), tuple(kinds))


def _between(cells: Integers, layers: Integers, n_points: int) -> Flags:
    """Whether nodes belong to cells of several layers, (n_points,)."""
    if (layers == layers[:1]).all():
        return np.zeros(n_points, dtype=np.bool_)
    count = np.zeros(n_points, dtype=np.int64)
    for layer in np.unique(layers):
        touched = np.zeros(n_points, dtype=np.bool_)
        touched[cells[layers == layer]] = True
        count += touched
    return count > 1


def _find(ridges: Integers, rows: Integers) -> Integers:
    """Numbers of the ridges that sorted rows are, (rows,)."""
    n = int(ridges.max(initial=0)) + 1
    return np.searchsorted(_codes(ridges, n), _codes(rows, n))


def _codes(rows: Integers, n: int) -> Integers:
    """A number for each row of numbers below n, in the order of rows."""
    return np.asarray(rows @ np.array([n**k for k in reversed(range(rows.shape[1]))], dtype=np.int64))


def _ridges(points: Floats, every: Integers, nu: Floats, on: Flags) -> tuple[Integers, Floats, Floats]:
    """Vertices (2D) or edges (3D) of flagged nodes, (ridges, d - 1), sum of angles there [rad], greatest nu."""
    d, flags = points.shape[1], on[every]
    rows, values, ratios = [], [], []
    for corner in combinations(range(d + 1), d - 1):
        here = flags[:, list(corner)].all(axis=1)
        cells = every[here]
        others = [i for i in range(d + 1) if i not in corner]
        a, b = (points[cells[:, i]] - points[cells[:, corner[0]]] for i in others)
        if d == 3:  # dihedral angle: both arms at right angles to the edge
            edge = points[cells[:, corner[1]]] - points[cells[:, corner[0]]]
            edge = edge / np.linalg.norm(edge, axis=1)[:, None]
            a, b = (v - np.einsum("ij,ij->i", v, edge)[:, None] * edge for v in (a, b))
        cosine = np.einsum("ij,ij->i", a, b) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        rows.append(np.sort(cells[:, list(corner)], axis=1))
        values.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
        ratios.append(nu[here])
    corners = np.concatenate(rows)
    _, first, inverse = np.unique(_codes(corners, len(points)), return_index=True, return_inverse=True)
    ratio = np.zeros(len(first))
    np.maximum.at(ratio, inverse, np.concatenate(ratios))
    return corners[first], np.bincount(inverse, weights=np.concatenate(values), minlength=len(first)), ratio


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
