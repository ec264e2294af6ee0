"""Rigid obstacles in pictures of a move, and the pressure between them and the tissue."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from softgrasp.fem import Array, Ball, HalfSpace, Obstacle, PictureMesh, Polytope, Shape
from softgrasp.study.pictures import shapes
from softgrasp.study.pictures.shapes import MoveView
from softgrasp.study.pictures.style import HAND, OUTLINE

GREY = "#d9d9d9"
BEHIND, BEFORE = 0.5, 3.5  # zorder of what lies behind a body and before it
CLEAR = 0.55  # opacity of what lies before a body
CORNERS = 96  # of a circle
FAR = 0.5  # most room that obstacles get on each side, over the size of the scene
LONGEST = 0.3  # longest arrow over the size of the body
BEYOND = 0.15  # of the scene, by which the drawn part of a plane in space is wider [1]
MARGIN = np.array([0.07, 0.025])  # of a name to the frame, over the diagonal of the picture [1]
SHOWN = 2000  # points of the bodies that a name in space keeps clear of [1]
LEAST = 0.02  # shortest arrow that is drawn, over the longest
ARROWS, RANKED = 40, 400  # most arrows of an instant in space, and of all instants together


def draw_obstacle(ax: Any, shape: Shape, name: str, box: Array, shift: Array | float = 0.0) -> None:
    """An obstacle of the plane, displaced by ``shift`` [m], as far as it lies in the picture with corners ``box``."""
    size = float(np.linalg.norm(box[1] - box[0]))
    if isinstance(shape, HalfSpace):
        along, middle = np.array([-shape.normal[1], shape.normal[0]]), box.mean(axis=0)
        foot = middle + (shape.offset + np.sum(shape.normal * shift) - middle @ shape.normal) * shape.normal
        back = foot - size * shape.normal
        polygon = np.array([foot - size * along, foot + size * along, back + size * along, back - size * along])
        place = foot - 0.03 * size * shape.normal + size * along
    else:
        (polygon,), _ = polygons(shape, np.zeros(2) + shift, box)
        place = polygon.mean(axis=0)
    ax.add_collection(PolyCollection([polygon], facecolors=GREY, edgecolors=OUTLINE, lw=0.8, zorder=BEHIND))
    margin = size * MARGIN
    _write(ax, name, np.clip(place, box[0] + margin, box[1] - margin))


def _write(ax: Any, name: str, place: Array) -> None:
    """The name of an obstacle, over arrows, bodies and the path."""
    halo = [withStroke(linewidth=2.5, foreground=GREY)]
    ax.text(
        *place, name, ha="center", va="center", fontsize=7, color=OUTLINE, clip_on=True, zorder=7, path_effects=halo
    )


def extent(obstacles: tuple[Obstacle, ...], times: Array, room: Array, box: Array) -> Array:
    """Corners (2, 2) [m] of a picture that takes in the obstacles at the times, as far as they are not large.

    ``room`` are the corners of the scene in space, (2, d) [m], and ``box`` those in the plane of the picture.
    """
    far, d = FAR * float(np.ptp(box, axis=0).max()), room.shape[1]
    least, most = box[0] - far, box[1] + far
    for obstacle in obstacles:
        if d == 2 and isinstance(obstacle.shape, HalfSpace):
            continue
        for t in times if obstacle.path is not None else times[:1]:
            x = np.vstack(polygons(obstacle.shape, np.zeros(d) + obstacle.shift(t), room)[0])
            low, high = np.maximum(x.min(axis=0), least), np.minimum(x.max(axis=0), most)
            if (low < high).all():
                box = np.array([np.minimum(box[0], low), np.maximum(box[1], high)])
    return box


def draw_surroundings(ax: Any, move: MoveView, numbers: list[int]) -> None:
    """Obstacles at instants of a move, those at rest once, and arrows of the pressure on each body."""
    solid = move.picture.dimension == 3
    box = np.array([ax.get_xlim(), ax.get_ylim()]).T
    for obstacle in move.picture.obstacles:
        for k in numbers if obstacle.path is not None else numbers[:1]:
            if solid:
                faces = _draw_solid(ax, obstacle.shape, np.zeros(3) + obstacle.shift(move.times[k]), move.room)
                _name_solid(ax, faces, obstacle, box, move)
            else:
                draw_obstacle(ax, obstacle.shape, obstacle.name, box, obstacle.shift(move.times[k]))
    if move.tractions is None:
        return
    scale = LONGEST * float(np.ptp(move.picture.points, axis=0).min()) / move.pressure
    for k in numbers:
        pressed = np.flatnonzero(_sizes(move.tractions[k]) > LEAST * move.pressure)
        on = move.apart[np.isin(move.apart, pressed)][:ARROWS] if solid else pressed
        if len(on):
            x, arrows = move.picture.points[on] + move.states[k][on], scale * move.tractions[k][on]
            look: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "pivot": "tip", "units": "inches"}
            look |= {"headwidth": 4.0, "headlength": 5.0, "headaxislength": 4.5, "width": 0.012, "zorder": 6}
            if solid:  # seen before body and hand alike
                look |= {"path_effects": [withStroke(linewidth=1.2, foreground="white")]}
            ax.quiver(*shapes.seen(x).T, *shapes.seen(arrows).T, color=HAND, **look)


def far_apart(picture: PictureMesh, tractions: Array) -> NDArray[np.intp]:
    """Vertices pressed at some instant: the first under the largest pressure, each next farthest from those before.

    Of those pressed at an instant, the first ones have its arrows: few move from frame to frame of a film.
    ``tractions`` as in `MoveView`, (k, n, d) [Pa].
    """
    size = _sizes(tractions).max(axis=0)
    pressed = np.flatnonzero(size > LEAST * size.max())
    x, chosen = picture.points[pressed], [int(size[pressed].argmax())]
    gap = np.full(len(x), np.inf)
    while len(chosen) < min(len(x), RANKED):
        gap = np.minimum(gap, np.linalg.norm(x - x[chosen[-1]], axis=1))
        chosen.append(int(gap.argmax()))
    return np.asarray(pressed[chosen])


def _sizes(tractions: Array) -> Array:
    return np.asarray(np.linalg.norm(tractions, axis=-1))


def polygons(shape: Shape, shift: Array, room: Array) -> tuple[list[Array], list[float]]:
    """The visible faces of an obstacle in the plane of the picture, and their brightness [1]; in 2D its outline."""
    if isinstance(shape, Ball):
        angle = np.linspace(0.0, 2 * np.pi, CORNERS, endpoint=False)
        circle = shape.radius * np.column_stack([np.cos(angle), np.sin(angle)])
        return [shapes.seen(shape.center + shift) + circle], [1.0]
    if isinstance(shape, HalfSpace):
        return [shapes.seen(_patch(shape, shift, room))], [1.0]
    assert isinstance(shape, Polytope)
    if len(shift) == 2:
        off = shape.corners - shape.corners.mean(axis=0)
        return [shape.corners[np.argsort(np.arctan2(off[:, 1], off[:, 0]))] + shift], [1.0]
    front = np.flatnonzero(shape.normals @ shapes.view_direction() > 0).tolist()
    return [shapes.seen(_face(shape, i) + shift) for i in front], [_shade(n) for n in shape.normals[front]]


def _draw_solid(ax: Any, shape: Shape, shift: Array, room: Array) -> list[Array]:
    """An obstacle in space by parallel projection, behind the body or, clearer, before it; its faces in the plane."""
    place = -shape.normal if isinstance(shape, HalfSpace) else shift - room.mean(axis=0)
    if isinstance(shape, Ball | Polytope):
        place = place + (shape.center if isinstance(shape, Ball) else shape.corners.mean(axis=0))
    before = place @ shapes.view_direction() > 0
    faces, shades = polygons(shape, shift, room)
    colours = [(*(s * np.array(to_rgb(GREY))), CLEAR if before else 1.0) for s in shades]
    order = BEFORE if before else BEHIND
    ax.add_collection(
        PolyCollection(faces, facecolors=colours, edgecolors=OUTLINE, lw=0.6, zorder=order), autolim=False
    )
    return faces


def _name_solid(ax: Any, faces: list[Array], obstacle: Obstacle, box: Array, move: MoveView) -> None:
    """The name of an obstacle on its faces, of a half-space beside its drawn part, as far from the bodies as can be."""
    most = 1.0 + BEYOND if isinstance(obstacle.shape, HalfSpace) else 0.9
    ends = [np.vstack([face, (face + np.roll(face, 1, axis=0)) / 2]) for face in faces]
    inside = [c + share * (x - c) for x in ends for c in [x.mean(axis=0)] for share in np.linspace(0.0, most, 10)]
    places, margin = np.vstack(inside), float(np.linalg.norm(box[1] - box[0])) * MARGIN
    places = places[((places > box[0] + margin) & (places < box[1] - margin)).all(axis=1)]
    if not len(places):
        return
    bodies = np.vstack([shapes.seen(move.picture.points + u) for u in move.states])
    bodies = bodies[:: -(-len(bodies) // SHOWN)]
    _write(ax, obstacle.name, places[np.linalg.norm(places[:, None] - bodies, axis=2).min(axis=1).argmax()])


def _shade(normal: Array) -> float:
    """Brightness of a face, brightest from above [1]."""
    return 0.8 + 0.2 * float(np.clip(normal[2], 0.0, 1.0))


def _face(shape: Polytope, i: int) -> Array:
    """Corners of a face in order, (k, 3) [m]."""
    depth = shape.offsets[i] - shape.corners @ shape.normals[i]
    corners = shape.corners[depth < 1e-9 * float(np.ptp(shape.corners, axis=0).max())]  # rounding of the hull's faces
    off, (u, v) = corners - corners.mean(axis=0), _tangents(shape.normals[i])
    return np.asarray(corners[np.argsort(np.arctan2(off @ v, off @ u))])


def _tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors across a normal, along the axes where they can be."""
    u = np.eye(3)[np.argsort(np.abs(normal), kind="stable")[0]]
    u = u - (u @ normal) * normal
    u = u / np.linalg.norm(u)
    return u, np.cross(normal, u)


def _patch(shape: HalfSpace, shift: Array, room: Array) -> Array:
    """A rectangle of the surface of a half-space below or beside the scene with corners ``room``, (4, 3) [m]."""
    u, v = _tangents(shape.normal)
    foot = (shape.offset + float(shape.normal @ shift)) * shape.normal
    along = np.array(list(product(*room.T))) @ np.column_stack([u, v])
    low, high = along.min(axis=0), along.max(axis=0)
    low, high = low - BEYOND * (high - low), high + BEYOND * (high - low)
    return np.array([foot + a * u + b * v for a, b in (low, (high[0], low[1]), high, (low[0], high[1]))])
