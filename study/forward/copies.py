"""Smaller models in place of large ones that `explain` does not assemble.

The numbers of a copy have two digits; the sizes of the scene's own mesh are counted or computed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Scene
from softgrasp.fem.accuracy.price import fewer_lines
from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.mesh.singular import Ends
from softgrasp.fem.mesh.tissue_mesh import TissueMesh
from softgrasp.fem.model.assembly import discretise
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.memory import box_simplices, check_memory
from softgrasp.fem.model.refined import SHRINK, by_lines, lined_cells, refined_mesh
from softgrasp.fem.scene.scene import check_dimension
from softgrasp.fem.solve.costs import BUILD
from softgrasp.study.forward.result import ModelSizes, model_sizes
from softgrasp.study.report import percent

MOST_LOOKED_AT = {2: 8_000, 3: 6_000}  # unknowns that modes, sag and estimate are computed on
LOOKED_AT = "Modes, sag and what follows from them are those of "
NOT_ASSEMBLED = (
    "So large a mesh is not assembled here: modes, sag, places of outputs and what follows from them are those of "
)

SAMPLED = {2: "to about 5 %", 3: "to about 20 %"}  # exactness of counts on a sample, by dimension


@dataclass(frozen=True)
class Copy:
    """A smaller model in place of that of a scene."""

    model: Model  # the smaller model
    sizes: ModelSizes  # of the scene's own mesh
    text: str  # whose modes and sag are told, and how exact the sizes are, in sentences
    finer: float  # edges of the cells of the scene over those of the copy, the largest ratio [1]
    boundary: int  # nodes of the scene's own mesh on its boundary
    counted: bool = False  # whether the unknowns are counted; else computed
    alike: bool = True  # whether singular ends and error of the mesh follow from it
    ends: Ends | None = None  # singular ends of the scene's own body, around which its cells were counted on a sample
    notes: tuple[str, ...] = ()  # warnings, one sentence each


def build_seconds(scene: Scene) -> float:
    """Modelled time to build a box [s]; 0 for other scenes, and where cells are bisected."""
    if not scene.tissue.cells or scene._given is not None:
        return 0.0
    scene = lined(scene)
    tissue, refine = scene.tissue, scene.tissue.refine
    d = len(tissue.cells or [])
    if d * _lattice(scene) <= MOST_LOOKED_AT[d]:  # its copy would be itself
        return 0.0
    if refine is not None and not (by_lines(scene) and refine.tolerance is None and d * _lattice(scene) <= refine.most):
        return 0.0
    return BUILD[d, tissue.order] * box_simplices(tissue.cells or [])


def lined(scene: Scene) -> Scene:
    """The scene with the cells that a tolerance chooses, where it moves the lines of a box; else the scene itself."""
    refine = scene.tissue.refine
    if refine is None or refine.tolerance is None or not by_lines(scene):
        return scene
    changes = {
        "cells": lined_cells(scene, refine, refine.tolerance),
        "refine": refine.model_copy(update={"tolerance": None}),
    }
    return scene.model_copy(update={"tissue": scene.tissue.model_copy(update=changes)})


def box_copy(scene: Scene, comm: MPI.Intracomm) -> Copy | None:
    """Of a box, whose sizes are computed; None where fewer cells miss the zone or a layer. Collective."""
    scene = lined(scene)
    cells = scene.tissue.cells or []
    check_memory(scene, comm, False, len(cells), box_simplices(cells))
    model = on_fewer_cells(scene, comm)
    if model is None:
        return None
    pairs = zip(model.scene.tissue.cells or [], cells, strict=True)
    text = (
        f"{NOT_ASSEMBLED}the same scene on coarser cells, n_e = {model.system.layout.n_e}. Sizes with about are "
        "computed from that copy, to 1 % of the unknowns and 10 % of the non-zeros."
    )
    finer = max(few / many for few, many in pairs)
    order = scene.tissue.order
    boundary = _lattice(scene) - math.prod(order * n - 1 for n in cells)
    return Copy(model, sizes_from(model, scene), text, finer, boundary)


def cubic_copy(
    scene: Scene, comm: MPI.Intracomm, mesh: TissueMesh | None = None
) -> tuple[Copy | None, TissueMesh | None]:
    """Of cubic elements on cells that no box gives: quadratic ones there, which change frequencies by about 1 %.

    None where there are too many or few; and the mesh, if it was made or is given. Collective.
    """
    adaptive = scene.tissue.refine is not None and scene.tissue.refine.tolerance is not None
    if scene.tissue.order < 3 or not (adaptive or scene.tissue.mesh):
        return None, mesh
    mesh = mesh or refined_mesh(comm, scene)
    check_dimension(scene, d := mesh.dimension)
    layout = discretise(mesh, scene).layout
    if layout.n_e <= MOST_LOOKED_AT[d]:
        return None, mesh
    tissue = scene.tissue.model_copy(update={"order": 2})
    model = build(scene.model_copy(update={"tissue": tissue}), comm=comm, mesh=mesh, run=False)
    if model.system.layout.n_e > MOST_LOOKED_AT[d]:
        return None, mesh
    sizes = computed(model, 3, simplices_of(model), layout.n_e)
    text = (
        f"{LOOKED_AT}the same cells with quadratic elements, tissue.order = 2, "
        f"n_e = {model.system.layout.n_e}; the number of non-zeros is computed from that copy."
    )
    on = comm.allreduce(sum(int(np.count_nonzero(flags)) for flags in model.space.surface()))
    boundary = boundary_nodes(d, on // 2 if d == 2 else (on + 6) // 4, 3)  # of quadratic elements 2 V, or 4 V - 6
    return Copy(model, sizes, text, 1.0, boundary, counted=True), mesh


def boundary_nodes(d: int, vertices: int, order: int) -> int:
    """Nodes on the boundary of a body without holes that has so many vertices there, by Euler's formula."""
    if d == 2:
        return order * vertices
    edges, facets = 3 * (vertices - 2), 2 * (vertices - 2)
    return vertices + (order - 1) * edges + math.comb(order - 1, 2) * facets


