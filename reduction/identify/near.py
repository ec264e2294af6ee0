"""Full and reduced model of the experiments at some values of the unknowns, and the reduced outputs near them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import force_values, motion_table
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import states_of
from softgrasp.reduction.gradient import sensitivities
from softgrasp.reduction.identify.data import Measurements, interpolation
from softgrasp.reduction.identify.unknowns import Unknown, materials_at, value_of
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory, run
from softgrasp.reduction.reduce import project_scene
from softgrasp.reduction.system import EnergySystem


@dataclass(frozen=True)
class Experiment:
    """Measurements with the scene that they were made in."""

    data: Measurements  # what was measured
    scene: Scene  # with the measured motion of the hand, where there is one
    n_s: int  # degrees of freedom of the hand
    M_hand: Array  # mass of the hand, (n_s, n_s) [kg, kg m2]

    @property
    def driven(self) -> bool:
        """Whether the motion of the hand is prescribed."""
        return self.scene.motion.drive == "motion"

    @property
    def dt(self) -> float:
        """Time step [s]."""
        return self.scene.time_end / self.scene.time.steps

    def inputs(self, refined: int = 1) -> dict[str, Any]:
        """Keywords of :func:`softgrasp.reduction.online.run`; ``refined``: steps in place of each."""
        if refined > 1:
            time = self.scene.time.model_copy(update={"steps": refined * self.scene.time.steps})
            return replace(self, scene=self.scene.model_copy(update={"time": time})).inputs()
        if not self.driven:
            return {"dt": self.dt, "force": force_values(self.scene, self.n_s, self.M_hand)}
        table = motion_table(self.scene, self.n_s)
        return {"dt": self.dt, "hand": (table.q, table.v)}

    @cached_property
    def own_inputs(self) -> dict[str, Any]:
        """Those on its own grid."""
        return self.inputs()

    def weights(self, shift: float = 0.0) -> Any:
        """W of outputs at the instants of the data, moved by a time shift [s]."""
        return interpolation(self.data.times + shift, self.dt, self.scene.time.steps)

    @cached_property
    def own_weights(self) -> Any:
        """Those without a shift."""
        return self.weights()


def experiment(model: Model, data: Measurements, file: Path) -> Experiment:
    """The scene of a model under the measured motion, which ``file`` holds, of this experiment alone. Collective.

    Raises SceneError: the measured motion does not fit.
    """
    scene, system = model.scene, model.system
    if data.hand is not None:
        if system.two_way and scene.motion.drive == "force":
            raise SceneError(
                f"{data.name}: the scene gives the force on the hand, so its motion q_* cannot be given too"
            )
        times, places = data.hand
        if system.layout.comm.rank == 0:
            np.savetxt(file, np.column_stack([times, places]), delimiter=",", fmt="%.17g")
        system.layout.comm.Barrier()
        end = float(times[-1])
        steps = max(1, int(np.ceil(end / (scene.time_end / scene.time.steps) - 1e-9)))
        motion = scene.motion.model_copy(
            update={"profile": "csv", "csv": str(file.absolute()), "target": None, "drive": "motion"}
        )
        time = scene.time.model_copy(update={"steps": steps, "end": end})
        scene = scene.model_copy(update={"motion": motion, "time": time})
    output = scene.output.model_copy(update={"snapshots": "none"})
    return Experiment(data, scene.model_copy(update={"output": output}), system.layout.n_s, system.M_hand)


class Near:
    """Full model at some values, a Craig-Bampton model of it, and runs of that at values near them.

    A = A_0 + sum_k theta_k A_k of the reduced model holds for all values; its basis is that of ``values``.
    """

    def __init__(self, model: Model, unknowns: Sequence[Unknown], values: Array, N: int) -> None:
        self.model, self.unknowns = model, unknowns
        near = self.full(values)
        self.rom: ReducedModel = project_scene(make_basis("craig_bampton", states_of(near.system), N), near)

    def full(self, values: Array) -> Model:
        """The full model at values."""
        system = self.model.system.with_materials(materials_at(self.model.system.materials, self.unknowns, values))
        return replace(self.model, system=system, watch=Stopwatch(system.layout.comm), accuracy=None)

    def system(self, values: Array) -> EnergySystem:
        """Reduced system at values. Raises ModelError: they are no material."""
        return self.rom.at(materials_at(self.rom.materials, self.unknowns, values))

    def run(self, small: EnergySystem, experiment: Experiment, refined: int = 1) -> ReducedTrajectory:
        """Reduced run of an experiment; ``refined``: steps in place of each. Raises ReductionError: see online.run."""
        inputs = experiment.own_inputs if refined == 1 else experiment.inputs(refined)
        start = small.equilibrium() if experiment.scene.time.start == "equilibrium" else None
        return run(small, x0=start, **inputs)

    def slopes(
        self, values: Array, by: Sequence[Unknown], small: EnergySystem, answer: ReducedTrajectory, driven: bool
    ) -> Array:
        """dy/dlog of some parameters of a run at values, (parameters, steps + 1, p)."""
        own = materials_at(self.rom.materials, self.unknowns, values)
        others = [self.rom.at(materials_at(own, [u], np.array([2 * value_of(own, u)]))) for u in by]
        return sensitivities(small, others, answer, driven=driven)


def check_identifiable(model: Model) -> None:
    """Raise SceneError where the scene cannot be fitted."""
    scene = model.scene
    scene.refuse_contact("identify")
    if scene.effects.finite_strain is not None:
        raise SceneError(
            f"scene '{scene.name}': identify fits linear elasticity, and effects.finite_strain is on; take --set "
            "effects.finite_strain=false"
        )
