"""Runs of a scene with any of its effects, each made once, and the change between two of them."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from typing import Any

import numpy as np

from softgrasp.fem import EFFECTS, Array, Scene, SceneError, TissueMesh, Trajectory, make_outputs, young_poisson
from softgrasp.fem.material import of_layers
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.motion import Force, motion_table
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.study.effects.result import Change, Elements
from softgrasp.study.effects.switch import Scales, switch
from softgrasp.study.forward.cautions import LOCKING
from softgrasp.study.report import percent

Names = frozenset[str]


@dataclass(frozen=True)
class Displacements:
    """Displacements of the outputs over a run, angles of the hand left out."""

    places: Array  # displacement of each output, (steps + 1, outputs, d) [m]
    rigid: Array  # displacement of each output by the rigid motion of the hand alone, (steps + 1, outputs, d) [m]


def displacements(model: Model, run: Trajectory) -> Displacements:
    """Displacements of the outputs of a run."""
    moves = [not column.rotation for column in run.columns]
    shape = len(run.times), -1, model.system.layout.dimension
    return Displacements(run.outputs[:, moves].reshape(shape), run.outputs_rigid[:, moves].reshape(shape))


def compare(a: Displacements, b: Displacements) -> Change:
    """Change between two runs of the same outputs."""

    def gap(x: Array, y: Array) -> tuple[float, float]:
        scale = max(float(np.linalg.norm(v, axis=2).max()) for v in (x, y))
        largest = float(np.linalg.norm(x - y, axis=2).max())
        return largest, (largest / scale if scale > 0 else 0.0)

    absolute, outputs = gap(a.places, b.places)
    return Change(outputs, gap(a.places - a.rigid, b.places - b.rigid)[1], absolute)


def force_of_motion(scene: Scene, model: Model) -> Force:
    """The force that would carry the bare hand along the prescribed motion, u_n = M_hand a_n.

    A hand with more freedoms than the scene's gets no load on them, one with fewer none of those it lacks.
    """
    u = motion_table(scene, model.system.layout.n_s).a @ model.system.M_hand.T

    def force(n: int, t: float, q: Array, v: Array) -> Array:
        result, shared = np.zeros(len(q)), min(len(q), u.shape[1])
        result[:shared] = u[n, :shared]
        return result

    return force


class SwitchRuns:
    """Runs of one scene with any set of its effects on, each made once. Collective.

    Where a control problem lets a force move the hand that the run moves by itself, every run has a second one under
    the force that would make that motion. ``models`` are built already, the scene's own among them; ``mesh`` is that of
    all, None where each makes its own.
    """

    def __init__(
        self, scene: Scene, scales: Scales, models: dict[Names, Model], mesh: TissueMesh | None = None
    ) -> None:
        self.scene, self.scales, self.models, self.mesh = scene, scales, models, mesh
        self.on: Names = frozenset(name for name, effect in EFFECTS.items() if effect.active(scene))
        own = models[self.on]
        self.comm = own.system.layout.comm
        later = scene.control is not None and scene.motion.drive == "motion"
        self.force = force_of_motion(scene, own) if later else None
        self.runs: dict[tuple[Names, bool], Displacements] = {}
        self.first: Trajectory = simulate(own, RunOptions())
        self.runs[self.shown(self.on, False), False] = displacements(own, self.first)

    def variant(self, on: Names) -> Scene:
        """The scene with exactly these effects on. Raises SceneError: its own validation refuses them together."""
        scene = self.scene
        for name in sorted(EFFECTS, key=lambda name: name in on):  # off first, to make room for the others
            if (name in on) != (name in self.on):
                switched = switch(scene, name, self.scales)
                if switched.other is None:
                    raise SceneError(switched.reason)
                scene = switched.other
        return scene

    def refusal(self, on: Names) -> str:
        """Why the scene does not allow exactly these effects; empty where it does."""
        try:
            self.variant(on)
        except SceneError as error:
            return str(error)
        return ""

    def model(self, on: Names) -> Model:
        """The model with exactly these effects on; one that is new is not kept. Collective."""
        if on in self.models:
            return self.models[on]
        gc.collect()
        return build(self.variant(on), comm=self.comm, mesh=self.mesh)

    def shown(self, on: Names, forced: bool) -> Names:
        """Those of the effects that a run can show: a motion that is prescribed feels no reaction.

        Nor does it feel the freedom to turn where it prescribes no turn: the load has zeros there. Under the force that
        would make the motion the hand turns by the reaction alone, for M_hand joins no turn to a shift.
        """
        motion = self.scene.motion
        if motion.drive == "force":
            return on
        turns = motion.csv is not None or any((motion.target or [])[self.scales.dimension :])
        if forced:
            return on if turns or "reaction" in on else on - {"rotation"}
        return on - ({"reaction"} if turns else {"reaction", "rotation"})

    def of(self, on: Names, forced: bool = False) -> Displacements:
        """Outputs with exactly these effects on. Collective. Raises SolverError: a solve failed."""
        key = self.shown(on, forced), forced
        if key not in self.runs:
            model = self.model(on)
            self.runs[key] = displacements(model, simulate(model, RunOptions(), self.force if forced else None))
        return self.runs[key]

    def change(self, a: Names, b: Names) -> Change:
        """Change between two sets of effects. Collective."""
        return compare(self.of(a), self.of(b))

    def control(self, a: Names, b: Names) -> float | None:
        """Change of the outputs when a force moves the hand; None where that is no question. Collective."""
        return None if self.force is None else compare(self.of(a, True), self.of(b, True)).outputs

    def alone(self, name: str) -> tuple[Change, float | None]:
        """Change by one effect switched in the scene; under a force too where no output changes. Collective."""
        other = self.on ^ {name}
        change = self.change(self.on, other)
        hidden = change.outputs <= self.scene.study.tolerance
        return change, self.control(self.on, other) if hidden else None

    def shows(self, a: Names, b: Names, tolerance: float) -> tuple[float, bool] | None:
        """A change of the outputs above the tolerance, and whether only a force brings it out. Collective."""
        if (change := self.change(a, b).outputs) > tolerance:
            return change, False
        control = self.control(a, b)
        return None if control is None or control <= tolerance else (control, True)


def check_elements(
    model: Model, trajectory: Trajectory | None, tolerance: float, mesh: TissueMesh | None = None
) -> Elements | None:
    """Run the scene with P2 when it has P1 and a ratio of Poisson at which P1 locks, else None. Collective.

    ``trajectory``: run of the model; None where it is made here.
    """
    nu = max(young_poisson(m.lam, m.mu)[1] for m in of_layers(model.system.materials))
    if model.scene.tissue.order != 1 or nu <= LOCKING + 1e-9:
        return None
    other = build(quadratic(model), comm=model.system.layout.comm, mesh=mesh)
    trajectory = simulate(model, RunOptions()) if trajectory is None else trajectory
    change = compare(displacements(model, trajectory), displacements(other, simulate(other, RunOptions())))
    needed = change.outputs > tolerance
    text = (
        f"Measured at nu = {nu:.4g}: on the same mesh tissue.order = 2 changes the outputs by "
        f"{percent(change.outputs)} and their deformation by {percent(change.deformation)}, "
        f"tolerance {percent(tolerance)}: "
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

    return model.scene.changed(edit)
