"""Where to put markers, and which motion to make, before anything is measured.

With J_i = dy_i/dlog theta / sigma of a marker i the information of some markers is the sum of F_i = J_i'J_i, and the
standard deviations of log theta are the roots of diag (sum F_i)^-1. Markers are chosen for the largest determinant of
the sum: the smallest volume of the ellipsoid of errors.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from softgrasp.fem.errors import SceneError, shortened
from softgrasp.fem.model.build import Model
from softgrasp.fem.model.surface import make_surface
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.shown import Card, Shown, percent
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.near import Near, check_identifiable, experiment
from softgrasp.reduction.identify.optimal import choose, deviations, ellipsoid, unseen_directions
from softgrasp.reduction.identify.unknowns import Unknown, parse_unknowns, value_of
from softgrasp.reduction.identify.verdict import direction_in_words

MOST_CANDIDATES = 80  # that a boundary of many nodes is thinned to


@dataclass(frozen=True)
class MotionPlan:
    """One motion of the family with its best markers."""

    motion: dict[str, Any]  # keys of [motion] that differ from the scene's
    chosen: tuple[int, ...]  # numbers of the candidates, the best first
    deviations: Array  # of the parameters with the first j of them, relative, (markers, k)
    own: Array  # of the parameters with the outputs of the scene, relative, (k,)
    by_one: Array  # of the parameters with each candidate alone, relative, (candidates, k)
    alone: Array  # size of the errors with each candidate alone, det(F)^(-1/2k), (candidates,) [1]
    size: float  # of the errors with all its markers, det(F)^(-1/2k): what the motions are ranked by [1]
    hidden: tuple[str, ...]  # combinations of the parameters that its markers do not determine, in words


@dataclass(frozen=True, repr=False)
class SuggestedMarkers(Shown):
    """Markers and a motion that determine a material best; made by :func:`suggest_markers`."""

    unknowns: tuple[Unknown, ...]
    """Names and units of what is to be fitted, (k,)."""
    values: Array
    """Values at which the errors hold, those of the model, (k,) [Pa, kg/m3, s]."""
    points: Array
    """Places of all candidates on the boundary, (candidates, d) [m]."""
    motions: tuple[MotionPlan, ...]
    """Each motion with its markers, the best first."""
    scene: Scene
    """The scene with the best motion, and the chosen markers as its outputs m1, m2, .."""

    @property
    def best(self) -> Array:
        """Places of the chosen markers for the best motion, the best first, (markers, d) [m]."""
        return np.asarray(self.points[list(self.motions[0].chosen)])

    def card(self) -> Card:
        """Markers with the errors that they give together."""
        rows = [
            (f"marker {j + 1}", f"at {place(x)} m; so far {self.words(d)}")
            for j, (x, d) in enumerate(zip(self.best, self.motions[0].deviations, strict=True))
        ]
        return Card(f"Markers for {self.scene.name}", tuple(rows))

    def words(self, deviation: Array) -> str:
        """The standard deviation of each parameter, in words."""
        return ", ".join(f"{u.name} {percent(x)}" for u, x in zip(self.unknowns, deviation, strict=True))


def place(x: Array) -> str:
    """Coordinates in words."""
    return "(" + ", ".join(f"{c + 0.0:.4g}" for c in x) + ")"


def suggest_markers(
    model: Model,
    fit: str | Sequence[str],
    noise: float,
    K: int,
    *,
    motions: Sequence[Mapping[str, Any]] = (),
    rate: float | None = None,
    offset: bool = False,
    shift: bool = False,
    candidates: Array | None = None,
    N: int = 36,
) -> SuggestedMarkers:
    """F = sum_i J_i'J_i over K boundary points, of the largest det F, for each motion [F72]. Collective.

    J_i = (dy_i/dlog theta) / sigma of a marker i; the standard deviations of log theta are the roots of diag F^-1.
    Points are chosen greedily, then exchanged one by one; motions are ranked by det F of their points. The errors are
    those by the noise at the values of the model; a fit adds those of mesh, time step and reduction.

    >>> import softgrasp as sg
    >>> model = sg.build("paper_forward", ["tissue.cells=[4, 8]", "time.steps=100"])
    >>> found = sg.suggest_markers(model, "mu,lambda", 1e-3, 2, motions=[{"duration": 1.0}, {"duration": 2.0}], N=20)
    >>> found.best.shape, found.motions[0].motion
    ((2, 2), {'duration': 1.0})

    Args:
        model: scene with the values that the material is thought to have.
        fit: "mu,lambda,beta" or a sequence, as of :func:`softgrasp.reduction.identify.identify.identify`.
        noise: standard deviation of each coordinate of a marker [m].
        K: number of markers.
        motions: keys of [motion] that differ from the scene's, of each motion that could be made; none: the scene's.
        rate: samples a second; None: one a time step.
        offset: each marker's place will be fitted too.
        shift: a time shift between hand and camera will be fitted too.
        candidates: points to choose from, (c, d) [m], each moved to the nearest node; None: up to 80 nodes spread over
            the free boundary.
        N: dimension of the reduced models.

    Raises:
        SceneError: an argument does not fit, or the scene cannot be fitted.
        ReductionError: there is no reduced model of N columns.
    """
    check_identifiable(model)
    if any(m.part for m in model.system.materials):
        raise SceneError("markers are chosen for lambda, mu, rho and beta; leave out tissue.energy and own terms")
    if model.scene.effects.finite_strain is not None:
        raise SceneError(
            f"scene '{model.scene.name}': markers are chosen by linear elasticity, and effects.finite_strain is on; "
            "use --set effects.finite_strain=false"
        )
    names = [part.strip() for part in fit.split(",") if part.strip()] if isinstance(fit, str) else list(fit)
    unknowns = parse_unknowns(names, model)
    if not (np.isfinite(noise) and noise > 0):
        raise SceneError(f"noise = {noise} must be a standard deviation > 0 [m], such as 1e-3")
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise SceneError(f"rate = {rate} must be a number > 0 of samples a second")
    points = candidate_points(model, candidates)
    if not 0 < K <= len(points):
        raise SceneError(f"{K} markers: choose at least one, and at most {len(points)}, the number of candidates")
    values = np.array([value_of(model.system.materials, u) for u in unknowns])
    wide = replace(model, scene=with_markers(model.scene, points))
    near, own = Near(wide, unknowns, values, N), Near(model, unknowns, values, N)
    plans = [
        _plan(near, own, values, moved(model.scene, motion), dict(motion), noise, rate, offset, shift, K)
        for motion in (motions or ({},))
    ]
    plans.sort(key=lambda plan: (len(plan.hidden), plan.size))
    chosen = points[list(plans[0].chosen)]
    scene = with_markers(moved(model.scene, plans[0].motion), chosen)
    return SuggestedMarkers(unknowns, values, points, tuple(plans), scene)


def candidate_points(model: Model, given: Array | None) -> Array:
    """Points that are given, or spread over the free boundary, (c, d) [m]. Collective.

    Raises SceneError: they have not as many coordinates as the body.
    """
    layout, d = model.system.layout, model.system.layout.dimension
    if given is None:
        return spread_points(layout.rounded(make_surface(model.space, model.system).X), layout.reference)
    points = np.asarray(given, dtype=float)
    if points.ndim != 2 or points.shape[1] != d:
        raise SceneError(f"candidates have the shape {points.shape}; it must be (candidates, {d})")
    return points


def _plan(
    near: Near, own: Near, values: Array, scene: Scene, motion: dict[str, Any], noise: float, rate: float | None,
    offset: bool, shift: bool, K: int,
) -> MotionPlan:  # fmt: skip
    k, d = len(values), near.model.system.layout.dimension
    F = information(near, values, scene, noise, rate, offset, shift)
    of_points = F.reshape(-1, d, *F.shape[1:]).sum(axis=1)
    chosen = choose(of_points, k, K)
    so_far = np.cumsum(of_points[chosen], axis=0)
    ours = information(own, values, scene, noise, rate, offset, shift).sum(axis=0)
    hidden = tuple(direction_in_words(near.unknowns, x) for x in unseen_directions(so_far[-1], k))
    all_of, by_one = (np.array([deviations(each, k) for each in some]) for some in (so_far, of_points))
    sizes = ellipsoid(of_points, k), float(ellipsoid(so_far[-1], k))
    return MotionPlan(motion, tuple(chosen), all_of, deviations(ours, k), by_one, *sizes, hidden)


def information(
    near: Near, values: Array, scene: Scene, noise: float, rate: float | None, offset: bool, shift: bool
) -> Array:
    """F_j = J_j'J_j of every output j about log theta, and a time shift, (outputs, m, m). Collective."""
    nothing = Measurements("plan", np.zeros(0), np.zeros((0, 0)))
    with tempfile.TemporaryDirectory() as folder:  # a measured hand would be written there; there is none
        e = experiment(replace(near.model, scene=scene), nothing, Path(folder) / "hand.csv")
    small = near.system(values)
    answer = near.run(small, e)
    J = near.slopes(values, near.unknowns, small, answer, e)
    if shift:
        J = np.concatenate([J, np.gradient(answer.outputs, answer.times, axis=0)[None]])
    if offset:
        J = J - J.mean(axis=1, keepdims=True)
    samples = 1.0 if rate is None else rate * e.dt
    return np.asarray(np.einsum("kto,lto->okl", J, J) * samples / noise**2)


