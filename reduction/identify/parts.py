"""Errors of the reduced outputs over time by their causes, and what mends those of mesh and time step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem.accuracy.adapt import estimated
from softgrasp.fem.errors import MeshError, ResourceError, SceneError
from softgrasp.fem.model.build import MeshEstimate
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.identify.fit import Misfit
from softgrasp.reduction.identify.near import Experiment, Local, same_motion
from softgrasp.reduction.online import ReducedTrajectory

if TYPE_CHECKING:
    from softgrasp.reduction.certified.certificate import Bound

STEP_SHARE = 4 / 3  # error of a midpoint step over its difference to half the step
MARGIN = 0.5  # of what the error of mesh or step may be to stay below the noise
LARGE = 0.1  # error of the outputs above which parts of the error are no small changes, and say little about a goal
COARSEST, FINEST = 1e-2, 1e-5  # tolerances that a refinement can take


@dataclass(frozen=True)
class OutputErrors:
    """Errors of the reduced outputs of each experiment over time, (steps + 1, outputs) each [m, rad]."""

    signed: dict[str, list[Array] | None]  # truth less reduced outputs by cause; None where it is not known
    bounds: list[Bound] | None  # of the reduction, instead of its signed error
    estimate: MeshEstimate | None  # that of the mesh, of the first experiment; None where there is none

    def through(self, inverse: Array, misfit: Misfit, p: Array) -> dict[str, Array | None]:
        """Error of what is fitted by cause, (k,), None where it is not known: J+ delta, or at most |J+| bound.

        ``inverse``: J+ of the logarithms of the values or of the nuisances, (k, m).
        """
        parts = {
            name: None if error is None else inverse @ misfit.together(error, p) for name, error in self.signed.items()
        }
        if self.bounds is not None:
            parts["reduction"] = np.abs(inverse) @ misfit.bounds([b.values for b in self.bounds], p)
        return parts

    def kinds(self, law: str) -> dict[str, str]:
        """How each is known, in words."""
        linear = "" if law == "linear" else " by linear elasticity at the values"
        known = "measured by a full run"
        if self.bounds is not None:
            known = "proved, at most" if all(b.kind == "proof" for b in self.bounds) else "at most, estimated"
        return {"mesh": f"estimated{linear}", "time step": "estimated", "reduction": known}


def errors_of_outputs(
    near: Local, values: Array, answers: Sequence[ReducedTrajectory], experiments: Sequence[Experiment]
) -> OutputErrors:
    """Those at some values, and the estimate of the mesh. Collective.

    The part of the reduction is measured by a full run at the values or bounded by a certificate, those of mesh and
    time step are estimates; that of the mesh is None where there is none.
    """
    full, small = near.full(values), near.system(values)
    estimates: dict[int, MeshEstimate] = {}
    runs: dict[int, Array] = {}
    found: dict[str, list[Array] | None] = {"mesh": [], "time step": [], "reduction": []}
    bounds: list[Bound] = []
    for i, (e, answer) in enumerate(zip(experiments, answers, strict=True)):
        same = same_motion(i, e)
        model, bound = replace(full, scene=e.scene), near.bound(values, e)
        if bound is not None:
            bounds.append(bound)
        elif same not in runs:
            runs[same] = simulate(model).outputs
        if same not in estimates:
            try:
                estimates[same] = estimated(model)
            except (SceneError, MeshError, ResourceError):  # no finer mesh can be made
                found["mesh"] = None
        halved = near.run(small, e, refined=2).outputs[::2]
        for name, part in (
            ("mesh", estimates[same].delta if same in estimates else None),
            ("time step", STEP_SHARE * (halved - answer.outputs)),
            ("reduction", None if same not in runs else runs[same] - answer.outputs),
        ):
            kept = found[name]
            if kept is not None and part is not None:
                kept.append(part)
    if bounds:
        found["reduction"] = None
    return OutputErrors(found, bounds or None, next(iter(estimates.values()), None))


def finer_tolerance(mesh: Array, noise: Array, estimate: MeshEstimate) -> float:
    """Tolerance of a mesh whose part stays below the noise, of one digit; the first one for a mesh of large errors."""
    if estimate.estimate > LARGE:
        return COARSEST
    goal = MARGIN * estimate.estimate / float((np.abs(mesh) / noise).max())
    goal = min(max(goal, FINEST), COARSEST)
    power = 10.0 ** np.floor(np.log10(goal) + 1e-9)
    return float(f"{np.floor(goal / power + 1e-9) * power:.0e}")


def finer_steps(step: Array, noise: Array, steps: int) -> int:
    """Time steps whose part stays below the noise, which falls with their square; of two digits."""
    goal = steps * float((np.abs(step) / noise).max() / MARGIN) ** 0.5
    power = 10.0 ** (np.floor(np.log10(goal)) - 1)
    return int(np.ceil(goal / power) * power)


def finer_scene(scene: Scene, tolerance: float | None, steps: int | None, time_error: float) -> Scene:
    """The scene with a tolerance of its mesh and the steps that carry it, or with more steps.

    ``time_error``: estimated error of its own steps in the outputs, relative.
    """
    least = max(steps or 0, scene.time.steps)
    if tolerance is not None and time_error > MARGIN * tolerance:  # else another mesh may refuse its steps
        least = max(least, int(scene.time.steps * (time_error / (MARGIN * tolerance)) ** 0.5) + 1)

    def edit(table: dict[str, Any]) -> None:
        table["time"]["steps"] = least
        if tolerance is not None:
            tissue = table["tissue"]
            tissue["order"] = max(2, tissue["order"])
            tissue["refine"] = {**tissue.get("refine", {}), "tolerance": tolerance}

    return scene.changed(edit)
