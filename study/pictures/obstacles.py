"""Rigid obstacles in a picture of the plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.patches import Circle, Polygon
from scipy.spatial import ConvexHull

from softgrasp.fem import Array, Ball, HalfSpace, Polytope, Shape
from softgrasp.study.pictures.style import OUTLINE

OBSTACLE: dict[str, Any] = {"facecolor": "#d9d9d9", "edgecolor": OUTLINE, "lw": 0.8, "zorder": 0.5}


def draw_obstacle(ax: Any, shape: Shape, name: str, box: Array) -> None:
    """Filled, as far as it lies in the picture."""
    if isinstance(shape, Ball):
        ax.add_patch(Circle(tuple(shape.center), shape.radius, **OBSTACLE))
        place = shape.center
    elif isinstance(shape, Polytope):
        corners = shape.corners[ConvexHull(shape.corners).vertices]
        ax.add_patch(Polygon(corners, **OBSTACLE))
        place = corners.mean(axis=0)
    else:
        assert isinstance(shape, HalfSpace)
        along = np.array([-shape.normal[1], shape.normal[0]])
        size = float(np.linalg.norm(box[1] - box[0]))
        foot = box.mean(axis=0) + (shape.offset - box.mean(axis=0) @ shape.normal) * shape.normal
        back = foot - size * shape.normal
        ax.add_patch(
            Polygon([foot - size * along, foot + size * along, back + size * along, back - size * along], **OBSTACLE)
        )
        place = np.clip(foot - 0.03 * size * shape.normal, box[0] + 0.025 * size, box[1] - 0.025 * size)
    ax.text(*place, name, ha="center", va="center", fontsize=7, color=OUTLINE, clip_on=True)
