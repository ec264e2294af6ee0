"""What an effect changes: the outputs of two runs against each other, alone and beside other effects."""

from __future__ import annotations

import gc
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import Force, motion_table
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.run.trajectory import Trajectory
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.effects.result import Change, Company
from softgrasp.study.effects.switch import Scales, switch

Names = frozenset[str]
Changes = dict[str, tuple[Change, float | None]]  # of the outputs, and under a force


@dataclass(frozen=True)
class Shown:
    """Where a run takes its outputs, angles of the hand left out."""

    places: Array  # displacements, (steps + 1, outputs, d) [m]
    rigid: Array  # their share of the hand's rigid motion [m]


def shown(model: Model, run: Trajectory) -> Shown:
    """Displacements of the outputs of a run."""
    d, control = model.system.layout.dimension, model.scene.control
    kinds = [o.kind for o in control.outputs] if control is not None and control.outputs else ["node"]
    widths = [model.system.layout.n_s if kind == "hand" else d for kind in kinds]
    starts = np.cumsum([0, *widths[:-1]])
    places, rigid = (
        np.stack([values[:, at : at + d] for at in starts], axis=1) for values in (run.outputs, run.outputs_rigid)
    )
    return Shown(places, rigid)


def compare(a: Shown, b: Shown) -> Change:
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


class Experiments:
    """Runs of one scene with any set of its effects on, each made once. Collective.

    Where a control problem lets a force move the hand that the run moves by itself, every run has a second one under
    the force that would make that motion. ``models`` are built already, the scene's own among them.
    """

    def __init__(self, scene: Scene, scales: Scales, models: dict[Names, Model]) -> None:
        self.scene, self.scales, self.models = scene, scales, models
        self.on: Names = frozenset(name for name, effect in EFFECTS.items() if effect.active(scene))
        own = models[self.on]
        self.comm = own.system.layout.comm
        later = scene.control is not None and scene.motion.drive == "motion"
        self.force = force_of_motion(scene, own) if later else None
        self.runs: dict[tuple[Names, bool], Shown] = {}
        self.first: Trajectory = simulate(own, RunOptions())
        self.runs[self.on, False] = shown(own, self.first)

    def model(self, on: Names) -> Model:
        """The model with exactly these effects on; one that is new is not kept. Collective."""
        if on in self.models:
            return self.models[on]
        scene = self.scene
        for name in EFFECTS:
            if (name in on) != (name in self.on):
                other = switch(scene, name, self.scales).other
                scene = scene if other is None else other
        gc.collect()
        return build(scene, comm=self.comm)

    def of(self, on: Names, forced: bool = False) -> Shown:
        """Outputs with exactly these effects on. Collective. Raises SolverError: a solve failed."""
        if (on, forced) not in self.runs:
            model = self.model(on)
            self.runs[on, forced] = shown(model, simulate(model, RunOptions(), self.force if forced else None))
        return self.runs[on, forced]

    def change(self, a: Names, b: Names) -> Change:
        """Change between two sets of effects. Collective."""
        return compare(self.of(a), self.of(b))

    def control(self, a: Names, b: Names) -> float | None:
        """Change of the outputs when a force moves the hand; None where that is no question. Collective."""
        return None if self.force is None else compare(self.of(a, True), self.of(b, True)).outputs

    def alone(self, name: str) -> tuple[Change, float | None]:
        """Change by one effect switched in the scene; under a force too where the run does not show it. Collective."""
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


@dataclass(frozen=True)
class Together:
    """All effects judged again."""

    on: tuple[str, ...]  # effects that are advised, those that cannot be tried as they are
    company: dict[str, Company]  # of each effect that was tried


Joined = dict[str, tuple[tuple[str, ...], bool, float, bool]]


def judge_together(runs: Experiments, tried: tuple[str, ...], needed: Names, tolerance: float) -> Together:
    """Judge every effect again with all advised effects on, until no further one shows. Collective.

    An effect that does not show in the scene as it is joins when it shows beside those advised so far; then two that
    show only as a pair do. ``tried`` can be switched; ``needed`` of them show in the scene as it is.
    """
    on = needed | (runs.on - frozenset(tried))
    joined: Joined = {}
    while new := _singles(runs, tried, on, tolerance) or _pair(runs, tried, on, tolerance):
        on |= frozenset(new)
        joined |= new
    company = {
        name: Company(
            runs.change(on, on ^ {name}), runs.control(on, on ^ {name}), *joined.get(name, ((), False, 0.0, False))
        )
        for name in tried
    }
    return Together(tuple(name for name in EFFECTS if name in on), company)


def _singles(runs: Experiments, tried: tuple[str, ...], on: Names, tolerance: float) -> Joined:
    """Effects that show beside those that are on, with the partners that bring them out. Collective."""
    joined: Joined = {}
    for name in tried:
        change = None if name in on else runs.shows(on, on | {name}, tolerance)
        if change is None:
            continue
        others = [p for p in tried if p != name and (p in on) != (p in runs.on)]
        near = [p for p in others if runs.shows(runs.on ^ {p}, runs.on ^ {p, name}, tolerance)]
        joined[name] = (tuple(near or others), False, *change)
    return joined


def _pair(runs: Experiments, tried: tuple[str, ...], on: Names, tolerance: float) -> Joined:
    """The first two effects that show together and not one by one. Collective."""
    for a, b in combinations([name for name in tried if name not in on], 2):
        change = runs.shows(on, on | {a, b}, tolerance)
        if change is not None and {a, b} <= runs.on:
            return {a: ((b,), True, *change)}
        if change is not None:
            return {a: ((b,), False, *change), b: ((a,), False, *change)}
    return {}
