"""Reduced models at finite strain: trained on the scene's run alone or over a box, tested on runs that trained none."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.stats import qmc

from softgrasp.fem import Model, SceneError, SolverError, Stopwatch, shortened, simulate
from softgrasp.reduction import FullRun, ReductionError, StrainModel, full_run
from softgrasp.reduction.parameters import grid_of, mirrored, moved_to, outside, run_at, training_of
from softgrasp.reduction.strain.training import Reference, Training, pooled_errors, reference_of, replay_strain, train
from softgrasp.reduction.turning.strained_training import train_turning
from softgrasp.study.reduce.strain.result import (
    CELLS_AT,
    HeldOutTest,
    StrainFamily,
    StrainPoint,
    StrainStudy,
    most_accurate,
)
from softgrasp.study.reduce.times import FullTimes, Say, Turns, in_turn
from softgrasp.study.shell import median_processor_seconds

SIZES = (8, 10, 14, 18, 24, 30)  # N unless the scene names some: each more displacement costs cells too
TAUS = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)
MOTIONS = 4  # held out
SHARES = (0.9, 0.6)  # of the scene's own move, held out from models that are trained on it alone
RUNS, SETUPS = 31, 15  # behind each median of the online time and of the set-up

Missed = tuple[float, float]
"""Error of z on a held-out run, and the model's own estimate of it."""

Place = tuple[float, float]
"""Lamé constants of the first layer [Pa]."""

HeldOut = tuple[str, FullRun]
"""A full run that trained no model, after what is new in it: "material" or "motion"."""


def measure_strain(own: FullRun, times: FullTimes, say: Say) -> StrainStudy:
    """Train, test and time. Collective. Raises SoftgraspError: a run failed, no N fits, or there is no model."""
    model = own.model
    options, hand = model.scene.reduction, 2 * model.system.layout.n_s
    chosen = options.N if "N" in options.model_fields_set else SIZES
    sizes = sorted({N for N in chosen if hand < N and N % 2 == 0})  # those that a model can have
    if not sizes:
        raise SceneError(
            f"reduction.N = {shortened(str(list(chosen)))}: a model at finite strain has an even number of columns, "
            f"more than the {hand} of the hand; give for example [{hand + 4}, {hand + 10}]"
        )
    box_runs, held, none = _box_runs(own, say)
    first, near = model.system.materials[0], []
    for share in SHARES if _has_target(model) else ():
        target = [share * x for x in model.scene.motion.target or []]
        near.append(("motion", _full(model, (first.lam, first.mu), target)))
    families = [_family("own", model, [own], near, sizes, say)]
    if len(box_runs) > 1:
        families.append(_family("box", model, box_runs, held, sizes, say))
    p, f = most_accurate(families)
    turns = strain_turns(own, f.models[p.N])
    return StrainStudy(own, tuple(families), times, turns, missed_by_linear(own), none)


def strain_turns(own: FullRun, rom: StrainModel) -> Turns:
    """Full model and a reduced one in turn, whose answer at a new parameter comes with its estimate. Collective."""
    small, materials = rom.at(own.dt, outside=True), own.model.system.materials
    at_rest = own.model.scene.time.start != "equilibrium"
    start = None if at_rest else small.equilibrium(own.hand[0][0])

    def new() -> float:
        other = rom.at(own.dt, materials, outside=True)
        return other.run(own.hand, a0=None if at_rest else other.equilibrium(own.hand[0][0])).error_estimate

    return in_turn(own.model, lambda: small.run(own.hand, a0=start), new)


def missed_by_linear(own: FullRun) -> float:
    """|z - z_linear|_F / |z|_F of linear elasticity on the same scene. Collective."""
    model = own.model
    effects = model.scene.effects.model_copy(update={"finite_strain": None})
    scene = model.scene.model_copy(update={"effects": effects})
    comm, n = model.system.layout.comm, model.system.layout.n_local
    system = replace(model.system, points=None)
    linear = replace(model, scene=scene, system=system, watch=Stopwatch(comm))
    Z, other = own.snapshots.Z[:n], full_run(linear, simulate(linear)).snapshots.Z[:n]
    missed, whole = comm.allreduce(np.array([np.sum((Z - other) ** 2), np.sum(Z**2)]))
    return float(np.sqrt(missed / whole))


def _full(model: Model, place: Place, target: list[float] | None) -> FullRun:
    """A full run elsewhere; what fails says where. Collective."""
    try:
        return run_at(model if target is None else moved_to(model, target), *place)
    except SolverError as error:
        where = f"lambda = {place[0]:g}, mu = {place[1]:g} Pa" + ("" if target is None else f", target {target}")
        raise SolverError(
            f"full run at {where}: {error}; narrow reduction.lambda_range, mu_range or motions"
        ) from error


