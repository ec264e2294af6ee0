"""Full and reduced model of the experiments at some values of the unknowns, and the reduced outputs near them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.errors import ResourceError, SceneError, raise_on_all_ranks
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import Model, Stopwatch
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import force_values, motion_table
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import states_of
from softgrasp.reduction.certified.training import second_order_basis
from softgrasp.reduction.gradient.reduced import sensitivities
from softgrasp.reduction.identify.data import Measurements, interpolation
from softgrasp.reduction.identify.responses import response_basis
from softgrasp.reduction.identify.unknowns import Unknown, assumed, materials_at, value_of
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.online import ReducedTrajectory, run
from softgrasp.reduction.reduce import project_scene
from softgrasp.reduction.system import EnergySystem

if TYPE_CHECKING:  # only fits with a certified model pay for it
    from softgrasp.reduction.certified.certificate import Bound

RADIUS = 0.7  # of log theta in a round: within a factor of two the basis of the round serves


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

    def largest_load(self, model: Model) -> Array:
        """Largest acceleration of the hand less that of free fall, (n_s,) [m/s2, rad/s2]."""
        inputs = self.own_inputs
        if "hand" in inputs:
            a = np.diff(inputs["hand"][1], axis=0) / self.dt
        else:
            a = np.linalg.solve(self.M_hand, inputs["force"].T).T
        return np.asarray(np.abs(a - model.system.fall).max(axis=0))

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
        with raise_on_all_ranks(system.layout.comm):  # a full disk must not leave the others waiting
            if system.layout.comm.rank == 0:
                _write_table(file, np.column_stack([times, places]))
        end = float(times[-1])
        steps = max(1, int(np.ceil(end / (scene.time_end / scene.time.steps) - 1e-9)))
        motion = scene.motion.model_copy(
            update={"profile": "csv", "csv": str(file.absolute()), "target": None, "drive": "motion"}
        )
        time = scene.time.model_copy(update={"steps": steps, "end": end})
        scene = scene.model_copy(update={"motion": motion, "time": time})
    output = scene.output.model_copy(update={"snapshots": "none"})
    return Experiment(data, scene.model_copy(update={"output": output}), system.layout.n_s, system.M_hand)


def _write_table(file: Path, table: Array) -> None:
    """Raises ResourceError: the folder of temporary files is full."""
    try:
        np.savetxt(file, table, delimiter=",", fmt="%.17g")
    except OSError as error:
        raise ResourceError(
            f"{file.parent}: the measured motion cannot be written there ({error.strerror}); free the disk, or name "
            "another folder in TMPDIR"
        ) from error


def same_motion(i: int, e: Experiment) -> int:
    """Key of the motion of the i-th experiment: all without a measured hand have that of the scene, -1."""
    return -1 if e.data.hand is None else i


def motions(experiments: Sequence[Experiment]) -> dict[int, Experiment]:
    """An experiment for each motion of the hand, by the key of the motion."""
    return {same_motion(i, e): e for i, e in enumerate(experiments)}


def moved_as(scene: Scene, e: Experiment) -> Scene:
    """A scene with the motion and the time grid of an experiment."""
    return scene.model_copy(update={"motion": e.scene.motion, "time": e.scene.time, "output": e.scene.output})


class Local(ABC):
    """A small model of the experiments for values in a range, and the full one at each of them.

    Attributes:
        model: full model.
        unknowns: what is fitted.
        whole_range: whether no other small model would serve better elsewhere, so that one round is enough.
    """

    whole_range = False

    def __init__(self, model: Model, unknowns: Sequence[Unknown]) -> None:
        self.model, self.unknowns = model, unknowns
        self._lacks: dict[int, Array] = {}

    def full(self, values: Array) -> Model:
        """The full model at values."""
        system = self.model.system.with_materials(materials_at(self.model.system.materials, self.unknowns, values))
        return replace(self.model, system=system, watch=Stopwatch(system.layout.comm), accuracy=None)

    @property
    @abstractmethod
    def size(self) -> int:
        """Dimension of the small model, the hand's 2 n_s included."""

    def limits(self, theta: Array) -> tuple[Array, Array]:
        """Least and largest log theta (k,) of a round that starts at one."""
        return theta - RADIUS, theta + RADIUS

    @abstractmethod
    def system(self, values: Array) -> Any:
        """Arguments of the next two methods at values. Raises ModelError: they are no material."""

    @abstractmethod
    def small_run(self, small: Any, experiment: Experiment, refined: int = 1) -> ReducedTrajectory:
        """Small run of an experiment; ``refined``: steps in place of each. Raises ReductionError, SolverError."""

    def run(self, small: Any, experiment: Experiment, refined: int = 1) -> ReducedTrajectory:
        """The same with what it lacks at some values, see :meth:`make_exact`. Raises ReductionError, SolverError."""
        found, lack = self.small_run(small, experiment, refined), self._lacks.get(id(experiment))
        if lack is None:
            return found
        if refined > 1:
            lack = interpolation(found.times, experiment.dt, experiment.scene.time.steps) @ lack
        return replace(found, outputs=found.outputs + lack)

    def make_exact(self, values: Array, experiments: Sequence[Experiment], outputs: dict[int, Array]) -> None:
        """Add what small runs lack of full ones at some values to all, y(theta) = y_N(theta) + [y_h - y_N](theta_0).

        ``outputs``: those of the full runs, by :func:`motions`.
        """
        small, lacks = self.system(values), dict[int, Array]()
        for i, e in motions(experiments).items():
            lacks[i] = outputs[i] - self.small_run(small, e).outputs
        self._lacks = {id(e): lacks[same_motion(i, e)] for i, e in enumerate(experiments)}

    @abstractmethod
    def slopes(
        self, values: Array, by: Sequence[Unknown], small: Any, answer: ReducedTrajectory, experiment: Experiment
    ) -> Array:
        """dy/dlog of some parameters of a run at values, (parameters, steps + 1, p)."""

    def bound(self, values: Array, experiment: Experiment) -> Bound | None:
        """Error of the outputs of a run, (steps + 1, p) [m, rad], as a certificate has it; None where there is none."""
        return None

    def displacements(self, values: Array, answer: ReducedTrajectory, count: int) -> Array | None:
        """Displacements of the tissue against the hand at some instants, local rows (n_local, count) [m], or None."""
        return None

    def rests_on(self) -> tuple[Unknown, ...]:
        """Parameters that are not fitted, for which :meth:`slopes` has derivatives."""
        return assumed(self.model, self.unknowns)


