"""How the full model is solved in one run of a work-precision study: mesh, order, steps, solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import ceil
from typing import Any, Literal

import numpy as np

from softgrasp.fem import STEP_RTOL, Scene

LEAST_STEPS = 4  # of a run
Refine = float | Literal["off", "scene"]
Group = tuple[tuple[int, ...] | None, int, Refine]  # cells, order and grading of a mesh


@dataclass(frozen=True)
class Setting:
    """How the full model is solved."""

    cells: tuple[int, ...] | None  # of an even mesh of the structured box; None on a mesh file and on graded meshes
    order: int  # of the displacement, 1 to 3
    steps: int  # equal time steps
    solver: str = "auto"  # linear solver
    rtol: float | None = None  # relative residual at which an iterative one ends a step [1]; None for its default
    # tolerance of the a-priori graded mesh, "off" for even cells or those of a file, "scene" for the scene's own
    # [tissue.refine]
    refine: Refine = "off"

    @property
    def mesh(self) -> str:
        """Mesh and order in words."""
        if self.refine == "scene":
            return f"the scene's graded mesh, P{self.order}"
        shape = "mesh file" if self.cells is None else " x ".join(map(str, self.cells))
        return f"{shape if self.refine == 'off' else f'graded {self.refine:.2g}'}, P{self.order}"

    @property
    def tolerance(self) -> float | None:
        """Relative residual at which a step ends [1]; None where the solver is direct or chosen by size."""
        return (self.rtol or STEP_RTOL[self.solver]) if self.solver in STEP_RTOL else None

    @property
    def entries(self) -> dict[str, Any]:
        """All by name."""
        return asdict(self) | {"rtol": self.tolerance}

    @property
    def label(self) -> str:
        """All in words."""
        tail = "" if self.solver == "auto" else f", {self.solver}"
        tail += "" if self.tolerance is None else f" {self.tolerance:g}"
        return f"{self.mesh}, {self.steps} steps{tail}"

    @property
    def family(self) -> str:
        """Kind of mesh and order: meshes of one family are one series in space."""
        return f"{'even' if self.refine == 'off' else 'graded'} P{self.order}"

    @property
    def parameters(self) -> dict[str, Any]:
        """What names the run in result.json; without the grading where there is none."""
        refine = {} if self.refine == "off" else {"refine": self.refine}
        return {"cells": self.cells, "order": self.order, "steps": self.steps, "solver": self.solver} | refine

    def overrides(self, scene: Scene) -> list[str]:
        """Arguments of ``--set`` that give this setting of a scene."""
        mesh = [] if self.cells is None else [f"tissue.cells={list(self.cells)}"]
        if isinstance(self.refine, float):
            mesh = [f"tissue.refine={{tolerance={self.refine:g},passes=0}}"]
        elif self.refine == "off" and scene.tissue.refine is not None:
            mesh.append("tissue.refine=false")
        rtol = [] if self.tolerance is None else [f"time.rtol={self.tolerance:g}"]
        return [*mesh, f"tissue.order={self.order}", f"time.steps={self.steps}", f"time.solver={self.solver}", *rtol]

    @property
    def group(self) -> Group:
        """Mesh and order, whatever the steps."""
        return self.cells, self.order, self.refine

    def unknowns(self, d: int) -> int:
        """About how many tissue unknowns an even mesh of a box has; 0 for others."""
        return 0 if self.cells is None else d * int(np.prod([self.order * n + 1 for n in self.cells]))


def scene_setting(scene: Scene) -> Setting:
    """The scene's own setting."""
    tissue, time = scene.tissue, scene.time
    cells = None if tissue.cells is None or tissue.refine is not None else tuple(tissue.cells)
    refine: Refine = "off" if tissue.refine is None else "scene"
    return Setting(cells, tissue.order, time.steps, time.solver, time.rtol, refine)


def own_setting(scene: Scene) -> Setting:
    """The scene's mesh, order and steps, as the forward diagram names them."""
    own = scene_setting(scene)
    return Setting(own.cells, own.order, own.steps, refine=own.refine)


def least_steps(scene: Scene) -> int:
    """Fewest steps of a run: a prescribed move needs two over its duration."""
    motion = scene.motion
    if motion.drive == "motion" and motion.profile == "quintic":
        return max(LEAST_STEPS, ceil(2 * scene.time_end / motion.duration))
    return LEAST_STEPS


