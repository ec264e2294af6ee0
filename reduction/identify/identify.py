"""Parameters of a scene that fit measured outputs, and the parts of their error.

    min over theta of sum |W y_N(t; theta) - y|^2 / sigma^2,   J = W dy_N/dlog theta / sigma,   J+ = (J'J)^-1 J'

noise: the roots of diag (J'J)^-1; mesh: J+ W delta(t), delta(t) the estimated error of the outputs over time; time
step: the same with the difference to half the step; reduction: with the difference to a full run at the answer.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from softgrasp.fem.accuracy.adapt import build
from softgrasp.fem.columns import Columns, hand_columns
from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import MeshEstimate, Model
from softgrasp.fem.petsc import Array, on_root
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.identify.data import Measurements, check, parse_noise, read_measurements
from softgrasp.reduction.identify.fit import Fit, Linearisation, Nuisances, by_experiment, fit_rounds, linearise
from softgrasp.reduction.identify.near import check_identifiable, experiment
from softgrasp.reduction.identify.parts import errors_of_outputs, finer_scene, finer_steps, finer_tolerance
from softgrasp.reduction.identify.result import Identified
from softgrasp.reduction.identify.unknowns import assumed, parse_unknowns, scene_at, value_of
from softgrasp.reduction.identify.verdict import judge, reasons, unseen, warnings

GROWTH, LARGEST_N = 1.5, 200  # of N while the reduction exceeds the noise
MOST_REFINED = 3  # times that a mesh is refined
Data = Measurements | str | Path


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
    progress: Callable[[int], None] = lambda done: None,
) -> Identified:
    """Values (mu, lambda, ..) = argmin sum |y_N(t) - y|^2 / sigma^2 [BCL99], and their errors by cause. Collective.

    The answer says by ``reasons`` why it must not be used: a misfit beyond chance, a mesh or a time step that changes a
    value by more than the noise, a direction that the data do not see, rounds that do not settle.

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
        N: dimension of the reduced models; grows where the reduction exceeds the noise.
        offset: fit a constant error of each output too.
        shift: fit a time shift between hand and outputs too.
        robust: a loss in which outliers count little.
        refine: refine the mesh, and the time step, where they exceed the noise.
        progress: called with the number of rounds done.

    Raises:
        SceneError: data or scene cannot be fitted, in one sentence.
        SolverError: a solve fails.
    """
    check_identifiable(model)
    columns = tuple(c for o in model.outputs for c in o.columns)
    sigma = parse_noise(noise if isinstance(noise, str) else repr(float(noise)), columns)
    names = [part.strip() for part in fit.split(",") if part.strip()] if isinstance(fit, str) else list(fit)
    many = [data] if isinstance(data, Measurements | str | Path) else list(data)
    if not many:
        raise SceneError("identify: there are no measurements; give at least one file")
    read = tuple(_measurements(model, each) for each in many)
    done = 0

    def tick(_: int) -> None:
        nonlocal done
        done += 1
        progress(done)

    answer = _identify(model, read, names, sigma, N, offset, shift, robust, tick)
    for _ in range(MOST_REFINED if refine else 0):
        if (finer := refinement(answer)) is None:
            break
        answer = _identify(
            build(finer, comm=model.system.layout.comm), read, names, sigma, N, offset, shift, robust, tick
        )
    return answer


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
        check(data.name, data, end if data.hand is None else float(data.hand[0][-1]), layout.extent)
        return data
    hand = hand_columns(layout.n_s, layout.dimension, "q")
    return on_root(layout.comm, lambda: read_measurements(Path(data), columns, hand, end, layout.extent))


def _identify(
    model: Model, data: tuple[Measurements, ...], names: Sequence[str], sigma: Array, N: int,
    offset: bool, shift: bool, robust: bool, tick: Callable[[int], None],
) -> Identified:  # fmt: skip
    unknowns = parse_unknowns(names, model)
    k, comm = len(unknowns), model.system.layout.comm
    first = np.array([value_of(model.system.materials, u) for u in unknowns])
    with tempfile.TemporaryDirectory() as folder:
        own = Path(comm.bcast(folder))
        experiments = [experiment(model, each, own / f"hand-{i}.csv") for i, each in enumerate(data)]
        nuisances = Nuisances.of(experiments, offset, shift)
        start = np.concatenate([np.log(first), np.zeros(nuisances.count)])
        while True:
            found = fit_rounds(model, experiments, unknowns, start, sigma, nuisances, N, robust=robust, progress=tick)
            line = linearise(found.misfit, found.p, robust)
            reduced = found.misfit.answers(found.p)[1]
            errors, estimate = errors_of_outputs(found.misfit.near, np.exp(found.p[:k]), reduced, experiments)
            parts = {
                name: None if error is None else line.inverse @ found.misfit.together(error, found.p)
                for name, error in errors.items()
            }
            most = min(LARGEST_N, model.states)
            lost, noise = parts["reduction"], np.sqrt(np.diag(line.covariance))
            if found.unsettled or lost is None or (np.abs(lost) <= noise).all() or most < N * GROWTH:
                break
            N, start = 2 * int(np.ceil(N * GROWTH / 2)), found.p  # modes come in pairs of states
    return _answer(found, line, first, parts, estimate, N, robust)


def _answer(
    found: Fit, line: Linearisation, start: Array, parts: dict[str, Array | None], estimate: MeshEstimate | None,
    N: int, robust: bool,
) -> Identified:  # fmt: skip
    misfit = found.misfit
    k, unknowns, data = misfit.k, tuple(misfit.near.unknowns), tuple(e.data for e in misfit.experiments)
    values, noise = np.exp(found.p[:k]), np.sqrt(np.diag(line.covariance))
    model = misfit.near.full(values)
    tables = list(by_experiment(misfit, line.residual))
    judged = judge(line.residual, tables, len(found.p), robust)
    columns = tuple(c for o in model.outputs for c in o.columns)
    scene = scene_at(model.scene, unknowns, values)
    return Identified(
        unknowns=unknowns, start=start, values=values, noise=noise, parts=parts, covariance=line.covariance,
        sight=line.sizes, directions=line.directions,
        assumed={
            u.name: -line.inverse @ misfit.slopes(found.p, [u])[:, 0] for u in assumed(model, unknowns)
        },
        nuisances=_nuisances(misfit.nuisances, found.p[k:], line.all_deviations[k:], data, columns),
        residuals=judged,
        reasons=reasons(unknowns, judged, found.unsettled, unseen(unknowns, line.sizes, line.directions), noise,
            parts, _cures(parts, noise, estimate, model.scene, N)),
        warnings=warnings(judged, robust),
        history=found.history, runs=found.runs, N=N, scene=scene,
        model=replace(model, scene=scene, accuracy=estimate), estimate=estimate, data=data,
        fitted=tuple(e.values + misfit.sigma * r for e, r in zip(data, tables, strict=True)),
        sigma=misfit.sigma, columns=columns,
    )  # fmt: skip


def _cures(
    parts: dict[str, Array | None], noise: Array, estimate: MeshEstimate | None, scene: Scene, N: int
) -> dict[str, str]:
    """What mends each part that exceeds the noise."""
    mesh, step = parts["mesh"], parts["time step"]
    result = {"reduction": f"take more than N = {N} columns"}
    if mesh is not None and estimate is not None:
        tolerance = finer_tolerance(mesh, noise, estimate)
        result["mesh"] = f"set tissue.order = 2 and tissue.refine.tolerance = {tolerance:g}, or take --refine"
    if step is not None:
        result["time step"] = f"set time.steps = {finer_steps(step, noise, scene.time.steps)}, or take --refine"
    return result


def refinement(answer: Identified) -> Scene | None:
    """The scene that a refused answer needs, at the values it started from; None where both are fine enough."""
    mesh, step, estimate, noise = answer.parts["mesh"], answer.parts["time step"], answer.estimate, answer.noise
    if unseen(answer.unknowns, answer.sight, answer.directions) or mesh is None or step is None or estimate is None:
        return None
    scene = scene_at(answer.scene, answer.unknowns, answer.start)
    tolerance = finer_tolerance(mesh, noise, estimate) if (np.abs(mesh) > noise).any() else None
    steps = finer_steps(step, noise, scene.time.steps) if (np.abs(step) > noise).any() else None
    if tolerance is None and steps is None:
        return None
    return finer_scene(scene, tolerance, steps, estimate.time_error)


def _nuisances(
    nuisances: Nuisances, values: Array, deviations: Array, data: Sequence[Measurements], columns: Columns
) -> tuple[tuple[str, float, float], ...]:
    """Names with units, values and deviations of what was fitted beside the material."""
    names = [f"offset of {columns[j].label} in {data[i].name} [{columns[j].unit}]" for i, j in nuisances.offsets]
    names += [f"time shift of {data[i].name} [s]" for i in nuisances.shifts]
    return tuple((n, float(v), float(s)) for n, v, s in zip(names, values, deviations, strict=True))
