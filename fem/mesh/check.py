"""Quality checks of simplex meshes given as arrays (numpy only, not collective)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from softgrasp.fem.errors import MeshError

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

FLAT = 1e-12  # volume over (longest edge)^d: far above round-off (1e-16), far below any usable cell


def signed_volumes(points: Floats, cells: Integers) -> Floats:
    """V = det [x_1 - x_0, ..., x_d - x_0] / d! of each simplex, negative if inverted.

    Args:
        points: shape (n_points, d), d = 2 or 3 [m].
        cells: shape (n_cells, d + 1).
    """
    edges = points[cells[:, 1:]] - points[cells[:, :1]]
    return np.asarray(np.linalg.det(edges) / math.factorial(points.shape[1]), dtype=np.float64)


def longest_edges(points: Floats, cells: Integers) -> Floats:
    """Longest edge of each simplex [m]."""
    longest = np.zeros(len(cells))
    for i in range(cells.shape[1]):
        for j in range(i):
            longest = np.maximum(longest, np.linalg.norm(points[cells[:, i]] - points[cells[:, j]], axis=1))
    return longest


def check_cells(points: Floats, cells: Integers, repair: bool, name: str) -> Integers:
    """Return cells of positive volume, or refuse the mesh.

    Flat cells are refused always; inverted cells (also if all of them are) unless ``repair`` turns them round
    by swapping their last two nodes.

    Args:
        points: shape (n_points, d) [m].
        cells: shape (n_cells, d + 1), left unchanged.
        repair: turn inverted cells round.
        name: name of the mesh for messages.

    Raises:
        MeshError: a coordinate is not finite, or a cell is flat or inverted.
    """
    bad_points = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad_points.size:
        raise MeshError(
            f"{name} has {counted(bad_points.size, 'point')} with NaN or infinite coordinates, "
            f"the first is {bad_points[0]}: export the mesh again."
        )
    volumes = signed_volumes(points, cells)
    edges = longest_edges(points, cells)
    quality = np.divide(volumes, edges ** points.shape[1], out=np.zeros_like(volumes), where=edges > 0)
    flat = np.abs(quality) <= FLAT
    if flat.any():
        worst = int(np.argmin(np.abs(quality)))
        raise MeshError(
            f"{name} has {counted(int(flat.sum()), 'cell')} of zero volume, the worst is cell {worst} around "
            f"{_middle(points, cells, worst)}: remove or remesh them."
        )
    inverted = quality < 0
    if not inverted.any():
        return cells
    if not repair:
        worst = int(np.argmin(quality))
        raise MeshError(
            f"{name} has {counted(int(inverted.sum()), 'inverted cell')} of {len(cells)}, the worst is cell {worst} "
            f"around {_middle(points, cells, worst)}: set tissue.repair = true to turn them round, "
            "or export the mesh again."
        )
    turned = cells.copy()
    turned[np.ix_(inverted, [-2, -1])] = cells[np.ix_(inverted, [-1, -2])]
    return turned


def counted(number: int, what: str) -> str:
    """A count with its noun, singular or plural."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def components(cells: Integers, n_points: int) -> tuple[int, npt.NDArray[np.int32]]:
    """Count the parts of a mesh that share no node, and label each cell with its part (from 0)."""
    rows = np.repeat(cells[:, 0], cells.shape[1] - 1)
    columns = cells[:, 1:].ravel()
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(n_points, n_points))
    _, labels = connected_components(graph.tocsr(), directed=False)
    used, parts = np.unique(labels[cells[:, 0]], return_inverse=True)
    return len(used), parts.astype(np.int32)


def place_text(point: Floats) -> str:
    """A point for a message, "(1, 0.5)"."""
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ")"


def _middle(points: Floats, cells: Integers, cell: int) -> str:
    return place_text(points[cells[cell]].mean(axis=0))
