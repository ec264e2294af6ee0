"""Geometry of pictures: the drawn hand, outlines, and which instants to show. Plain arrays in and out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

if TYPE_CHECKING:
    from fem.gather import PictureMesh

Array = npt.NDArray[np.float64]


def pick_instants(picture: PictureMesh, states: Array, times: Array, table: Array) -> list[int]:
    """Instants for one picture: first, last and one or two between, at equal steps along the path of the hand.

    Four if the bodies do not hide each other, else three.

    Args:
        picture: the body.
        states: absolute vertex displacements, shape (k, n, d) [m].
        times: shape (k,) [s].
        table: the whole hand motion, columns time and q_s, shape (steps, 1 + n_s).

    Returns:
        Numbers of the states.
    """
    d = picture.dimension
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(table[:, 1 : 1 + d], axis=0), axis=1)))
    at = np.interp(times, table[:, 0], way)
    measure = at if at[-1] > at[0] else times
    for count in (4, 3):
        inner = np.linspace(measure[0], measure[-1], count)[1:-1]
        middle = [int(np.argmin(np.abs(measure - m))) for m in inner]
        chosen = sorted({0, *middle, len(states) - 1})
        if not overlap(picture, states[chosen]):
            break
    return chosen


def hand_polygons(picture: PictureMesh) -> tuple[list[Array], Array]:
    """Pads on the contact facets of a 2D body and the palm that joins them, where the hand starts.

    Not collective.

    Returns:
        Polygons, each (corners, 2) [m], and the point where the arm holds the hand, (2,) [m].
    """
    x, contact = picture.points, picture.contact
    low, high = x.min(axis=0), x.max(axis=0)
    thick = 0.07 * float((high - low).min())
    normals, outer = _offset(x, contact, thick)
    a, b = x[contact[:, 0]], x[contact[:, 1]]
    pads = list(np.stack([a, b, outer[contact[:, 1]], outer[contact[:, 0]]], axis=1))

    away = contact_centre(picture) - (low + high) / 2
    axis = int(np.argmax(np.abs(away))) if np.abs(away).max() > 1e-9 * (high - low).max() else 1
    sign = -1.0 if away[axis] < 0 else 1.0
    other = 1 - axis
    held = np.vstack([x[contact.ravel()], outer[contact.ravel()]])
    left, right = held[:, other].min(), held[:, other].max()

    def box(u: tuple[float, float], w: tuple[float, float]) -> Array:
        """Rectangle from its ranges across and along the hand."""
        corners = np.empty((4, 2))
        corners[:, other] = [u[0], u[1], u[1], u[0]]
        corners[:, axis] = [w[0], w[0], w[1], w[1]]
        return corners

    top = sign * (high if sign > 0 else low)[axis]
    side = np.abs(normals[:, axis]) < 0.7  # pads at the sides need fingers up to a palm, others are the palm
    palm = top + 2.0 * thick if side.any() else float((sign * held[:, axis]).max())
    polygons = pads
    if side.any():
        for group in _pieces(contact, len(x)):
            points = np.vstack([x[group], outer[group]])
            where = np.sort(points[:, other])
            outward = outer[group][:, other].mean() >= x[group][:, other].mean()
            u = (where[-1] - thick, where[-1]) if outward else (where[0], where[0] + thick)
            polygons.append(box(u, (sign * (sign * points[:, axis]).min(), sign * palm)))
        polygons.append(box((left, right), (sign * palm, sign * (palm + thick))))
        palm += thick
    middle = (left + right) / 2
    polygons.append(box((middle - 1.2 * thick, middle + 1.2 * thick), (sign * palm, sign * (palm + 2 * thick))))
    grip = np.empty(2)
    grip[other], grip[axis] = middle, sign * (palm + 2 * thick)
    return polygons, grip


def _offset(x: Array, facets: Any, thick: float) -> tuple[Array, Array]:
    """Outward unit normals of 2D facets, and the vertices moved outward: a pad of even thickness fits between."""
    along = x[facets[:, 1]] - x[facets[:, 0]]
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1)[:, None]
    at_vertex = np.zeros_like(x)
    for end in facets.T:
        np.add.at(at_vertex, end, normals)
    # The mean normal, lengthened so that the pad keeps its thickness round a corner.
    sides = np.maximum(np.bincount(facets.ravel(), minlength=len(x)), 1)
    squared = np.maximum((at_vertex**2).sum(axis=1), 1e-300)
    return normals, x + thick * at_vertex * np.minimum(sides / squared, 2.0)[:, None]


def contact_centre(picture: PictureMesh) -> Array:
    """Mean of the contact vertices where the hand starts, shape (d,) [m]."""
    return np.asarray(picture.points[np.unique(picture.contact)].mean(axis=0))


def overlap(picture: PictureMesh, states: Array) -> bool:
    """Whether the boxes of two instants in a row share more than a twentieth of their size."""
    x = picture.points + states
    low, high = x.min(axis=1), x.max(axis=1)
    shared = np.minimum(high[1:], high[:-1]) - np.maximum(low[1:], low[:-1])
    size = np.prod(high - low, axis=1).min()
    return bool((np.prod(np.maximum(shared, 0.0), axis=1) > 0.05 * size).any())


def _pieces(facets: Any, n: int) -> list[Any]:
    """Vertices of each connected piece of a set of facets."""
    used = np.unique(facets)
    ends = np.searchsorted(used, facets)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used)))
    count, label = connected_components(graph, directed=False)
    return [used[label == i] for i in range(count)]


def chained(facets: Any) -> list[Any]:
    """Closed polylines of an oriented 2D boundary, so that a dotted line keeps its rhythm."""
    after = dict(facets.tolist())
    lines = []
    while after:
        start, point = after.popitem()
        line = [start, point]
        while point in after:
            point = after.pop(point)
            line.append(point)
        lines.append(np.array(line))
    return lines


def interfaces(picture: PictureMesh) -> Any:
    """Edges between cells of different layers, shape (m, 2)."""
    edges = np.sort(np.vstack([picture.cells[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    layer = np.tile(picture.layers, 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, layer = edges[order], layer[order]
    same = (edges[1:] == edges[:-1]).all(axis=1) & (layer[1:] != layer[:-1])
    return edges[1:][same]


def facet_normals(corners: Array) -> Array:
    """Outward unit normals of oriented triangles, shape (m, 3)."""
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(n / np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None])


def edge_sides(facets: Any) -> tuple[Any, Any]:
    """Edges (m, 2) of a closed surface and the two triangles at each, (m, 2)."""
    edges = np.sort(np.vstack([facets[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    owner = np.tile(np.arange(len(facets)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    pair = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    return edges[pair], np.stack([owner[pair], owner[pair + 1]], axis=1)


def silhouette(x: Array, facets: Any, sides: tuple[Any, Any], view: Array) -> Any:
    """Edges where the surface turns from the viewer: one triangle faces him, the other does not."""
    facing = facet_normals(x[facets]) @ view > 0
    edges, pairs = sides
    return edges[facing[pairs[:, 0]] != facing[pairs[:, 1]]]


def outer_edges(x: Array, facets: Any, edges: Any, view: Array) -> Any:
    """Those edges of a silhouette that border the shadow of the surface: outside them nothing is hit. Shape (m, 2)."""
    across = np.linalg.svd(view[None, :])[2][1:]
    flat = x @ across.T
    p, q = flat[edges[:, 0]], flat[edges[:, 1]]
    normal = np.stack([q[:, 1] - p[:, 1], p[:, 0] - q[:, 0]], axis=1)
    normal *= 1e-3 * np.ptp(flat, axis=0).max() / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    a, b, c = (flat[facets[:, i]] for i in range(3))
    hit = []
    for points in ((p + q) / 2 + normal, (p + q) / 2 - normal):
        inside = np.zeros(len(points), dtype=np.bool_)
        for chunk in np.array_split(np.arange(len(points)), 1 + len(points) * len(facets) // 10_000_000):
            s = points[chunk][:, None, :]
            turns = [_turn(a, b, s), _turn(b, c, s), _turn(c, a, s)]
            inside[chunk] = (np.all([t > 0 for t in turns], axis=0) | np.all([t < 0 for t in turns], axis=0)).any(
                axis=1
            )
        hit.append(inside)
    return edges[~(hit[0] & hit[1])]


def _turn(a: Array, b: Array, s: Array) -> Array:
    """Twice the signed area of the triangles a, b, s."""
    return np.asarray((b - a)[..., 0] * (s - a)[..., 1] - (b - a)[..., 1] * (s - a)[..., 0])


def subdivision(n: int) -> Array:
    """Barycentric corners of the n^2 equal parts of a triangle, shape (n^2, 3, 3)."""
    up = [((i, j), (i + 1, j), (i, j + 1)) for i in range(n) for j in range(n - i)]
    down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i in range(n - 1) for j in range(n - 1 - i)]
    ij = np.array(up + down, dtype=np.float64) / n
    return np.concatenate([1.0 - ij.sum(axis=2, keepdims=True), ij], axis=2)