def _box_runs(own: FullRun, say: Say) -> tuple[list[FullRun], list[HeldOut], str]:
    """Training runs over the box of materials and motions, held-out runs inside it, and why there are none."""
    model = own.model
    reason, first = outside(model), model.system.materials[0]
    places = [] if reason else training_of(model)
    tests = [] if reason else [p for p in grid_of(model) if not any(np.allclose(p, q) for q in places)]
    targets = mirrored(model) if _has_target(model) else []
    here = (first.lam, first.mu)
    jobs: list[tuple[str, Place, list[float] | None]] = [("train", place, None) for place in places]
    jobs += [("train", here, target) for target in targets]
    if places:
        jobs += [("material", place, None) for place in tests if not np.allclose(place, here)]
    if targets:
        corner = np.abs(np.array(model.scene.motion.target))
        # evenly between the mirrored targets, the same at every call
        spread = 2 * qmc.Halton(len(corner), scramble=False).random(MOTIONS + 1)[1:] - 1
        jobs += [("motion", here, (0.95 * corner * point).tolist()) for point in spread]
    done: list[HeldOut] = []
    for i, (kind, place, target) in enumerate(jobs):
        say("full runs", i, len(jobs))
        done.append((kind, _full(model, place, target)))
    return [own, *(full for kind, full in done if kind == "train")], [h for h in done if h[0] != "train"], reason


def _has_target(model: Model) -> bool:
    motion = model.scene.motion
    return motion.drive == "motion" and motion.profile == "quintic" and any(motion.target or [])


def _family(
    key: str, model: Model, runs: Sequence[FullRun], held: Sequence[HeldOut], sizes: Sequence[int], say: Say
) -> StrainFamily:
    refused: dict[int, str] = {}
    training = None
    for N in sorted(sizes, reverse=True):
        try:
            training = (train if model.system.frame is None else train_turning)(model, runs, N)
            break
        except ReductionError as error:
            refused[N] = error.reason
    if training is None:
        raise ReductionError(f"no N of {list(sizes)} fits: {'; '.join(refused.values())}")
    references = [reference_of(full, training.Phi) for _, full in held]
    fitting = [N for N in sizes if N not in refused]
    points, curves, models, missed = [], [], {}, {}
    for i, N in enumerate(fitting):
        say(f"models trained on {len(runs)} run(s)", i, len(fitting))
        try:
            roms = training.family(N, [None, *TAUS] if N in CELLS_AT else [None])
            missed[N] = _missed(roms[0], held, references)
            points.append(_measure(training, roms[0], held, missed[N]))
        except SolverError as error:  # on all cells, or on those sampled by default
            refused[N] = str(error)
            continue
        models[N] = roms[0]
        for rom in roms[1:]:
            with suppress(SolverError):  # a model of few cells may fail, and has no error then
                curves.append(_measure(training, rom, held, _missed(rom, held, references)))
    if not points:
        raise ReductionError(f"no N of {list(sizes)} gives a model: {'; '.join(refused.values())}")
    tests = []
    for j, (kind, full) in enumerate(held):
        first, target = full.model.system.materials[0], tuple(full.trajectory.q_s[-1].tolist())
        errors, estimates = ({N: None if (pair := missed[N][j]) is None else pair[i] for N in models} for i in (0, 1))
        tests.append(HeldOutTest(kind, first.lam, first.mu, target, errors, estimates))
    whole = (*curves, *points)
    return StrainFamily(key, training.whole.box, len(runs), tuple(points), whole, tuple(tests), models, refused)


def _measure(
    training: Training, rom: StrainModel, held: Sequence[HeldOut], missed: Sequence[Missed | None]
) -> StrainPoint:
    """Errors on training runs and on held-out ones, drift, times."""
    done = [replay_strain(rom, run, outside=True) for run in training.runs]
    trained = pooled_errors([r.missed(x.a, x.v) for r, x in zip(training.references, done, strict=True)])
    own = training.references[0].errors(done[0].a, done[0].v)
    worst: dict[str, list[float]] = {"material": [], "motion": []}
    for (kind, _), pair in zip(held, missed, strict=True):
        worst[kind] += [] if pair is None else [pair[0]]
    full, comm = training.runs[0], training.model.system.layout.comm
    small = rom.at(full.dt, outside=True)  # few cells may overshoot
    start = small.equilibrium(full.hand[0][0]) if full.model.scene.time.start == "equilibrium" else None
    online = median_processor_seconds(comm, lambda: small.run(full.hand, a0=start), RUNS)
    setup = median_processor_seconds(comm, lambda: rom.at(full.dt).problem.potential.packed, SETUPS)
    estimate = median_processor_seconds(
        comm, lambda: replace(done[0]).error_estimate, SETUPS
    )  # a copy has not made its own
    return StrainPoint(
        N=rom.N, k=rom.k, tau=rom.cubature_tolerance, residual=rom.cubature_residual, cells=rom.cells.count,
        error_own=own.z, error_own_velocity=own.v, error_own_energy_norm=own.energy_norm,
        estimate_own=done[0].error_estimate, error_training=trained.z, error_galerkin=rom.error_galerkin,
        floor=training.references[0].projection_error(rom.k),
        error_materials=max(worst["material"], default=None), error_motions=max(worst["motion"], default=None),
        drift=max(run.energy_drift for run in done), evaluations=done[0].evaluations, engine=done[0].engine,
        time_offline=sum(rom.seconds.values()), time_setup=setup, time_online=online,
        time_estimate=estimate,
    )  # fmt: skip


def _missed(rom: StrainModel, held: Sequence[HeldOut], references: Sequence[Reference]) -> list[Missed | None]:
    """Errors and estimates on held-out runs; None where the model refuses one or fails."""
    errors: list[Missed | None] = []
    for (_, full), reference in zip(held, references, strict=True):
        try:
            run = replay_strain(rom, full)
        except (ReductionError, SolverError):
            errors.append(None)
        else:
            errors.append((reference.errors(run.a, run.v).z, run.error_estimate))
    return errors
