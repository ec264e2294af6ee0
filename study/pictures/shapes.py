"""Geometry of pictures: the view, the drawn hand, outlines, and which instants to show. Plain arrays in and out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem import Array, PictureMesh

ELEVATION, AZIMUTH = 18.0, -58.0  # view of 3D scenes [degree]
SHORTEST, LONGEST = 0.3, 30.0  # [s], beyond them an animation runs slower or faster than the move
MARGIN = 0.08  # of a body's smaller side, kept free between two bodies of one picture


@dataclass(frozen=True)
class MoveView:
    """A move as all its views have it: states, colours, and the corners of what is seen."""

    picture: PictureMesh  # the body
    states: Array  # absolute vertex displacements at the instants, shape (k, n, d) [m]
    times: Array  # instants, shape (k,) [s]
    hands: Array  # hand coordinates at the instants, shape (k, n_s)
    tractions: Array | None  # traction of contact on the vertices at the instants, shape (k, n, d) [Pa], if any
    pressure: float  # largest length of a traction at any instant of the move [Pa]
    room: Array  # corners of the scene in space without obstacles, (2, d) [m]
    path: Array  # where the grip of the hand passes, shape (steps, d) [m]
    norm: Any  # scale of the colours [unit]; from 0 to 0 when nothing deforms
    unit: tuple[float, str]  # factor and name of the unit of the colours
    low: Array  # lower corner of the scene in the plane of the picture, (2,) [m]
    high: Array  # upper corner of the scene in the plane of the picture, (2,) [m]
    hand: list[Array]  # polygons of the hand where it starts, each (corners, d); empty in 3D
    edges: Any  # outline and interfaces of layers in 2D, shape (m, 2); empty in 3D
    aim: list[Array]  # closed lines around the body at the target in the plane of the picture, each (k, 2) [m]
    apart: Any  # numbers of pressed vertices of a 3D body in the order in which they get arrows

    def values(self, displacement: Array, q_s: Array) -> Array:
        """|u - R q_s| at the vertices in the unit of the colour bar, shape (n,)."""
        return np.asarray(self.unit[0] * np.linalg.norm(displacement - self.picture.rigid(q_s), axis=1))


def view_direction() -> Array:
    """Unit vector from a 3D scene to the viewer, shape (3,)."""
    e, a = np.radians([ELEVATION, AZIMUTH])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def seen(x: Array) -> Array:
    """Points in the plane of the picture, shape (..., 2) [m]: themselves in 2D, parallel projection in 3D."""
    if x.shape[-1] == 2:
        return x
    a, view = np.radians(AZIMUTH), view_direction()
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.asarray(x @ np.stack([right, np.cross(view, right)], axis=1))


def pick_instants(picture: PictureMesh, states: Array, times: Array, table: Array) -> list[int]:
    """Numbers of the states for one picture: first, last and one or two between, near even steps of way and much bent.

    Four if they fit into one picture without hiding each other, else three if those do, else four for panels. For the
    arguments see :func:`softgrasp.study.pictures.body.figure_move`.
    """
    last = len(states) - 1
    if last < 3:
        return list(range(last + 1))
    done = path_fraction(table, times)
    if not ((done > 0.02) & (done < 0.98)).any():  # frames are too far apart to see the move
        done = (times - times[0]) / (times[-1] - times[0])
    hands = hands_at(table, times)
    relative = np.stack([u - picture.rigid(q) for u, q in zip(states, hands, strict=True)])
    bent = np.linalg.norm(relative - relative[0], axis=2).max(axis=1)
    bent /= bent.max() or 1.0
    low, high = _boxes(picture, states)

    def inner(at: float, radius: float) -> list[tuple[float, int]]:
        """Instants whose way is near ``at``, with their merit."""
        near = np.flatnonzero((np.abs(done - at) <= radius) & (done > 0.02) & (done < 0.98))
        return [(float(bent[i]) - 3 * abs(float(done[i]) - at), int(i)) for i in near]

    pairs = [(a + b, (0, i, j, last)) for a, i in inner(1 / 3, 0.17) for b, j in inner(2 / 3, 0.17) if i < j]
    single = [(a, (0, i, last)) for a, i in inner(1 / 2, 0.25)]
    for choice in (pairs, single):
        for _, chosen in sorted(choice, reverse=True):
            telling = bent[list(chosen)].max() >= 0.9  # near the largest deformation of the move
            if telling and not _boxes_overlap(low[list(chosen)], high[list(chosen)]):
                return list(chosen)
    halves = (np.flatnonzero((done > 0.02) & (done <= 0.5)), np.flatnonzero((done > 0.5) & (done < 0.98)))
    return sorted({0, last, *(int(h[np.argmax(bent[h])]) for h in halves if len(h))})


def path_fraction(table: Array, times: Array) -> Array:
    """Share of the hand's way that is behind it at the given times [1]; of the time if the hand rests."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(table[:, 1:], axis=0), axis=1)))
    at = np.interp(times, table[:, 0], way) if way[-1] > 0 else np.asarray(times, dtype=np.float64)
    return np.asarray((at - at[0]) / ((at[-1] - at[0]) or 1.0))