def too_many(scene: Scene, n_e: int) -> tuple[str, ...]:
    """The warning that a graded mesh of about so many unknowns may be refused; empty where it fits."""
    refine = scene.tissue.refine
    if refine is None or refine.tolerance is not None or n_e <= refine.most:
        return ()
    return (
        f"The graded mesh has about {n_e} unknowns, and tissue.refine.most = {refine.most} allows fewer: simulate "
        "refuses a mesh that has more; raise it, or use larger cells.",
    )


def step_text(d: int, order: int) -> str:
    """What to say of a tolerance that grew until its unknowns fit, of which they are a power."""
    step = percent(SHRINK ** (d / (2 * min(order, 3))) - 1)
    return f" tissue.refine.most made the tolerance grow by steps, and one more or less is another {step}."


def node_pairs_of(counts: Sequence[int], order: int) -> tuple[int, int]:
    """Nodes, and ordered pairs of nodes that share a cell, of Lagrange elements on a simplex mesh.

    Pairs that touch exactly the vertices of one k-simplex: c_k = sum_j (-1)^(k-j) C(k+1, j+1) n_j^2 with the
    n_j = C(p+j, j) nodes of a j-simplex; with n_j in place of its square, nodes inside it.

    ``counts``: simplices of the mesh by dimension, vertices first.
    """

    def inside(k: int, power: int) -> int:
        return sum((-1) ** (k - j) * math.comb(k + 1, j + 1) * math.comb(order + j, j) ** power for j in range(k + 1))

    nodes, pairs = (sum(n * inside(k, power) for k, n in enumerate(counts)) for power in (1, 2))
    return nodes, pairs


