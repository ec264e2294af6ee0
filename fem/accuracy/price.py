"""What runs and estimates cost, counted from their sizes: the same on every machine and under every load.

Seconds of one core of the machine where the constants were measured (2D: triangles, 3D: tetrahedra of boxes); a factor
takes n^1.5 in 2D and n^2 in 3D, a solve with it n log n and n^(4/3), by nested dissection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from softgrasp.fem.accuracy.estimate import MOST_COMPARED, next_unknowns
from softgrasp.fem.accuracy.krylov import BLOCKS
from softgrasp.fem.accuracy.surplus import ITERATIONS, MODES
from softgrasp.fem.model.build import Model
from softgrasp.fem.solve.solvers import ITERATIVE, choose_solver

SHARE = 0.3  # of a run's work that an estimate may take unasked
START = 3.0  # [s] of every command: imports, page and pictures of a small run
# By dimension and order: seconds to build a cell, and entries of K an unknown.
BUILD = {(2, 1): 6e-6, (2, 2): 2.5e-5, (2, 3): 5.4e-5, (2, 4): 2e-4,
         (3, 1): 9e-6, (3, 2): 9e-5, (3, 3): 6.7e-4, (3, 4): 3.5e-3}  # fmt: skip
ENTRIES = {(2, 1): 14, (2, 2): 23, (2, 3): 34, (2, 4): 46, (3, 1): 40, (3, 2): 77, (3, 3): 123, (3, 4): 198}
PER_ENTRY = 1e-9  # [s] of an entry in a product
PRODUCTS = 4  # with a column of a Krylov model, for its inner products
STARS = {2: 3e-5, 3: 1.2e-4, 4: 4e-4}  # [s] an unknown to set up stars, by order
STARS_ENTRY = 6.5e-9  # [s] of an entry in an iteration with them
STEP_ITERATIONS = 7  # of a step with them, or of cg with another preconditioner that takes as long
MOST_STARS = 1_200_000  # unknowns whose stars fit into the memory of a node
COARSER = (0.8, 2 / 3, 0.5)  # cells a side of a box that is estimated instead, over those of the mesh
GRADED = {2: 0.3, 3: 0.9}  # [s] of graded meshes to compare with
GRADED_FILE = {2: 0.3, 3: 3.5}  # the same of a mesh file, whose edges are bisected


def factor_seconds(d: int, n: float) -> float:
    """Of a Cholesky factor of n unknowns."""
    return 3.5e-8 * n**1.5 if d == 2 else 1.3e-9 * n**2


def solve_seconds(d: int, n: float) -> float:
    """Of one solve with it."""
    return 1.2e-8 * n * math.log2(max(n, 2)) if d == 2 else 3.5e-8 * n ** (4 / 3)


def run_seconds(model: Model) -> float:
    """Of the run of a scene: its start, building, factors and steps."""
    layout, scene = model.system.layout, model.scene
    d, n, kind = layout.dimension, layout.n_e, _kind(model)
    entries = ENTRIES[kind] * n
    if choose_solver(layout, scene.time.solver)[0] in ITERATIVE:
        factor, step = 0.0, STEP_ITERATIONS * STARS_ENTRY * entries
    else:
        factor, step = factor_seconds(d, n), solve_seconds(d, n) + PRODUCTS * PER_ENTRY * entries
    factors = 2 if scene.time.start == "equilibrium" else 1
    return START + BUILD[kind] * _cells(model) + factors * factor + scene.time.steps * step


@dataclass(frozen=True)
class Plan:
    """One way to estimate the error of a mesh, as :func:`softgrasp.fem.accuracy.estimate.estimate` takes it."""

    seconds: float  # what it takes
    surplus: bool = False  # iterations on the next order instead of solves
    cells: list[int] | None = None  # of the coarser box that is estimated instead

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
            cells = [max(math.ceil(ratio * n), 1) for n in tissue.cells]
            share = math.prod(cells) / math.prod(tissue.cells)
            if share < 1:
                built = BUILD[d, p] * share * _cells(model)
                result.append(Plan(_estimate_seconds(model, share) + built, cells=cells))
    return result


def affordable(model: Model, budget: float) -> Plan | None:
    """The best way to estimate within so many seconds, if there is one."""
    return next((plan for plan in plans(model) if plan.seconds <= budget), None)


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
    column = solve_seconds(d, n) + PRODUCTS * PER_ENTRY * ENTRIES[d, p] * n
    return factor_seconds(d, n) + BLOCKS * _columns(model) * column


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
