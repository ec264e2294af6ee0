"""Which free nodes lie in the star of each vertex, and how linear functions give the nodes of higher order."""

from __future__ import annotations

from typing import Any

import basix
import dolfinx.la
import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.layout import Patches
from softgrasp.fem.petsc import to_ranks


def make_patches(V: Any, free: NDArray[Any]) -> Patches:
    """Stars of the vertices of a space of order 2 or more, in whatever cells. Collective.

    A node of an edge, face or cell is in the stars of the vertices of that entity. A rank lists the stars of the
    vertices that it owns; neighbours that only cells of other ranks have are sent to it.

    ``free``: owned local numbers of the nodes that are unknowns, ascending.
    """
    element, cells, index = V.element.basix_element, V.dofmap.list, V.dofmap.index_map
    owned, every = index.size_local, index.size_local + index.num_ghosts
    corner = [dofs[0] for dofs in element.entity_dofs[0]]
    points = element.points
    share = np.column_stack([1 - points.sum(axis=1), points])  # of the linear functions of the corners, at the nodes
    pairs, weights = [], []  # of a node and a corner of its entity
    for entities, numbers in zip(basix.topology(element.cell_type), element.entity_dofs, strict=True):
        for corners, dofs in zip(entities, numbers, strict=True):
            for j in dofs:
                for i in corners:
                    pairs.append(np.column_stack([cells[:, corner[i]], cells[:, j]]))
                    weights.append(np.full(len(cells), share[j, i]))
    pair, weight = np.concatenate(pairs).astype(np.int64), np.concatenate(weights)
    key, first = np.unique(pair[:, 0] * every + pair[:, 1], return_index=True)
    vertex, node, weight = key // every, key % every, weight[first]
    is_free = np.zeros(every, dtype=bool)
    is_free[free] = True
    number, _ = _numbers(index, is_free)
    is_vertex = np.zeros(every, dtype=bool)
    is_vertex[vertex] = True
    coarse, count = _numbers(index, is_free & is_vertex)
    star, inside = _whole(index, vertex[number[node] >= 0], number[node[number[node] >= 0]])
    known = (node < owned) & (number[node] >= 0) & (coarse[vertex] >= 0) & (weight != 0)
    return Patches(
        star=star,
        node=inside,
        row=number[node[known]],
        column=coarse[vertex[known]],
        weight=weight[known],
        vertices=np.flatnonzero(is_vertex[free]),
        count=count,
    )


def _whole(index: Any, vertex: NDArray[Any], node: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Pairs of an owned vertex and a node of its star, from those that each rank sees, in order. Collective.

    Ghost cells share a facet with a cell of the rank: of a vertex at the corner of three ranks some cells are missing.
    """
    owned, comm = index.size_local, index.comm
    away = vertex >= owned
    there = index.local_to_global(vertex[away].astype(np.int32)).astype(np.int64)
    found = to_ranks(comm, index.owners[vertex[away] - owned], np.column_stack([there, node[away]]))
    found[:, 0] -= index.local_range[0]
    pairs = np.unique(np.concatenate([found, np.column_stack([vertex[~away], node[~away]])]), axis=0)
    return pairs[:, 0], pairs[:, 1]


def _numbers(index: Any, marked: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Global numbers of the marked nodes by all local ones (-1 elsewhere), and how many are owned. Collective."""
    values = dolfinx.la.vector(index, 1, dtype=np.int64)
    owned = marked[: index.size_local]
    count = int(owned.sum())
    values.array[:] = -1
    values.array[: index.size_local][owned] = (index.comm.exscan(count) or 0) + np.arange(count)
    values.scatter_forward()
    return values.array.copy(), count