def computed(copy: Model, order: int, counts: Sequence[int], n_e: int) -> ModelSizes:
    """Sizes of a mesh of so many simplices by dimension, from those of a copy. Collective.

    Entries of K_ee are as many of the pairs of free nodes as in the copy.
    """
    small, (nodes, pairs) = model_sizes(copy), node_pairs_of(counts, order)
    _, few = node_pairs_of(simplices_of(copy), copy.scene.tissue.order)
    nonzeros = small.nonzeros * pairs / few * (n_e / nodes) / (small.n_e / small.nodes)
    return replace(
        small, n_e=n_e, states=2 * (small.n_s + n_e), cells=counts[-1], nodes=nodes,
        nonzeros=int(float(f"{nonzeros:.1e}")),
    )  # fmt: skip


def simplices_of(model: Model) -> list[int]:
    """Simplices of its mesh by dimension, vertices first. Collective."""
    topology, d = model.space.mesh.mesh.topology, model.system.layout.dimension
    for k in range(1, d):
        topology.create_entities(k)
    return [topology.index_map(k).size_global for k in range(d + 1)]


def _lattice(scene: Scene) -> int:
    """Nodes of a box, whose lines may crowd."""
    return math.prod(scene.tissue.order * n + 1 for n in scene.tissue.cells or [])


def _simplices(scene: Scene) -> list[int]:
    """Simplices of a box by dimension: each follows a chain of corners of a lattice cell, from the lowest on."""
    cells = scene.tissue.cells or []
    counts = [0] * (len(cells) + 1)
    for step in product((0, 1), repeat=len(cells)):
        places, m = math.prod(n + 1 - o for n, o in zip(cells, step, strict=True)), sum(step)
        for k in range(bool(m), m + 1):  # m directions in k steps
            counts[k] += places * sum((-1) ** (k - i) * math.comb(k, i) * i**m for i in range(k + 1))
    return counts


def sizes_from(copy: Model, scene: Scene) -> ModelSizes:
    """Sizes of a box from those of its copy on fewer cells. Collective.

    Measured: unknowns to 0.1 % in 2D and 1 % in 3D; entries to 0.5 % in 2D and, of quadratic cells in 3D, 10 %.
    """
    small, d, counts = model_sizes(copy), copy.system.layout.dimension, _simplices(scene)
    nodes, _ = node_pairs_of(counts, scene.tissue.order)
    held = (d * small.nodes - small.n_e) * (nodes / small.nodes) ** ((d - 1) / d)  # the zone is a surface
    return computed(copy, scene.tissue.order, counts, int(float(f"{d * nodes - held:.2e}")))


def coarser_copy(model: Model) -> Model:
    """The scene of a large box on fewer cells, for numbers of two digits; else the model itself. Collective."""
    if fewer_cells(model, MOST_LOOKED_AT) is None:
        return model
    return on_fewer_cells(model.scene, model.system.layout.comm) or model


def fewer_cells(model: Model, most: dict[int, int]) -> Scene | None:
    """The scene of a box that has more unknowns than ``most`` by dimension, on that many; None of any other scene."""
    tissue, layout = model.scene.tissue, model.system.layout
    adaptive = tissue.refine is not None and tissue.refine.tolerance is not None
    if tissue.cells is None or adaptive or layout.n_e <= most[layout.dimension]:
        return None
    return coarsened(model.scene, most)


def coarsened(scene: Scene, most: dict[int, int]) -> Scene:
    """The scene of a box on the cells of about so many unknowns, by dimension."""
    cells = scene.tissue.cells or []
    ratio = (most[len(cells)] / (len(cells) * _lattice(scene))) ** (1 / len(cells))
    fewer = fewer_lines(scene, [max(int(ratio * n), 1) for n in cells])
    return scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"cells": fewer})})


def on_fewer_cells(scene: Scene, comm: MPI.Intracomm) -> Model | None:
    """The scene of a box on fewer cells; None where these miss the zone or a layer. Collective."""
    try:
        return build(coarsened(scene, MOST_LOOKED_AT), comm=comm, run=False)
    except (MeshError, SceneError):
        return None
