"""How the full model is solved in one run of a work-precision study: mesh, order, steps, solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.switch import changed

LEAST_STEPS = 4  # of a run
Group = tuple[tuple[int, ...] | None, int]  # cells and order of a mesh


@dataclass(frozen=True)
class Setting:
    """How the full model is solved.

    Attributes:
        cells: of the structured box; None on a mesh file.
        order: of the displacement, 1 or 2.
        steps: equal time steps.
        solver: linear solver.
        rtol: tolerance of an iterative one.
    """

    cells: tuple[int, ...] | None
    order: int
    steps: int
    solver: str = "auto"
    rtol: float = 1e-10

    @property
    def mesh(self) -> str:
        """Mesh and order in words."""
        shape = "mesh file" if self.cells is None else " x ".join(map(str, self.cells))
        return f"{shape}, P{self.order}"

    @property
    def label(self) -> str:
        """All in words."""
        tail = "" if self.solver == "auto" else f", {self.solver}" + (f" {self.rtol:g}" if self.solver == "cg" else "")
        return f"{self.mesh}, {self.steps} steps{tail}"

    @property
    def overrides(self) -> list[str]:
        """Arguments of ``--set`` that give this setting."""
        cells = [] if self.cells is None else [f"tissue.cells={list(self.cells)}"]
        rtol = [f"time.rtol={self.rtol:g}"] if self.solver == "cg" else []
        return [*cells, f"tissue.order={self.order}", f"time.steps={self.steps}", f"time.solver={self.solver}", *rtol]

    @property
    def group(self) -> Group:
        """Mesh and order, whatever the steps."""
        return self.cells, self.order

    def unknowns(self, d: int) -> int:
        """About how many tissue unknowns a structured mesh has."""
        return 0 if self.cells is None else d * int(np.prod([self.order * n + 1 for n in self.cells]))


def scene_setting(scene: Scene) -> Setting:
    """The scene's own setting."""
    cells = None if scene.tissue.cells is None else tuple(scene.tissue.cells)
    return Setting(cells, scene.tissue.order, scene.time.steps, scene.time.solver, scene.time.rtol)


def own_setting(scene: Scene) -> Setting:
    """The scene's mesh, order and steps, as the forward diagram names them."""
    own = scene_setting(scene)
    return Setting(own.cells, own.order, own.steps)


def least_steps(scene: Scene) -> int:
    """Fewest steps of a run: a prescribed move needs two over its duration."""
    motion = scene.motion
    if motion.drive == "motion" and motion.profile == "quintic":
        return max(LEAST_STEPS, ceil(2 * scene.time_end / motion.duration))
    return LEAST_STEPS


def variant(scene: Scene, setting: Setting, snapshots: str = "none", reference: Sequence[float] | None = None) -> Scene:
    """The scene under another setting.

    Args:
        scene: the scene.
        setting: mesh, order, steps and solver.
        snapshots: where they go.
        reference: point that the hand turns about, which by default moves a little with the mesh.
    """

    def edit(table: dict[str, Any]) -> None:
        if setting.cells is not None:
            table["tissue"]["cells"] = list(setting.cells)
        table["tissue"].pop("refine", None)  # which may choose cells of its own: the series is one of even meshes
        table["tissue"]["order"] = setting.order
        table["time"] |= {"steps": setting.steps, "solver": setting.solver, "rtol": setting.rtol}
        table["output"] = table.get("output", {}) | {"snapshots": snapshots, "every": 1}
        if reference is not None:
            table["hand"]["reference"] = list(reference)

    return changed(scene, edit)
