"""Sizes and ownership of the unknowns: the hand's on every rank, the tissue's distributed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from softgrasp.fem.petsc import Array
from softgrasp.fem.shown import Shown

NEAR = 0.05  # of the longest side: how far outside the body a point may be that was read off a picture
Place = tuple[tuple[float, ...], int, int]  # of a node: coordinates [m], owning rank, its number there


@dataclass(frozen=True)
class Patches:
    """Stars of the vertices of elements of order 2 and more, and the linear functions of the vertices at the nodes.

    Nodes have their global numbers among the free ones, vertices theirs among the free vertices.
    """

    star: NDArray[Any]  # number of a star of this rank, ascending, for each node in it, (pairs,)
    node: NDArray[Any]  # node of the star, (pairs,)
    row: NDArray[Any]  # an owned node where a linear function is not zero, (entries,)
    column: NDArray[Any]  # the vertex of that function, (entries,)
    weight: Array  # its value there [1], (entries,)
    vertices: NDArray[Any]  # places of the owned free vertices among the owned free nodes, (count,)
    count: int  # number of owned free vertices


@dataclass(frozen=True, repr=False)
class BlockLayout(Shown):
    """Sizes and ownership of q = [q_s; q_e]."""

    comm: MPI.Intracomm
    """Communicator of the tissue blocks."""
    dimension: int
    """Dimension d of space."""
    n_s: int
    """Number of the hand's degrees of freedom, on every rank."""
    n_e: int
    """Number of the tissue's degrees of freedom over all ranks."""
    n_local: int
    """Number of the tissue's degrees of freedom owned by this rank."""
    start: int
    """Global number of this rank's first degree of freedom."""
    nodes: Array
    """Coordinates of the owned free nodes [m], (n_local / d, d)."""
    reference: Array
    """Reference point of the hand [m], (d,)."""
    order: int = 1
    """Order of the elements."""
    extent: float = 1.0
    """Longest side of the bounding box of the free nodes [m], the same on every rank."""
    held: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Coordinates of the owned nodes that follow the hand [m], (k, d)."""
    patches: Callable[[], Patches] | None = None
    """Function that makes the stars, collective; None for linear elements."""

    @property
    def states(self) -> int:
        """Length 2n of the first-order state [q_s, v_s, q_e, v_e]."""
        return 2 * (self.n_s + self.n_e)

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates of the free nodes [m]. Collective."""
        return bounding_box(self.comm, self.nodes)

    def body_bounds(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates of all nodes, also of those that follow the hand [m]. Collective."""
        return bounding_box(self.comm, np.vstack([self.nodes, self.held]))

    def near_body(self, point: Array) -> bool:
        """Whether a point [m] lies in the bounding box of the body or not far outside. Collective."""
        low, high = self.body_bounds()
        slack = NEAR * float((high - low).max())
        return bool(((point >= low - slack) & (point <= high + slack)).all())

    def rounded(self, lengths: Array) -> Array:
        """Lengths on a decimal grid of about 1e-9 of the body, so that rounding makes no difference."""
        return np.asarray(np.round(lengths, 9 - int(np.floor(np.log10(self.extent)))))

    def nearest_node(self, point: Array) -> tuple[int, int, Array]:
        """Free node nearest to a point: owning rank, its first local dof there, its coordinates.

        Ties go to the lexicographically smallest coordinates, so that every rank count picks the same node.
        Collective.
        """
        where, rank, i = self.nearest_nodes(self.nodes, point)[1][0]
        return rank, i * self.dimension, np.array(where)

    def nearest_nodes(self, nodes: Array, point: Array, farthest: bool = False) -> tuple[float, list[Place]]:
        """Distance of the nearest (farthest) of distributed nodes from a point, and all nodes at it, sorted.

        The distance is infinite where there is no node. Collective.
        """
        sign = -1.0 if farthest else 1.0
        distance = sign * self.rounded(np.linalg.norm(nodes - point, axis=1)) if len(nodes) else np.zeros(0)
        least = min(self.comm.allgather(float(distance.min(initial=np.inf))))
        here = np.flatnonzero(distance == least).tolist()
        parts = self.comm.allgather([(tuple(self.rounded(nodes[i]).tolist()), self.comm.rank, i) for i in here])
        return sign * least, sorted(node for part in parts for node in part)


def bounding_box(comm: MPI.Intracomm, nodes: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates of distributed nodes. Collective."""
    empty = np.full((1, nodes.shape[1]), np.inf)
    lows = comm.allgather(np.vstack([nodes, empty]).min(axis=0))
    highs = comm.allgather(np.vstack([nodes, -empty]).max(axis=0))
    return np.min(lows, axis=0), np.max(highs, axis=0)
