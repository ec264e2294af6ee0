"""Work of runs and estimates, counted from their sizes: the same on every machine and under every load.

Seconds of one core of the machine where the constants were measured (2D: triangles, 3D: tetrahedra of boxes); a factor
needs n^1.5 in 2D and n^2 in 3D, a solve with it n log n and n^(4/3), by nested dissection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from softgrasp.fem.accuracy.estimate import MOST_COMPARED, next_unknowns
from softgrasp.fem.accuracy.krylov import BLOCKS
from softgrasp.fem.accuracy.surplus import ITERATIONS, MODES
from softgrasp.fem.model.build import Model
from softgrasp.fem.run.forecast import forecast
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.costs import BUILD, ENTRIES, FEW_SOLVES, Work

SHARE = 0.3  # of a run's work that an estimate may need without --certify
PRODUCTS = 4  # with a column of a Krylov model, for its inner products
STARS = {2: 2e-5, 3: 4.5e-5, 4: 1.3e-4}  # [s] an unknown to set up stars, by order
STARS_ENTRY = 6.5e-9  # [s] of an entry in an iteration with them
MOST_STARS = 1_200_000  # unknowns whose stars fit into the memory of a node
COARSER = (0.8, 2 / 3, 0.5)  # cells a side of a box that is estimated instead, over those of the mesh
MEETS = 1e-6  # distance of an end of the zone from a mesh line that is rounding, in cells [1]
GRADED = {2: 0.3, 3: 0.9}  # [s] of graded meshes to compare with
GRADED_FILE = {2: 0.3, 3: 3.5}  # the same of a mesh file, whose edges are bisected


def run_seconds(model: Model) -> float:
    """Of the run of a scene on one rank, whatever memory is free: the same everywhere."""
    layout = model.system.layout
    return forecast(model.scene, layout.n_e, layout.dimension, _cells(model), 1).seconds


@dataclass(frozen=True)
class Plan:
    """One way to estimate the error of a mesh, an argument of :func:`softgrasp.fem.accuracy.estimate.estimate`."""

    seconds: float  # modelled time of the estimate [s]
    surplus: bool = False  # iterations on the next order instead of solves
    cells: list[int] | None = None  # cells of the coarser box that is estimated instead

    @property
    def how(self) -> dict[str, Any]:
        """The arguments."""
        return {"surplus": self.surplus, "cells": self.cells}


def plans(model: Model) -> list[Plan]:
    """The ways that a model has, the best first."""
    layout, tissue = model.system.layout, model.scene.tissue
    d, (_, p), finer = layout.dimension, _kind(model), next_unknowns(model)
    result = [Plan(_estimate_seconds(model))]
    if tissue.refine is not None and d == 3 and finer <= MOST_STARS:
        solves = ITERATIONS * (_columns(model) + MODES) * STARS_ENTRY * ENTRIES[d, p + 1] * finer
        built = BUILD[d, p + 1] * _cells(model) + STARS[p + 1] * finer
        result.append(Plan(_krylov(model, d, p, layout.n_e) + built + solves, surplus=True))
    if tissue.cells is not None and (tissue.refine is None or tissue.refine.tolerance is None):
        for ratio in COARSER:
            cells = fewer_lines(model.scene, [max(math.ceil(ratio * n), 1) for n in tissue.cells])
            share = math.prod(cells) / math.prod(tissue.cells)
            if share < 1:
                built = BUILD[d, p] * share * _cells(model)
                result.append(Plan(_estimate_seconds(model, share) + built, cells=cells))
    return result


def fewer_lines(scene: Scene, most: list[int]) -> list[int]:
    """Cells of a box, up to ``most`` along each edge, that meet the ends of the zone if the scene's own cells do.

    On others the zone is a bit larger or smaller: of 4.1e5 unknowns in 2D the estimate was 0.6 or 2.0 instead of 1.1 %.
    """
    tissue, zone = scene.tissue, scene.contact.box
    size, cells = tissue.size or [], tissue.cells or []
    ends = [[0.0, 0.0] for _ in size]
    if zone is not None:
        origin = tissue.origin or [0.0] * len(size)
        ends = [[(x - o) / w for x in pair] for *pair, o, w in zip(*zone, origin, size, strict=True)]

    def meets(count: int, end: float) -> bool:
        return not 0 < end < 1 or abs(count * end - round(count * end)) < MEETS

    result = []
    for n, last, pair in zip(cells, most, ends, strict=True):
        met = [end for end in pair if meets(n, end)]
        result.append(next((m for m in range(last, last // 2, -1) if all(meets(m, end) for end in met)), last))
    return result


def affordable(model: Model, budget: float, cheapest: bool = False) -> Plan | None:
    """The best, or cheapest, way to estimate within so many seconds, if there is one."""
    ways = [plan for plan in plans(model) if plan.seconds <= budget]
    return min(ways, key=lambda plan: plan.seconds) if cheapest and ways else next(iter(ways), None)


def _estimate_seconds(model: Model, share: float = 1.0) -> float:
    """Of an estimate of a mesh with a share of the model's cells."""
    layout, tissue = model.system.layout, model.scene.tissue
    d, (_, p), box = layout.dimension, _kind(model), tissue.size is not None
    finer = share * next_unknowns(model)
    own = _krylov(model, d, p, share * layout.n_e)
    above = _krylov(model, d, p + 1, finer) + BUILD[d, p + 1] * share * _cells(model)
    if tissue.refine is not None:
        return own + above
    graded = (GRADED if box else GRADED_FILE)[d]
    return own + graded + (above if not box or finer <= MOST_COMPARED else 0.0)


def _krylov(model: Model, d: int, p: int, n: float) -> float:
    """Of a Krylov model of n unknowns: a factor, and some solves and products of each column."""
    system = model.system
    work = Work(int(n), d, p, 1, BLOCKS * _columns(model), True, system.contrast, graded=system.graded)
    name = replace(work, solves=FEW_SOLVES).solver()
    return work.seconds(name) + work.solves * PRODUCTS * work.product(ENTRIES[d, p])


def _columns(model: Model) -> int:
    """Static loads: of the hand's freedoms, and of outputs that are the tissue's."""
    control, d = model.scene.control, model.system.layout.dimension
    outputs = 1 if control is None or not control.outputs else sum(o.kind != "hand" for o in control.outputs)
    return model.system.layout.n_s + d * outputs


def _kind(model: Model) -> tuple[int, int]:
    return model.system.layout.dimension, model.scene.tissue.order


def _cells(model: Model) -> int:
    mesh = model.space.mesh
    return int(mesh.mesh.topology.index_map(mesh.dimension).size_global)