def variant(scene: Scene, setting: Setting, snapshots: str = "none", reference: Sequence[float] | None = None) -> Scene:
    """The scene under another setting; ``reference``: where the hand turns, by default where the mesh puts it [m]."""

    def edit(table: dict[str, Any]) -> None:
        tissue = table["tissue"]
        if setting.cells is not None:
            tissue["cells"] = list(setting.cells)
        if setting.refine != "scene":
            tissue.pop("refine", None)
        if isinstance(setting.refine, float):
            tissue["refine"] = {"tolerance": setting.refine, "passes": 0}
        tissue["order"] = setting.order
        table["time"] |= {"steps": setting.steps, "solver": setting.solver, "rtol": setting.rtol}
        table["output"] = table.get("output", {}) | {"snapshots": snapshots, "every": 1}
        if reference is not None:
            table["hand"]["reference"] = list(reference)

    return scene.changed(edit)


POINT_WORK = {2: 8e6, 3: 1e6}  # unknowns times steps of a point of the diagram
FEW_STEPS = 60  # least of a run
PARTS = 16  # of the scene's cells along an edge, at most, in one cell of the smallest mesh
STRETCH = 1.35  # of a cell of the smallest mesh against one of the scene's
EVEN = 4  # meshes of each order
ORDERS = (1, 2, 3)
FASTEST, SLOWEST = 0.2, 0.6  # errors of graded meshes fall about as their tolerances, by 0.3
# Tolerances of the a-priori graded meshes of the diagram, by dimension and order.
GOALS = {
    2: {1: (0.3, 0.1, 0.03), 2: (0.1, 0.03, 0.01, 3e-3, 1e-3), 3: (0.03, 0.01, 3e-3, 1e-3, 3e-4)},
    3: {1: (0.3, 0.1), 2: (0.3, 0.03, 0.01), 3: (0.3, 0.03, 0.01)},
}


def edges(scene: Scene) -> list[list[float]]:
    """Coordinates that mesh lines should meet, as shares of each edge of the body: ends of contact and layers."""
    size, origin = scene.tissue.size or [], scene.tissue.origin or [0.0] * len(scene.tissue.size or [])
    boxes = [layer.box for layer in scene.tissue.layers.values()] + [scene.contact.box]
    lines = []
    for a, (length, low) in enumerate(zip(size, origin, strict=True)):
        shares = {round((corner[a] - low) / length, 12) for box in boxes if box is not None for corner in box}
        lines.append(sorted(s for s in shares if 0 < s < 1))
    return lines


def fits(cells: int, shares: list[float]) -> bool:
    """Whether all coordinates lie on lines of an even mesh."""
    return all(abs(cells * s - round(cells * s)) < 1e-6 for s in shares)


def fitted(target: float, shares: list[float]) -> int | None:
    """Number of cells nearest to a target whose lines meet all coordinates; None when none within a half does."""
    span = range(max(1, ceil(target / 1.6)), int(target * 1.6) + 2)
    good = [n for n in span if fits(n, shares)]
    return min(good, key=lambda n: (abs(n - target), -n)) if good else None


def smallest_mesh(scene: Scene) -> tuple[int, ...]:
    """The fewest cells in about the scene's shape whose lines meet the ends of contact zone and layers.

    Where no mesh meets them all, a quarter of the scene's cells along an edge.
    """
    cells, lines = scene.tissue.cells or [], edges(scene)
    for part in range(PARTS, 0, -1):
        counts = [fitted(n / part, shares) for n, shares in zip(cells, lines, strict=True)]
        unit = tuple(n for n in counts if n is not None)
        stretch = [u * part / n for u, n in zip(unit, cells, strict=False)]
        if len(unit) == len(cells) and max(stretch) <= STRETCH * min(stretch):
            return unit
    return tuple(max(1, round(n / 4)) for n in cells)


def even_meshes(scene: Scene, order: int) -> list[tuple[int, ...] | None]:
    """The finest even meshes of a box, each with half the cells of the next; of a mesh file, the file."""
    if scene.tissue.cells is None:
        return [None]
    unit, d = smallest_mesh(scene), len(scene.tissue.cells)
    meshes = [unit]
    while True:
        cells = tuple(2 * n for n in meshes[-1])
        if Setting(cells, order, 1).unknowns(d) * few_steps(scene) > POINT_WORK[d]:
            return list(meshes[-EVEN:])
        meshes.append(cells)


def few_steps(scene: Scene) -> int:
    """Steps of the runs on fine meshes."""
    n = scene.time.steps
    return n // 2 if n >= 2 * max(FEW_STEPS, least_steps(scene)) else n


def contraction(changes: list[float], growth: float) -> float:
    """By what errors fall from mesh to mesh: as the last two changes of the solution; 1 / growth of n_e after one."""
    ratio = changes[-1] / changes[-2] if len(changes) > 1 and changes[-2] > 0 else 1 / growth
    return float(np.clip(ratio, FASTEST, SLOWEST))
