"""The hand in pictures of 3D scenes: a plate on what it holds, and a frame around each body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem import Array, PictureMesh
from softgrasp.study.pictures.shapes import MoveView, facet_normals, seen, view_direction

THICK = 0.09  # of the smallest side of the body
PAD = 0.04  # of the frame, free around the body
PLACES = 40  # of the path, at which it is looked for
WIDE = 0.16  # the same with obstacles, for the part of a plane that is drawn


def held_facets(picture: PictureMesh) -> NDArray[np.bool_]:
    """Which facets of the boundary the hand holds, (facets,)."""
    code = np.array([1, len(picture.points), len(picture.points) ** 2])
    return np.isin(np.sort(picture.facets, axis=1) @ code, np.sort(picture.contact, axis=1) @ code)


def hand_plate(picture: PictureMesh, q: Array) -> tuple[list[Array], list[Array]]:
    """Polygons of a plate on the held facets, behind the body and in front of it, each (k, 3) [m].

    ``q``: the hand, (n_s,) [m, rad]. The plate has an even thickness, outward from the body, and moves with the hand.
    """
    facets, x = picture.facets[held_facets(picture)], picture.points
    if not len(facets):
        return [], []
    normals = facet_normals(x[facets])
    at_vertex = np.zeros_like(x)
    for corner in facets.T:
        np.add.at(at_vertex, corner, normals)
    at_vertex /= np.maximum(np.linalg.norm(at_vertex, axis=1), 1e-300)[:, None]
    outer = x + THICK * float(np.ptp(x, axis=0).min()) * at_vertex
    edges = np.vstack([facets[:, [i, (i + 1) % 3]] for i in range(3)])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    rim = edges[first[count == 1]]
    inner, outside = x + picture.rigid(q), outer + picture.rigid(q, outer)
    sides = list(np.stack([inner[rim[:, 0]], inner[rim[:, 1]], outside[rim[:, 1]], outside[rim[:, 0]]], axis=1))
    front = normals @ view_direction() > 0
    lids = outside[facets]
    near = front.mean() > 0.5
    return ([], [*sides, *lids]) if near else ([*sides, *lids[~front]], list(lids[front]))


def around_bodies(picture: PictureMesh, states: Array, hands: Array) -> list[tuple[Array, Array]]:
    """Lower and upper corner in the plane of the picture of a frame around body and hand of each state, of one size."""
    boxes = []
    for u, q in zip(states, hands, strict=True):
        behind, before = hand_plate(picture, q)
        points = seen(np.vstack([picture.points + u, *behind, *before]))
        boxes.append((points.min(axis=0), points.max(axis=0)))
    half = (0.5 + (WIDE if picture.obstacles else PAD)) * np.max([high - low for low, high in boxes], axis=0)
    return [((low + high) / 2 - half, (low + high) / 2 + half) for low, high in boxes]


def path_hidden(move: MoveView) -> bool:
    """Whether the path of the hand lies behind the body and the hand, where they start and where they end, in 3D."""
    picture = move.picture
    if picture.dimension == 2:
        return False
    path = seen(move.path[np.linspace(0, len(move.path) - 1, PLACES).round().astype(int)])
    for u, q in ((move.states[i], move.hands[i]) for i in (0, -1)):
        plate = [polygon for side in hand_plate(picture, q) for polygon in side]
        halves = [polygon[[0, k, k + 1]] for polygon in plate for k in range(1, len(polygon) - 1)]
        triangles = seen(np.concatenate([(picture.points + u)[picture.facets], np.reshape(halves, (-1, 3, 3))]))
        if not all(_inside(x, triangles).any() for x in path):
            return False
    return True


def _inside(x: Array, triangles: Array) -> NDArray[np.bool_]:
    """Which triangles (m, 3, 2) of the plane a point (2,) lies in."""
    edge, off = np.roll(triangles, -1, axis=1) - triangles, x - triangles
    side = edge[..., 0] * off[..., 1] - edge[..., 1] * off[..., 0]
    return np.asarray((side >= 0).all(axis=1) | (side <= 0).all(axis=1))
