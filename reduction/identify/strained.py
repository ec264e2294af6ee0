"""Fits at finite strain: a hyper-reduced model of full runs around some values, made exact at these values.

The full run at the values is one of those that train the model, so that this costs nothing; what it leaves of the error
of the reduction grows with the distance from them, and falls as the rounds settle.

Where no such model has a run, as on tiny cells beside the ends of the hand, the linear one takes its place with
what it lacks of one full run at finite strain: exact at the values of the round, with slopes of linear elasticity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from softgrasp.fem.errors import SceneError, SolverError
from softgrasp.fem.material import LayerMaterial
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.strain.laws import LawName
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.identify.near import RADIUS, Experiment, Local, Near, motions
from softgrasp.reduction.identify.unknowns import Unknown, assumed, materials_at, value_of
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.parameters import thinned
from softgrasp.reduction.replay import FullRun, full_run
from softgrasp.reduction.strain.model import StrainModel
from softgrasp.reduction.strain.training import train

Materials = tuple[LayerMaterial, ...]
REACH = (0.3, 0.15, 0.07)  # of log theta in a round; the next one where a body of the round folds
SLOPE_STEP = 2e-5  # of log theta in a difference: runs carry 1e-9, so that slopes carry 1e-4 with curvature
STATES = 200  # of each training run
GROWTH, MOST = 1.5, 3  # of the columns where a reduced run folds that the full one does not, and how often
STIFF = ("mu", "lambda")


def strained_model(model: Model, law: LawName) -> Model:
    """The model with a hyperelastic law, on the same mesh and at the same materials. Collective.

    Raises SceneError: finite strain does not go with the scene.
    """
    scene = model.scene
    if scene.effects.rotation:
        raise SceneError("effects.rotation does not go with finite strain")

    def edit(table: dict[str, object]) -> None:
        effects = table.setdefault("effects", {})
        assert isinstance(effects, dict)
        effects["finite_strain"] = {"law": law}

    other = build(scene.changed(edit), comm=model.system.layout.comm, mesh=model.space.mesh)
    return replace(other, system=other.system.with_materials(model.system.materials))


def check_strained(model: Model, names: Sequence[Unknown], experiments: Sequence[Experiment]) -> None:
    """Raise SceneError where a fit at finite strain has no reduced model."""
    name = model.scene.name
    if any(not e.driven for e in experiments):
        raise SceneError(
            f"scene '{name}': at finite strain identify needs the motion of the hand, and a force moves it; set "
            "motion.drive = 'motion' or measure the hand as q_x"
        )
    if any(u.kind == "rho" for u in names):
        raise SceneError("--fit rho: at finite strain identify fits mu, lambda and beta; weigh the body")


class Strained(Local):
    """A hyper-reduced model at finite strain of full runs at some values and around them."""

    def __init__(
        self, model: Model, unknowns: Sequence[Unknown], values: Array, N: int, experiments: Sequence[Experiment]
    ) -> None:
        super().__init__(model, unknowns)
        moves = motions(experiments)
        for i, reach in enumerate(REACH):
            try:
                self.reach, runs = reach, [self._around(values, e, reach) for e in moves.values()]
                break
            except SolverError:
                if i == len(REACH) - 1:
                    raise
        self.rom = self._reduced([run for each in runs for run in each], N)
        full = {i: each[0].trajectory.outputs for i, each in zip(moves, runs, strict=True)}
        self.make_exact(values, experiments, full)

    @property
    def size(self) -> int:
        """Dimension of the small model, the hand's 2 n_s included."""
        return self.rom.N

    def _around(self, values: Array, e: Experiment, reach: float) -> list[FullRun]:
        """Full runs at the values and at stiffnesses on both sides of them. Collective."""
        output = e.scene.output.model_copy(update={"snapshots": "memory"})
        scene, places = e.scene.model_copy(update={"output": output}), [values]
        for i, u in enumerate(self.unknowns):
            for sign in (-1, 1) if u.kind in STIFF else ():
                places.append(values * np.exp(sign * reach * np.eye(len(values))[i]))
        result = []
        for place in places:
            at = replace(self.full(place), scene=scene)
            run = full_run(at, simulate(at))
            result.append(replace(run, snapshots=thinned(run.snapshots, STATES)))
        return result

    def _reduced(self, runs: list[FullRun], N: int) -> StrainModel:
        """The smallest model of N columns or more whose runs do not fold. Collective."""
        for i in range(MOST):
            try:
                return train(runs[0].model, runs, N).reduce(N)
            except BasisError as error:
                if error.most is None:
                    raise
                return train(runs[0].model, runs, error.most).reduce(error.most)
            except SolverError:
                if i == MOST - 1:
                    raise
                N = 2 * int(np.ceil(GROWTH * N / 2))
        raise AssertionError

    def limits(self, theta: Array) -> tuple[Array, Array]:
        """Those of the training, and of the damping the usual ones."""
        reach = np.array([self.reach if u.kind in STIFF else RADIUS for u in self.unknowns])
        return theta - reach, theta + reach

    def system(self, values: Array) -> Materials:
        """Materials at values."""
        return materials_at(self.model.system.materials, self.unknowns, values)

    def small_run(self, small: Materials, experiment: Experiment, refined: int = 1) -> ReducedTrajectory:
        """Reduced run. Raises SolverError: the body folds."""
        inputs = experiment.own_inputs if refined == 1 else experiment.inputs(refined)
        system = self.rom.at(inputs["dt"], small, outside=True)
        start = system.equilibrium() if experiment.scene.time.start == "equilibrium" else None
        return system.run(inputs["hand"], a0=start)

    def slopes(
        self, values: Array, by: Sequence[Unknown], small: Materials, answer: ReducedTrajectory, experiment: Experiment
    ) -> Array:
        """dy/dlog of some parameters by differences, (parameters, steps + 1, p)."""
        result = np.empty((len(by), *answer.outputs.shape))
        for i, u in enumerate(by):
            other = self.run(_changed(small, u, float(np.exp(SLOPE_STEP))), experiment)
            result[i] = (other.outputs - answer.outputs) / SLOPE_STEP
        return result

    def rests_on(self) -> tuple[Unknown, ...]:
        """Parameters that are not fitted; of the densities only their common factor."""
        every = tuple(range(len(self.model.system.materials)))
        return (*(u for u in assumed(self.model, self.unknowns) if u.kind != "rho"), Unknown("rho", "rho", every))