def moved(scene: Scene, motion: Mapping[str, Any]) -> Scene:
    """A scene with other keys of [motion]. Raises SceneError: they do not fit."""
    try:
        return scene.changed(lambda data: data["motion"].update(motion)) if motion else scene
    except ValidationError as error:
        why = error.errors()[0]
        key = ".".join(str(part) for part in why["loc"])
        raise SceneError(f"motion {shortened(str(dict(motion)))}: {key}: {why['msg']}") from None


def with_markers(scene: Scene, points: Array) -> Scene:
    """A scene whose outputs are the nodes at points, m1, m2, .., in place of its own."""
    outputs = [{"kind": "node", "point": x.tolist(), "name": f"m{i + 1}"} for i, x in enumerate(points)]
    return scene.changed(lambda data: data.update(control={"outputs": outputs}))


def spread_points(X: Array, reference: Array, most: int = MOST_CANDIDATES) -> Array:
    """Points far from each other, in an order that the ranks do not change: the farthest from those before is next."""
    X = np.unique(X, axis=0)
    distance, chosen = np.linalg.norm(X - reference, axis=1), []
    for _ in range(min(most, len(X))):
        chosen.append(int(np.argmax(np.round(distance / distance.max(), 9))))
        new = np.linalg.norm(X - X[chosen[-1]], axis=1)
        distance = new if len(chosen) == 1 else np.minimum(distance, new)
        if not distance.max() > 0:
            break
    return np.asarray(X[np.sort(chosen)] + 0.0)  # no -0
