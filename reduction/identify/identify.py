"""Parameters of a scene that fit measured outputs, and the parts of their error.

    min over theta of sum |W y_N(t; theta) - y|^2 / sigma^2,   J = W dy_N/dlog theta / sigma,   J+ = (J'J)^-1 J'

noise: the roots of diag (J'J)^-1; mesh: J+ W delta(t), delta(t) the estimated error of the outputs over time; time
step: the same with the difference to half the step; reduction: with the difference to a full run at the answer, or
|J+| b with the bound b of a certified model. Where linear elasticity may be beyond its range, one full run at finite
strain says what it changes, and where that is more than the noise the fit is made at finite strain.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from softgrasp.fem.accuracy.adapt import build
from softgrasp.fem.columns import Columns, hand_columns
from softgrasp.fem.errors import SceneError, SolverError, shortened
from softgrasp.fem.model.build import MeshEstimate, Model
from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.strain.laws import LAWS, LawName
from softgrasp.reduction.identify.data import Measurements, check, parse_noise, read_measurements, with_distinct_names
from softgrasp.reduction.identify.fit import Fit, Linearisation, Nuisances, by_experiment, fit_rounds, linearise
from softgrasp.reduction.identify.near import Experiment, Local, Near, check_identifiable, experiment, moved_as
from softgrasp.reduction.identify.parts import (
    OutputErrors,
    errors_of_outputs,
    finer_scene,
    finer_steps,
    finer_tolerance,
)
from softgrasp.reduction.identify.posterior import check_posterior, sample
from softgrasp.reduction.identify.result import Identified, Nuisance
from softgrasp.reduction.identify.unknowns import Unknown, parse_unknowns, scene_at, value_of
from softgrasp.reduction.identify.verdict import judge, reasons, unseen, warnings

if TYPE_CHECKING:
    from softgrasp.reduction.certified.model import CertifiedModel

MORE_ROUNDS = 3  # times that the fit goes on with models that are exact at the values of a round
MOST_REFINED = 3  # times that a mesh is refined
Data = Measurements | str | Path
Law = LawName | Literal["auto", "linear"]


def identify(
    model: Model,
    data: Data | Sequence[Data],
    fit: str | Sequence[str],
    noise: float | str,
    *,
    N: int = 36,
    offset: bool = False,
    shift: bool = False,
    robust: bool = False,
    refine: bool = False,
    law: Law = "auto",
    certified: CertifiedModel | str | Path | None = None,
    posterior: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Identified:
    """Values (mu, lambda, ..) = argmin sum |y_N(t) - y|^2 / sigma^2 [BCL99], and their errors by cause. Collective.

    The answer says by ``reasons`` why it must not be used: a misfit beyond chance, a mesh or a time step that changes a
    value by more than the noise, a direction that the data do not determine, rounds that do not settle.

    >>> import numpy as np, softgrasp as sg
    >>> from softgrasp.reduction.identify.data import Measurements
    >>> keys = ["time.steps=100", "tissue.order=2", "tissue.refine={tolerance=3e-2}"]
    >>> model = sg.build("paper_forward", keys)
    >>> truth = sg.build("paper_forward", [*keys, "tissue.material.mu=60"])
    >>> run = sg.simulate(truth)
    >>> noise = np.random.default_rng(0).normal(0, 5e-3, run.outputs.shape)
    >>> data = Measurements("tip", run.times, run.outputs + noise)
    >>> found = sg.identify(model, data, fit="mu", noise=5e-3)
    >>> bool(abs(found.values[0] / 60 - 1) < 3 * found.total[0])
    True

    Args:
        model: scene with the values that the fit starts from.
        data: CSV file or measurements, or several, an experiment each.
        fit: "mu,lambda,beta" or a sequence; of a layer as "skin.mu".
        noise: standard deviation of each measured number [m, rad], or "tip=1e-3,mid_x=2e-3".
        N: dimension of the reduced models, the hand's 2 n_s included; full runs correct them where the reduction
            exceeds the noise.
        offset: fit a constant error of each output too.
        shift: fit a time shift between hand and outputs too.
        robust: a loss that gives outliers little weight.
        refine: refine the mesh, and the time step, where they exceed the noise.
        law: "linear" elasticity, or a hyperelastic law by hyper-reduced models; "auto" is that of the scene, and uses
            "neo-hooke" where finite strain changes a linear value by more than the noise and the data speak for it;
            where they do not decide, the values are linear and the difference is a part of their errors.
        certified: a certified model of the scene, or its file: its basis serves for all values, its bound is the part
            of the reduction. Linear elasticity alone.
        posterior: samples of the posterior by emcee, which check the covariance; 0: none.
        progress: called with the number of rounds done.

    Raises:
        SceneError: data or scene cannot be fitted, in one sentence.
        SolverError: a solve fails.
    """
    if any(m.part for m in model.system.materials):
        raise SceneError("identify fits lambda, mu, rho and beta, and cannot go with tissue.energy or own terms yet")
    check_identifiable(model)
    if posterior:
        check_posterior(posterior)
    if law not in ("auto", "linear", *LAWS):
        raise SceneError(f"--law {shortened(str(law))}: it must be auto, linear, {', '.join(LAWS)}")
    columns = tuple(c for o in model.outputs for c in o.columns)
    sigma = parse_noise(noise if isinstance(noise, str) else repr(float(noise)), columns)
    names = [part.strip() for part in fit.split(",") if part.strip()] if isinstance(fit, str) else list(fit)
    many = [data] if isinstance(data, Measurements | str | Path) else list(data)
    if not many:
        raise SceneError("identify: there are no measurements; give at least one file")
    read = with_distinct_names([_measurements(model, each) for each in many])
    done = 0

    def tick(_: int) -> None:
        nonlocal done
        done += 1
        progress(done)

    asked = Asked(read, names, sigma, N, offset, shift, robust, law, certified, tick, posterior)
    answer = _identify(model, asked)
    for _ in range(MOST_REFINED if refine else 0):
        if (finer := refinement(answer)) is None:
            break
        if certified is not None:
            raise SceneError("--refine: a certified model is of one mesh; refine the scene and reduce it again")
        answer = _identify(build(finer, comm=model.system.layout.comm), asked)
    return answer


@dataclass(frozen=True)
class Asked:
    """What is fitted to which data, and how."""

    data: tuple[Measurements, ...]  # an experiment each
    names: Sequence[str]  # parameters that are fitted, as "mu" or "skin.mu"
    sigma: Array  # standard deviation of the noise of each output, (p,) [m, rad]
    N: int  # dimension of the reduced models
    offset: bool  # whether a constant error of each output is fitted too
    shift: bool  # whether a time shift of each experiment is fitted too
    robust: bool  # whether the loss gives outliers little weight
    law: Law  # "auto", "linear" or the name of a hyperelastic law
    certified: CertifiedModel | str | Path | None  # model of the scene that is used instead of others
    tick: Callable[[int], None]  # called after each round
    posterior: int = 0  # samples of the posterior


def _measurements(model: Model, data: Data) -> Measurements:
    """Measurements as they are, or read from a file, checked. Collective."""
    layout, end = model.system.layout, model.scene.time_end
    columns = tuple(c for o in model.outputs for c in o.columns)
    if isinstance(data, Measurements):
        if data.values.shape != (len(data.times), len(columns)):
            raise SceneError(
                f"{data.name}: values have the shape {data.values.shape}; the scene has {len(columns)} outputs"
            )
        if data.hand is not None and not (np.isfinite(data.hand[0]).all() and np.isfinite(data.hand[1]).all()):
            raise SceneError(f"{data.name}: the measured hand is not finite; give finite positions")
        check(data.name, data, end if data.hand is None else float(data.hand[0][-1]), layout.extent, columns)
        return data
    hand = hand_columns(layout.n_s, layout.dimension, "q")
    return on_root(layout.comm, lambda: read_measurements(Path(data), columns, hand, end, layout.extent))


def _identify(model: Model, asked: Asked) -> Identified:
    """The answer on the mesh of a model. Collective."""
    own = model.scene.effects.finite_strain
    if asked.law == "linear" and own is not None:
        raise SceneError(f"--law linear: scene '{model.scene.name}' has effects.finite_strain; set it to false")
    if asked.law not in ("auto", "linear") and (own is None or own.law != asked.law):
        from softgrasp.reduction.identify.strained import strained_model  # linear fits do not pay for it

        model = strained_model(model, cast(LawName, asked.law))
    unknowns, comm = parse_unknowns(asked.names, model), model.system.layout.comm
    first = np.array([value_of(model.system.materials, u) for u in unknowns])
    with tempfile.TemporaryDirectory() as folder:
        place = Path(comm.bcast(folder))
        experiments = [experiment(model, each, place / f"hand-{i}.csv") for i, each in enumerate(asked.data)]
        nuisances = Nuisances.of(experiments, asked.offset, asked.shift)
        start = np.concatenate([np.log(first), np.zeros(nuisances.count)])
        solved = _solve(model, unknowns, experiments, nuisances, start, asked)
        return _within_range(_answer(solved, first, asked), solved, first, asked)


@dataclass(frozen=True)
class Solved:
    """A fit with its errors."""

    fit: Fit  # values and history of the last round
    line: Linearisation  # outputs linear in log theta around the fit
    errors: OutputErrors  # errors of the outputs at the fit, by cause
    law: str  # "linear", or the hyperelastic law


def _solve(
    model: Model,
    unknowns: Sequence[Unknown],
    experiments: Sequence[Experiment],
    nuisances: Nuisances,
    start: Array,
    asked: Asked,
    linear: Model | None = None,
) -> Solved:
    """Fit with small models, which full runs correct while the reduction exceeds the noise. Collective.

    ``linear``: the model without finite strain, whose small models with full runs of ``model`` serve.
    """
    k, strain, again = len(unknowns), model.scene.effects.finite_strain, 0
    while True:
        make = _small_models(model, unknowns, experiments, asked, exact=again > 0, linear=linear)
        found = fit_rounds(make, experiments, start, asked.sigma, nuisances, robust=asked.robust, progress=asked.tick)
        line, theta = linearise(found.misfit, found.p, asked.robust), np.exp(found.p[:k])
        errors = errors_of_outputs(found.misfit.near, theta, found.misfit.answers(found.p)[1], experiments)
        lost, noise = errors.through(line.inverse, found.misfit, found.p)["reduction"], line.noise
        done = found.unsettled or found.misfit.near.whole_range or lost is None or (np.abs(lost) <= noise).all()
        if done or again == MORE_ROUNDS:
            return Solved(found, line, errors, "linear" if strain is None else strain.law)
        start, again = found.p, again + 1


def _small_models(
    model: Model,
    unknowns: Sequence[Unknown],
    experiments: Sequence[Experiment],
    asked: Asked,
    exact: bool,
    linear: Model | None = None,
) -> Callable[[Array], Local]:
    """What makes a small model near values. Raises SceneError: there is none. Collective.

    ``exact``: correct a linear one by full runs at the values.
    """
    if model.system.points is not None:
        from softgrasp.reduction.identify.strained import Corrected, Strained, check_strained

        if asked.certified is not None:
            raise SceneError(
                "--certified: its bound is of linear elasticity; leave out effects.finite_strain and --law"
            )
        check_strained(model, unknowns, experiments)
        if linear is not None:
            return lambda values: Corrected(model, linear, unknowns, values, asked.N, experiments)
        return lambda values: Strained(model, unknowns, values, asked.N, experiments)
    if asked.certified is not None:
        from softgrasp.reduction.identify.boxed import Boxed, load_for

        certified = load_for(model, asked.certified)
        return lambda values: Boxed(model, unknowns, certified)
    return lambda values: Near(model, unknowns, values, asked.N, experiments, exact)


def _within_range(answer: Identified, solved: Solved, first: Array, asked: Asked) -> Identified:
    """A linear answer with what finite strain changes, or the answer at finite strain in its place. Collective."""
    if solved.law != "linear":
        return answer
    from softgrasp.reduction.identify import beyond
    from softgrasp.reduction.identify.strained import strained_model

    fit, unknowns = solved.fit, answer.unknowns
    scale = beyond.linear_range(fit.misfit, fit.p)
    if not scale.left:
        return answer
    if asked.law == "linear" or beyond.not_yet(answer):
        hint = (
            "identify tests finite strain once the answer is accepted" if asked.law == "auto" else "--law auto tests it"
        )
        return replace(answer, warnings=(*answer.warnings, scale.sentence(hint)))
    try:
        part = beyond.strain_part(fit.misfit, solved.line, fit.p, solved.errors, unknowns, beyond.DEFAULT)
    except (SceneError, SolverError) as error:
        return replace(answer, warnings=(*answer.warnings, scale.sentence(f"it is not tried: {error}")))
    known = beyond.with_part(answer, part)
    if (np.abs(part) <= answer.noise).all() and answer.residuals.misfit <= answer.residuals.limit:
        return known
    model = strained_model(fit.misfit.near.model, beyond.DEFAULT)
    experiments = [replace(e, scene=moved_as(model.scene, e)) for e in fit.misfit.experiments]
    solve = partial(_solve, model, unknowns, experiments, fit.misfit.nuisances, fit.p, replace(asked, certified=None))
    more = ""
    try:
        try:
            other = solve()
        except SolverError as error:  # no reduced model at finite strain has a run; full ones may
            more, other = str(error), solve(linear=fit.misfit.near.model)
            if other.fit.unsettled:  # its misfit says nothing about the law
                raise
    except (SceneError, SolverError) as error:
        return beyond.refused(known, part, str(error))
    return beyond.chosen(answer, _answer(other, first, asked), part, more)


def _answer(solved: Solved, start: Array, asked: Asked) -> Identified:
    """What a fit answers."""
    found, line, misfit, robust = solved.fit, solved.line, solved.fit.misfit, asked.robust
    k, unknowns, data = misfit.k, tuple(misfit.near.unknowns), tuple(e.data for e in misfit.experiments)
    values, noise = np.exp(found.p[:k]), line.noise
    parts, kinds = solved.errors.through(line.inverse, misfit, found.p), solved.errors.kinds(solved.law)
    model, estimate = misfit.near.full(values), solved.errors.estimate
    tables = list(by_experiment(misfit, line.residual))
    judged = judge(line.residual, tables, len(found.p), robust)
    columns = tuple(c for o in model.outputs for c in o.columns)
    scene = scene_at(model.scene, unknowns, values)
    own, comm = None if misfit.near.whole_range else misfit.near.size, model.system.layout.comm
    sampled = None
    if asked.posterior:
        sampled = on_root(comm, lambda: sample(misfit, found.p, line.whole, asked.posterior, robust))
    return Identified(
        unknowns=unknowns, start=start, values=values, noise=noise, parts=parts, kinds=kinds, law=solved.law,
        covariance=line.covariance, sensitivities=line.sizes, directions=line.directions,
        assumed={u.name: -line.inverse @ misfit.slopes(found.p, [u])[:, 0] for u in misfit.near.rests_on()},
        nuisances=_nuisances(solved, data, columns),
        residuals=judged,
        reasons=reasons(unknowns, judged, found.unsettled, unseen(unknowns, line.sizes, line.directions), noise,
            parts, _cures(parts, noise, estimate, model.scene, own), found.edges),
        warnings=warnings(judged, robust),
        history=found.history, runs=found.runs, N=misfit.near.size, scene=scene,
        model=replace(model, scene=scene, accuracy=estimate), estimate=estimate, data=data,
        fitted=tuple(e.values + misfit.sigma * r for e, r in zip(data, tables, strict=True)),
        sigma=misfit.sigma, columns=columns, posterior=sampled,
    )  # fmt: skip


def _cures(
    parts: dict[str, Array | None], noise: Array, estimate: MeshEstimate | None, scene: Scene, N: int | None
) -> dict[str, str]:
    """What mends each part that exceeds the noise; ``N`` of the reduced models, None of a certified one."""
    mesh, step = parts["mesh"], parts["time step"]
    certified = "reduce the scene with a smaller --tolerance, or leave the certified model out"
    result = {"reduction": certified if N is None else f"use more than N = {N} columns"}
    if mesh is not None and estimate is not None:
        tolerance = finer_tolerance(mesh, noise, estimate)
        result["mesh"] = f"set tissue.order = 2 and tissue.refine.tolerance = {tolerance:g}, or use --refine"
    if step is not None:
        result["time step"] = f"set time.steps = {finer_steps(step, noise, scene.time.steps)}, or use --refine"
    return result


def refinement(answer: Identified) -> Scene | None:
    """The scene that a refused answer needs, at the values it started from; None where both are fine enough."""
    mesh, step, estimate, noise = answer.parts["mesh"], answer.parts["time step"], answer.estimate, answer.noise
    undetermined = unseen(answer.unknowns, answer.sensitivities, answer.directions)
    if undetermined or mesh is None or step is None or estimate is None:
        return None
    scene = scene_at(answer.scene, answer.unknowns, answer.start)
    tolerance = finer_tolerance(mesh, noise, estimate) if (np.abs(mesh) > noise).any() else None
    steps = finer_steps(step, noise, scene.time.steps) if (np.abs(step) > noise).any() else None
    if tolerance is None and steps is None:
        return None
    return finer_scene(scene, tolerance, steps, estimate.time_error)


def _nuisances(solved: Solved, data: Sequence[Measurements], columns: Columns) -> tuple[Nuisance, ...]:
    """What was fitted beside the material, with its errors."""
    misfit, p, k = solved.fit.misfit, solved.fit.p, solved.fit.misfit.k
    parts, noise = solved.errors.through(solved.line.beside, misfit, p), np.sqrt(np.diag(solved.line.whole)[k:])
    own, every = misfit.nuisances, range(misfit.nuisances.count)
    names = [f"offset of {columns[j].label} in {data[i].name} [{columns[j].unit}]" for i, j in own.offsets]
    names += [f"time shift of {data[i].name} [s]" for i in own.shifts]
    each = [{cause: None if part is None else float(part[n]) for cause, part in parts.items()} for n in every]
    return tuple(map(Nuisance, names, p[k:].tolist(), noise.tolist(), each))