class Fixed(Local):
    """A linear model in a fixed basis, A = A_0 + sum_k theta_k A_k for all values."""

    rom: ReducedModel

    @property
    def size(self) -> int:
        """Dimension of the small model, the hand's 2 n_s included."""
        return self.rom.N

    def at(self, values: Array) -> tuple[LayerMaterial, ...]:
        """Materials at values."""
        return materials_at(self.model.system.materials, self.unknowns, values)

    def system(self, values: Array) -> EnergySystem:
        """Reduced system at values. Raises ModelError: they are no material."""
        return self.rom.at(self.at(values))

    def small_run(self, small: EnergySystem, experiment: Experiment, refined: int = 1) -> ReducedTrajectory:
        """Reduced run of an experiment; ``refined``: steps in place of each. Raises ReductionError: see online.run."""
        inputs = experiment.own_inputs if refined == 1 else experiment.inputs(refined)
        start = small.equilibrium() if experiment.scene.time.start == "equilibrium" else None
        return run(small, x0=start, **inputs)

    def slopes(
        self,
        values: Array,
        by: Sequence[Unknown],
        small: EnergySystem,
        answer: ReducedTrajectory,
        experiment: Experiment,
    ) -> Array:
        """dy/dlog of some parameters of a run at values, (parameters, steps + 1, p)."""
        own = self.at(values)
        others = [self.rom.at(materials_at(own, [u], np.array([2 * value_of(own, u)]))) for u in by]
        return sensitivities(small, others, answer, driven=experiment.driven)

    def some(self, answer: ReducedTrajectory, count: int) -> Array:
        """Reduced states at some instants, (count, N)."""
        return np.asarray(answer.x[np.unique(np.linspace(0, len(answer.x) - 1, count).round().astype(int))])


class Near(Fixed):
    """A model in modes and static responses at some values, in modes alone without experiments; exact on request."""

    def __init__(
        self,
        model: Model,
        unknowns: Sequence[Unknown],
        values: Array,
        N: int,
        experiments: Sequence[Experiment] = (),
        exact: bool = False,
    ) -> None:
        super().__init__(model, unknowns)
        near, hand = self.full(values), 2 * model.system.layout.n_s
        if experiments:
            load = np.array([e.largest_load(near) for e in experiments]).max(axis=0)
            basis = second_order_basis(near, response_basis(near, unknowns, load, (N - hand) // 2))
        else:
            basis = make_basis("craig_bampton", states_of(near.system), N)
        self.rom = project_scene(basis, near)
        if exact:
            runs = {i: simulate(replace(near, scene=e.scene)).outputs for i, e in motions(experiments).items()}
            self.make_exact(values, experiments, runs)

    def displacements(self, values: Array, answer: ReducedTrajectory, count: int) -> Array | None:
        """Displacements of the tissue against the hand at some instants, local rows (n_local, count) [m]."""
        return self.rom.reconstruct(self.system(values), self.some(answer, count).T)[0]


def check_identifiable(model: Model) -> None:
    """Raise SceneError where the scene cannot be fitted."""
    model.scene.refuse_contact("identify")
    model.scene.refuse_frame("identify")
