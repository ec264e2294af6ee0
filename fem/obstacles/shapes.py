"""Convex shapes by their signed distance: gap(x) = |x - y| to the nearest point y outside, -(depth) inside, 0 between.

The gap is a convex function outside and its gradient there is the outward unit normal; inside it is the distance from
the nearest face. The support h(n) = max n.y over the shape gives the plane n.x >= h(n) that separates points from it.
All take points of two or three dimensions, in whole arrays.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
PARALLEL = 1e-12  # sine of the angle below which a direction is that of a half-space
COPLANAR = 1e-9  # difference of unit normals, and of offsets over the size, below which two faces are one
# rounding of n.x - b over the size: how far a foot may seem to lie outside its face
ROUNDING = 16 * np.finfo(float).eps


class Shape(ABC):
    """A rigid convex shape at rest."""

    @abstractmethod
    def look(self, x: Array) -> tuple[Array, Array]:
        """Gap (m,) [m] of points x (m, d) [m] and its gradient, the outward unit normal (m, d)."""

    @abstractmethod
    def support(self, n: Array) -> float:
        """Largest n.y over the shape [m] for a direction n (d,), infinite where there is none."""

    @abstractmethod
    def size(self) -> float:
        """Radius of a ball, else the least distance of a face from the farthest corner [m], infinite without one."""

    def middle(self) -> Array | None:
        """A point within (d,) [m]; None for a half-space."""
        return None


@dataclass(frozen=True)
class HalfSpace(Shape):
    """n.x <= b with a unit normal n: gap n.x - b."""

    normal: Array  # outward unit normal n, (d,)
    offset: float  # b [m]

    def look(self, x: Array) -> tuple[Array, Array]:
        """See :meth:`Shape.look`."""
        return x @ self.normal - self.offset, np.broadcast_to(self.normal, x.shape)

    def support(self, n: Array) -> float:
        """See :meth:`Shape.support`."""
        length = float(np.linalg.norm(n))
        along = float(n @ self.normal)
        return along * self.offset if length - along <= PARALLEL * length else math.inf

    def size(self) -> float:
        """See :meth:`Shape.size`."""
        return math.inf


@dataclass(frozen=True)
class Ball(Shape):
    """|x - c| <= R, a disc in 2D: gap |x - c| - R."""

    center: Array  # c, (d,) [m]
    radius: float  # R [m]

    def look(self, x: Array) -> tuple[Array, Array]:
        """See :meth:`Shape.look`; at the centre the normal is the first axis."""
        off = x - self.center
        distance = np.linalg.norm(off, axis=1)
        normal = off / np.where(distance > 0, distance, 1.0)[:, None]
        normal[distance == 0, 0] = 1.0
        return distance - self.radius, normal

    def support(self, n: Array) -> float:
        """See :meth:`Shape.support`."""
        return float(self.center @ n + self.radius * np.linalg.norm(n))

    def size(self) -> float:
        """See :meth:`Shape.size`."""
        return self.radius

    def middle(self) -> Array:
        """See :meth:`Shape.middle`."""
        return self.center


@dataclass(frozen=True)
class Polytope(Shape):
    """A box, convex polygon or polyhedron: A x <= b for all its faces."""

    corners: Array  # corners, (k, d) [m]
    normals: Array  # outward unit normals A of the faces, (f, d)
    offsets: Array  # b of the faces, (f,) [m]
    edges: Array  # both ends of segments that hold all edges and lie in the shape, (e, 2, d) [m]

    @staticmethod
    def hull(points: Array) -> Polytope:
        """The convex hull of points (k, d), which must enclose something."""
        from scipy.spatial import ConvexHull  # few scenes need it

        hull = ConvexHull(points)
        size = float(np.ptp(points, axis=0).max())
        faces: list[Array] = []
        for face in hull.equations:  # of simplices: those of one plane are one face
            gaps = [max(np.abs(face[:-1] - f[:-1]).max(), abs(face[-1] - f[-1]) / size) for f in faces]
            if min(gaps, default=1.0) > COPLANAR:
                faces.append(face)
        pairs = {(min(a, b), max(a, b)) for s in hull.simplices.tolist() for a in s for b in s if a != b}
        every = np.array(faces)
        return Polytope(points[hull.vertices], every[:, :-1], -every[:, -1], points[np.array(sorted(pairs))])

    @staticmethod
    def box(lo: Array, hi: Array) -> Polytope:
        """The box between two corners (d,), with exact normals."""
        d = len(lo)
        corners = np.array(list(product(*zip(lo, hi, strict=True))))
        bits = np.array(list(product((0, 1), repeat=d)))
        ends = [(i, j) for i in range(2**d) for j in range(i) if np.abs(bits[i] - bits[j]).sum() == 1]
        return Polytope(corners, np.vstack([np.eye(d), -np.eye(d)]), np.concatenate([hi, -lo]), corners[np.array(ends)])

    def look(self, x: Array) -> tuple[Array, Array]:
        """See :meth:`Shape.look`; the nearest face, and beyond its rim the nearest edge or corner."""
        slack = x @ self.normals.T - self.offsets
        face = slack.argmax(axis=1)
        gap, normal = slack[np.arange(len(x)), face], self.normals[face]
        feet = x - gap[:, None] * normal
        size = np.abs(self.corners).max() + np.abs(x).max(axis=1, initial=0.0)
        beyond = (gap > 0) & ((feet @ self.normals.T - self.offsets).max(axis=1) > ROUNDING * size)
        if beyond.any():
            off = x[beyond] - self._on_edges(x[beyond])
            distance = np.linalg.norm(off, axis=1)
            gap[beyond], normal[beyond] = distance, off / distance[:, None]
        return gap, normal

    def _on_edges(self, x: Array) -> Array:
        """Nearest points of all edges, (m, d)."""
        begin, along = self.edges[:, 0], self.edges[:, 1] - self.edges[:, 0]
        share = np.einsum("med,ed->me", x[:, None] - begin, along) / np.einsum("ed,ed->e", along, along)
        feet = begin + np.clip(share, 0.0, 1.0)[:, :, None] * along
        nearest = np.linalg.norm(x[:, None] - feet, axis=2).argmin(axis=1)
        return np.asarray(feet[np.arange(len(x)), nearest])

    def support(self, n: Array) -> float:
        """See :meth:`Shape.support`."""
        return float((self.corners @ n).max())

    def size(self) -> float:
        """See :meth:`Shape.size`."""
        return float((self.offsets - (self.corners @ self.normals.T).min(axis=0)).min())

    def middle(self) -> Array:
        """See :meth:`Shape.middle`."""
        return np.asarray(self.corners.mean(axis=0))
