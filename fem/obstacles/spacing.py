"""How closely points lie on the boundary where obstacles touch it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.obstacles.obstacle import make_shape
from softgrasp.fem.scene.obstacles import Obstacle

QUADRATIC = 3  # parts of an edge in 3D on quadratic elements, whose vertices carry no even pressure [1]
SHARE = 0.5  # of the least obstacle that points may be apart [1]
MOST = 16  # parts that are chosen where the scene gives none [1]


def edge_parts(entries: list[Obstacle], order: int, d: int) -> Callable[[NDArray[np.float64]], NDArray[np.intp]] | None:
    """Parts (k,) of the edges of facets, by the longest edge of each (k,) [m]; None: nodes alone touch.

    Args:
        entries: obstacles of the scene; where one has friction, nodes alone touch.
        order: of the elements.
        d: dimension.
    """
    if any(entry.friction for entry in entries):
        return None
    least = max((base_parts(entry, order, d) for entry in entries), default=1)
    size = min((make_shape(entry).size() for entry in entries if entry.parts is None), default=np.inf)
    if least <= order and not np.isfinite(size):
        return None

    def parts(longest: NDArray[np.float64]) -> NDArray[np.intp]:
        # edges of equal cells differ by rounding
        wanted = np.clip(np.ceil(longest / (SHARE * size) - 1e-6), least, max(MOST, least)).astype(np.intp)
        wanted[longest / order <= size * (1 + 1e-6)] = least
        return np.where(wanted > order, wanted, 1)

    return parts


def base_parts(entry: Obstacle, order: int, d: int) -> int:
    """Parts of an edge between points that touch an obstacle of any size; 1: nodes alone."""
    return entry.parts or (QUADRATIC if d == 3 and order == 2 and not entry.friction else 1)