class Corrected(Local):
    """The linear small model with what it lacks of the full run at finite strain at some values.

    y(theta) = y_N(theta) + [y_h - y_N](theta_0); rounds settle where J' (y_h - data) = 0 with the J of linear
    elasticity, which lies within the noise of the best values where the law holds.

    Args:
        model: at finite strain.
        linear: the same without.
    """

    def __init__(
        self,
        model: Model,
        linear: Model,
        unknowns: Sequence[Unknown],
        values: Array,
        N: int,
        experiments: Sequence[Experiment],
    ) -> None:
        super().__init__(model, unknowns)
        self.near = Near(linear, unknowns, values, N, experiments)
        full = self.full(values)
        runs = {i: simulate(replace(full, scene=e.scene)).outputs for i, e in motions(experiments).items()}
        self.make_exact(values, experiments, runs)

    @property
    def size(self) -> int:
        """Dimension of the small model, the hand's 2 n_s included."""
        return self.near.size

    def limits(self, theta: Array) -> tuple[Array, Array]:
        """What a round may move: less than the linear model alone may, for what it lacks changes too."""
        return theta - REACH[0], theta + REACH[0]

    def system(self, values: Array) -> Any:
        """Linear reduced system at values. Raises ModelError: they are no material."""
        return self.near.system(values)

    def small_run(self, small: Any, experiment: Experiment, refined: int = 1) -> ReducedTrajectory:
        """Linear reduced run."""
        return self.near.small_run(small, experiment, refined)

    def slopes(
        self, values: Array, by: Sequence[Unknown], small: Any, answer: ReducedTrajectory, experiment: Experiment
    ) -> Array:
        """dy/dlog of some parameters by linear elasticity, (parameters, steps + 1, p)."""
        return self.near.slopes(values, by, small, answer, experiment)


def _changed(materials: Materials, u: Unknown, factor: float) -> Materials:
    """Materials with one parameter times a factor; a common factor of all densities divides the stiffness."""
    if u.kind == "rho":
        return tuple(replace(m, lam=m.lam / factor, mu=m.mu / factor) for m in materials)
    return materials_at(materials, [u], np.array([factor * value_of(materials, u)]))