def hands_at(table: Array, times: Array) -> Array:
    """Hand coordinates at the given times, shape (k, n_s)."""
    return np.stack([np.interp(times, table[:, 0], column) for column in table[:, 1:].T], axis=1)


def hand_polygons(picture: PictureMesh) -> tuple[list[Array], Array]:
    """Pads on the contact facets of a 2D body and the palm that joins them, where the hand starts.

    Returns polygons, each (corners, 2) [m], and the point where the arm holds the hand, (2,) [m].
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


def moved(picture: PictureMesh, polygons: list[Array], q: Array) -> list[Array]:
    """Polygons that move with the hand."""
    if not polygons:
        return []
    start = np.vstack(polygons)
    return np.split(start + picture.rigid(q, start), np.cumsum([len(p) for p in polygons[:-1]]))


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
    """Whether two of the bodies come near each other in the picture, by their boxes."""
    return _boxes_overlap(*_boxes(picture, states))


def _boxes(picture: PictureMesh, states: Array) -> tuple[Array, Array]:
    """Corners of the bodies in the picture with some margin, each (k, 2) [m]."""
    # Instant by instant: one after the other needs little memory.
    flat = [seen(picture.points + u) for u in states]
    low, high = np.stack([x.min(axis=0) for x in flat]), np.stack([x.max(axis=0) for x in flat])
    margin = MARGIN / 2 * float((high - low).min())
    return low - margin, high + margin


def _boxes_overlap(low: Array, high: Array) -> bool:
    i, j = np.triu_indices(len(low), 1)
    return bool(((np.minimum(high[i], high[j]) - np.maximum(low[i], low[j])) > 0).all(axis=1).any())


def _pieces(facets: Any, n: int) -> list[Any]:
    """Vertices of each connected piece of a set of facets."""
    from scipy.sparse import coo_array, csgraph  # slow to import, and not for every hand

    used = np.unique(facets)
    ends = np.searchsorted(used, facets)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(used), len(used)))
    count, label = csgraph.connected_components(graph, directed=False)
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


def shadow(flat: Array, facets: Any, fine: int = 700) -> list[Array]:
    """Closed lines, each (k, 2) [m], around the union of triangles in the plane, exact to 1 / ``fine`` of its size.

    ``flat`` are the points, (n, 2) [m], and ``facets`` the triangles, (m, 3).
    """
    low = flat.min(axis=0)
    pixel = float(np.ptp(flat, axis=0).max()) / fine
    at = (flat - low) / pixel + 4.0  # [pixel], with a free border
    width, height = (np.ceil(at.max(axis=0)) + 5).astype(int)
    from contourpy import contour_generator  # only pictures of 3D need it
    from PIL import Image, ImageDraw, ImageFilter

    image = Image.new("L", (int(width), int(height)))
    draw = ImageDraw.Draw(image)
    for corners in at[facets].reshape(-1, 6).tolist():
        draw.polygon(corners, fill=255)
    mask = np.asarray(image.filter(ImageFilter.GaussianBlur(1.0)), dtype=np.float64)
    return [low + pixel * (np.asarray(line) - 4.0) for line in contour_generator(z=mask).lines(127.5)]


def subdivision(n: int) -> Array:
    """Barycentric corners of the n^2 equal parts of a triangle, shape (n^2, 3, 3)."""
    up = [((i, j), (i + 1, j), (i, j + 1)) for i in range(n) for j in range(n - i)]
    down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i in range(n - 1) for j in range(n - 1 - i)]
    ij = np.array(up + down, dtype=np.float64) / n
    return np.concatenate([1.0 - ij.sum(axis=2, keepdims=True), ij], axis=2)


def speed_up(times: Array) -> float:
    """How many times faster than the move its animation runs: 1 from 0.3 to 30 s, else steps of 1, 2, 5 [1].

    Longer moves are shown in at most 30 s, shorter ones in at least 1 s.
    """
    total = float(times[-1] - times[0])
    if SHORTEST <= total <= LONGEST or total <= 0.0:
        return 1.0
    ratio = total / LONGEST if total > LONGEST else total
    power = 10.0 ** np.floor(np.log10(ratio) + 1e-9)
    steps = [m * power for m in (1, 2, 5, 10)]
    if total > LONGEST:
        return float(next(m for m in steps if m >= ratio * (1 - 1e-9)))
    return float(max(m for m in steps if m <= ratio * (1 + 1e-9)))


def move_steps(steps: int, dt: float, settle: float, count: int = 60) -> list[int]:
    """Steps for pictures of a move that is over after ``settle`` seconds: equally spaced until then, and the last."""
    end = int(np.clip(round(settle / dt), 1, steps))
    grid = np.linspace(0, end, min(count, end) + 1).round().astype(int)
    return sorted({*grid.tolist(), steps})
