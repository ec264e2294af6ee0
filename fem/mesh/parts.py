"""Parts of a mesh that hang together through facets, and the nodes they share (numpy only, not collective)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from softgrasp.fem.errors import MeshError
from softgrasp.fem.mesh.check import components, place_text
from softgrasp.fem.mesh.seams import Facets

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Parts:
    """The parts of a mesh that hang together through facets; small, replicated on all ranks.

    Parts of one group share nodes, but no facet: they may turn about each other.
    """

    cells: Integers  # number of cells of each part, shape (n_parts,)
    middles: Floats  # mean of the cell midpoints of each part, shape (n_parts, d) [m]
    radii: Floats  # largest distance of a node from the middle, shape (n_parts,) [m]
    groups: Integers  # number of the group of each part, shape (n_parts,)
    points: Floats  # nodes that several parts share, shape (n_shared, d) [m]
    joints: Integers  # rows (shared node, part), sorted, shape (n, 2)


def find_parts(
    points: Floats, cells: Integers, facets: Facets, name: str
) -> tuple[npt.NDArray[np.int32], Parts] | None:
    """Label the cells of each facet-connected part from 0; None if the mesh is one part.

    Args:
        points: shape (n_points, d) [m].
        cells: simplices, shape (n_cells, d + 1).
        facets: their facets.
        name: name of the mesh, for messages.

    Raises:
        MeshError: a facet has more than two cells.
    """
    n = len(cells)
    if (crowded := facets.same[1:] & facets.same[:-1]).any():
        place = points[facets.nodes[np.argmax(crowded)]].mean(axis=0)
        raise MeshError(
            f"{name} has facets with more than two cells, the first around {place_text(place)}: remove doubled cells."
        )
    one, other = facets.cells[:-1][facets.same], facets.cells[1:][facets.same]
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(n, n))
    count, labels = connected_components(graph.tocsr(), directed=False)
    if count == 1:
        return None
    total = np.bincount(labels, minlength=count)
    midpoints = points[cells].mean(axis=1)
    middles = np.stack([np.bincount(labels, weights=x, minlength=count) for x in midpoints.T], axis=1) / total[:, None]
    radii = np.zeros(count)
    np.maximum.at(radii, labels, np.linalg.norm(points[cells] - middles[labels, None], axis=2).max(axis=1))
    groups = np.zeros(count, dtype=np.int64)
    groups[labels] = components(cells, len(points))[1]
    pairs = np.unique(cells.astype(np.int64) * count + labels[:, None])  # (node, part) in one number, sorted
    nodes, parts = np.divmod(pairs, count)
    shared, times = np.unique(nodes, return_counts=True)
    shared = shared[times > 1]
    kept = np.isin(nodes, shared)
    joints = np.stack([np.searchsorted(shared, nodes[kept]), parts[kept]], axis=1)
    return labels.astype(np.int32), Parts(total, middles, radii, groups, points[shared], joints)
