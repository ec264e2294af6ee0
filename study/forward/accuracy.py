"""How far a result is from that of an infinitely fine mesh and step: as numbers and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from softgrasp.fem import Scene, SceneError, SoftgraspError, estimated
from softgrasp.fem.accuracy.price import affordable, plans
from softgrasp.study.report import percent

if TYPE_CHECKING:
    from softgrasp.fem.model.build import MeshEstimate, Model
    from softgrasp.fem.run.states.trajectory import Trajectory

NOT_LINEAR = "The error of mesh and time step is estimated for linear elasticity only"


def check_estimated(scene: Scene) -> None:
    """Raise SceneError for finite strain, or the frame of a turning hand, of which no error is estimated."""
    scene.refuse_frame("--certify")
    if scene.effects.finite_strain is not None:
        raise SceneError(f"{NOT_LINEAR}: leave out --certify, or set effects.finite_strain to false")


def estimate_error(
    model: Model, budget: float | None = None, cheapest: bool = False
) -> tuple[MeshEstimate | None, str]:
    """The estimate of a model's mesh, or why there is none. Collective.

    Args:
        budget: seconds of counted work (:mod:`softgrasp.fem.accuracy.price`) that it may take; None: any.
        cheapest: rather the cheapest than the best way within the budget.
    """
    if model.system.points is not None:  # the small models are of linear elasticity
        return None, f"{NOT_LINEAR}; with effects.finite_strain compare with a finer mesh and more steps."
    if model.system.frame is not None:
        return None, f"{NOT_LINEAR} and small angles; with effects.frame compare with a finer mesh and more steps."
    if model.accuracy is not None:
        return model.accuracy, ""
    plan = affordable(model, math.inf if budget is None else budget, cheapest)
    if plan is None:
        least = min(plan.seconds for plan in plans(model))
        return None, f"The error of the mesh is not estimated: that would take about {least:.2g} s; --certify does it."
    try:
        return estimated(model, **plan.how), ""
    except (SoftgraspError, np.linalg.LinAlgError) as error:
        return None, f"The error of the mesh could not be estimated: {error}"


@dataclass(frozen=True)
class AccuracyReport:
    """What a run reports of its error; empty where none was estimated."""

    keys: Mapping[str, Any] = field(default_factory=dict)  # of result.json: ``mesh_error`` and ``time_error``
    errors: Sequence[str] = ()  # the errors in a sentence
    warnings: Sequence[str] = ()  # one sentence each


def accuracy_report(result: MeshEstimate | None, run: Trajectory) -> AccuracyReport:
    """The estimate of a run's error as numbers and sentences."""
    if result is None:
        return AccuracyReport()
    keys = {
        "estimate": result.estimate,
        "bound": result.bound,
        "corrected": None if result.by == "coarser" else result.corrected(run.outputs)[-1].tolist(),
        "omega": list(result.omega),
        "passes": result.passes,
        "n_e": result.n_e,
        "compared_with": {"by": result.by, "n_e": result.finer},
        "zone_shift": result.shift,
        "tolerance": result.tolerance,
        "reached": result.tolerance is None or (not result.obstacle and result.estimate <= result.tolerance),
        "seconds": result.seconds,
    }
    error, bound = percent(result.estimate), percent(result.bound)
    where = "on this mesh"
    if result.by == "coarser":
        where = "as extrapolated from coarser cells (simulate --certify estimates it on these)"
    errors = [
        f"The error of the deformation is about {error} {where}, with a bound of {bound}, and about "
        f"{percent(result.time_error)} by the time step."
    ]
    if result.offer is not None and result.estimate > result.offer[0]:
        goal, n_e = result.offer
        errors.append(
            f"An error of {percent(goal)} needs n_e = {n_e}, by tissue.refine.tolerance = {goal:g} and "
            "tissue.order = 2."
        )
    warnings = []
    if result.obstacle:
        sure = "not reached" if result.estimate > (result.tolerance or 0.0) else "not certain to be reached"
        warnings.append(
            f"tissue.refine.tolerance = {result.tolerance:g} is {sure}: the error of the deformation is about {error} "
            f"(bound {bound}) at n_e = {result.n_e}, since {result.obstacle}."
        )
    if result.shift > 0:
        warnings.append(
            f"The contact zone ends {result.shift:.3g} m beside the edge of contact.box, because its facets count by "
            "their midpoints; [tissue.refine] makes mesh lines meet that edge."
        )
    return AccuracyReport({"mesh_error": keys, "time_error": result.time_error}, errors, warnings)
