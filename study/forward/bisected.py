"""A coarser copy of a box whose cells are bisected at singular ends, which `explain` neither bisects nor assembles."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from softgrasp.fem import Scene
from softgrasp.fem.errors import MeshError, SceneError
from softgrasp.fem.mesh.check import on_boundary
from softgrasp.fem.model.build import build
from softgrasp.fem.model.memory import check_memory
from softgrasp.fem.model.refined import by_lines, sampled_box
from softgrasp.fem.petsc import on_root
from softgrasp.fem.scene.tissue import Refine
from softgrasp.study.forward.copies import (
    MOST_LOOKED_AT,
    NOT_ASSEMBLED,
    SAMPLED,
    Copy,
    boundary_nodes,
    coarsened,
    computed,
    step_text,
    too_many,
)
from softgrasp.study.forward.filed import Outline, large, outlined

MOST_TOLERANCE = 0.9  # of a copy [1]


def bisected_copy(scene: Scene, comm: MPI.Intracomm) -> Copy | None:
    """Of a box with many cells that are bisected: one with a larger tolerance, or fewer cells to bisect. Collective.

    None of other scenes, and where the copy misses the zone or a layer.

    Raises SceneError: even the coarsest mesh has more than ``tissue.refine.most`` unknowns.
    """
    tissue, refine = scene.tissue, scene.tissue.refine
    if tissue.cells is None or refine is None or by_lines(scene) or scene._given is not None:
        return None
    d, order = len(tissue.cells), tissue.order
    outline, aim = on_root(comm, lambda: _outline(scene, refine))
    if not large(d, order, outline.counts[-1]):
        return None
    check_memory(scene, comm, False, d, outline.counts[-1])
    try:
        model = build(_coarser(scene, refine, aim, outline.unknowns(order)), comm=comm, run=False)
    except (MeshError, SceneError):
        return None
    n_e = int(float(f"{outline.unknowns(order):.2e}"))
    sizes = computed(model, order, outline.counts, n_e)
    text = (
        f"{NOT_ASSEMBLED}the same scene on coarser cells, n_e = {model.system.layout.n_e}. Sizes with about are "
        f"computed, {SAMPLED[d]} of the unknowns, as cells are counted on a sample."
    )
    text += step_text(d, order) * outline.grew
    finer = (model.cells / sizes.cells) ** (1 / d)
    boundary, notes = boundary_nodes(d, outline.skin, order), too_many(scene, n_e)
    return Copy(model, sizes, text, finer, boundary, alike=False, ends=outline.ends, notes=notes)


def _outline(scene: Scene, refine: Refine) -> tuple[Outline, float | None]:
    """Of the bisected box, and the tolerance that its unknowns fit to. On one rank."""
    whole, ends, many, aim = sampled_box(scene, refine)
    points, cells = whole.points, whole.simplices
    skin, held = int(on_boundary(cells, len(points)).sum()), len(np.unique(whole.facet_nodes("contact")))
    return outlined(points.shape, len(cells), skin, held, 1.0, "").grown(many, ends, aim != refine.tolerance), aim


def _coarser(scene: Scene, refine: Refine, aim: float | None, unknowns: float) -> Scene:
    """The scene of a bisected box with about as many unknowns as are looked at."""
    d, tissue = len(scene.tissue.cells or []), scene.tissue
    share = MOST_LOOKED_AT[d] / unknowns
    if aim is None:
        base = d * np.prod([tissue.order * n + 1 for n in tissue.cells or []])
        return coarsened(scene, {d: int(share * base)})
    larger = min(aim * share ** (-2 * min(tissue.order, 3) / d), MOST_TOLERANCE)
    fewer = refine.model_copy(update={"tolerance": larger, "most": MOST_LOOKED_AT[d]})
    return scene.model_copy(update={"tissue": tissue.model_copy(update={"refine": fewer})})
