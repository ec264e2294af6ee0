"""Whether linear elements are enough: nearly incompressible tissue is run again with quadratic ones."""

from __future__ import annotations

from typing import Any

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.materials import young_poisson
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.change import compare, shown
from softgrasp.study.effects.result import Elements
from softgrasp.study.effects.switch import changed
from softgrasp.study.forward.cautions import LOCKING


def judge_elements(model: Model, trajectory: Trajectory, tolerance: float) -> Elements | None:
    """Run the scene with P2 when it has P1 and a ratio of Poisson at which P1 locks, else None. Collective."""
    nu = max(young_poisson(m.lam, m.mu)[1] for m in model.system.materials)
    if model.scene.tissue.order != 1 or nu <= LOCKING + 1e-9:
        return None
    other = build(quadratic(model), comm=model.system.layout.comm)
    change = compare(shown(model, trajectory), shown(other, simulate(other, RunOptions())))
    needed = change.outputs > tolerance
    text = (
        f"Measured at nu = {nu:.4g}: on the same mesh tissue.order = 2 changes the outputs by {change.outputs:.2g} and "
        f"their deformation by {change.deformation:.2g}, tolerance {tolerance:g}: "
    )
    text += "P2 is needed." if needed else "this run does not show the locking."
    ratio = other.system.layout.n_e / model.system.layout.n_e
    return Elements(nu, change, ratio, needed, text)


def quadratic(model: Model) -> Scene:
    """The scene with P2 and its outputs at the very nodes that they have with P1. Collective."""
    outputs = make_outputs(model.scene, model.system)

    def edit(table: dict[str, Any]) -> None:
        table["tissue"]["order"] = 2
        control = table.setdefault("control", {})
        if not control.get("outputs"):
            control["outputs"] = [{"kind": "node", "name": o.name, "point": list(o.point)} for o in outputs]
        for entry, output in zip(control["outputs"], outputs, strict=True):
            if entry["kind"] == "node":
                entry["point"] = list(output.point)

    return changed(model.scene, edit)
