"""Reduced models with contact beside full runs: on the motion of the scene and on others, which made no model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from softgrasp.fem import Model, SolverError, simulate
from softgrasp.reduction import FullRun, ModelError, ReductionError, full_run
from softgrasp.reduction.contact.make import check_contact_scene, trained
from softgrasp.reduction.contact.model import ContactModel, ContactRun, plane
from softgrasp.reduction.contact.motions import ASIDE, tangent
from softgrasp.reduction.contact.replay import errors_contact, replay_contact
from softgrasp.reduction.contact.train import NUMBERS
from softgrasp.reduction.parameters import moved_to
from softgrasp.study.reduce.times import FullTimes, Say
from softgrasp.study.shell import median_processor_seconds

RUNS = 9  # behind each median of the time of a run
DEEP, DEEPER = 1.05, 1.15  # ways of held-out motions towards the first obstacle, over that of the scene


@dataclass(frozen=True)
class ContactPoint:
    """One model."""

    N: int  # columns
    nodes: int  # that may touch
    error: float  # of z on the motion of the scene [1]
    error_force: float | None  # of the forces there; None where nothing touches [1]
    error_held_out: float | None  # largest error of z on the other motions; None without any [1]
    error_force_held_out: float | None  # largest error of the forces on them; None without any [1]
    time_offline: float  # responses, modes and projection [s]
    time_setup: float  # of a new parameter, which needs a new model [s]
    time_online: float  # a run [s]


@dataclass(frozen=True)
class HeldOutMotion:
    """One motion that trained no model."""

    title: str  # what it does
    target: tuple[float, ...]  # of the hand [m, rad]
    touching: float  # share of the steps with contact [1]
    force: float  # largest force of an obstacle in a step [N]
    errors: dict[str, tuple[float, float | None]]  # of z and of the forces, by the key of the model


@dataclass(frozen=True)
class ContactStudy:
    """All of it."""

    full: FullRun
    times: FullTimes
    points: dict[str, ContactPoint]  # by the key of the model
    models: dict[str, ContactModel]
    motions: list[HeldOutMotion]
    refused: dict[str, str]  # what is not there, and why
    shown: tuple[str, FullRun, ContactRun]  # a motion with its full run and that of the best model

    @property
    def best(self) -> str:
        """Key of the model with the least error of z, on held-out motions if there are any."""
        return min(self.points, key=lambda key: _missed(self.points[key]))


def _missed(p: ContactPoint) -> float:
    return p.error if p.error_held_out is None else p.error_held_out


def measure_contact(full: FullRun, times: FullTimes, say: Say) -> ContactStudy:
    """Make the models and run them. Collective. Raises SoftgraspError: no model fits, or a full run failed."""
    model, refused = full.model, dict[str, str]()
    comm = model.system.layout.comm
    models = _models(model, refused, say)
    own: dict[str, tuple[float, float | None]] = {}
    seconds, runs = dict[str, float](), dict[str, ContactRun]()
    for key, rom in list(models.items()):
        try:
            runs[key] = run = replay_contact(rom, full)
        except (ModelError, SolverError) as error:
            refused[key] = str(error)
            del models[key]
            continue
        found = errors_contact(rom, run, full)
        own[key] = found.z, found.force
        seconds[key] = median_processor_seconds(comm, partial(rom.run, *full.hand, full.dt), RUNS)
    if not models:
        raise ReductionError(f"no reduced model with contact: {'; '.join(f'{k}: {v}' for k, v in refused.items())}")
    first = min(own, key=lambda key: own[key][0])
    shown = ("motion of the scene", full, runs[first])
    motions, furthest = list[HeldOutMotion](), -1.0
    jobs = list(_others(model))
    for i, (title, target) in enumerate(jobs):
        say("held-out motion", i, len(jobs))
        other, motion, answers = _try_motion(full, models, title, target, refused)
        motions.append(motion)
        if first in answers and motion.errors[first][0] > furthest:
            furthest, shown = motion.errors[first][0], (title, other, answers[first])
    points = {
        key: ContactPoint(rom.N, len(rom.kept), *own[key], *_largest(key, motions), made, made, seconds[key])
        for key, rom in models.items()
        for made in [sum(rom.seconds.values())]
    }
    return ContactStudy(full, times, points, models, motions, refused, shown)


def _largest(key: str, motions: list[HeldOutMotion]) -> tuple[float | None, float | None]:
    found = [motion.errors[key] for motion in motions if key in motion.errors]
    forces = [force for _, force in found if force is not None]
    return max((z for z, _ in found), default=None), max(forces, default=None)


def _try_motion(
    full: FullRun, models: dict[str, ContactModel], title: str, target: list[float], refused: dict[str, str]
) -> tuple[FullRun, HeldOutMotion, dict[str, ContactRun]]:
    """A full run elsewhere, and those of all models. Collective. Raises SolverError: the full run failed."""
    model = moved_to(full.model, target)
    try:
        other = full_run(model, simulate(model))
    except SolverError as error:
        raise SolverError(f"full run of the held-out motion to {target}: {error}") from error
    answers = dict[str, ContactRun]()
    for key, rom in models.items():
        try:
            answers[key] = replay_contact(rom, other)
        except (ModelError, SolverError) as error:
            refused[f"{key}, {title}"] = str(error)
    found = {key: errors_contact(models[key], run, other) for key, run in answers.items()}
    contact = other.trajectory.contact
    assert contact is not None
    motion = HeldOutMotion(
        title,
        tuple(target),
        float((contact.touching > 0).any(axis=1).mean()),
        float(np.linalg.norm(contact.force, axis=2).max()),
        {key: (e.z, e.force) for key, e in found.items()},
    )
    return other, motion, answers


def _models(model: Model, refused: dict[str, str], say: Say) -> dict[str, ContactModel]:
    """Models by their number of columns. Collective. Raises ReductionError: no given N is possible."""
    options, models = model.scene.reduction, dict[str, ContactModel]()
    say("reduced model", 0, 1)
    training = trained(model)
    given = "N" in options.model_fields_set
    numbers = sorted(set(options.N), reverse=True) if given else NUMBERS
    for i, N in enumerate(numbers):
        say("reduced model", i, len(numbers))
        try:
            rom = training.model(N)
        except ModelError as error:
            refused[f"N = {N}"] = str(error)
            continue
        models.setdefault(f"contact_{rom.N}", rom)
    if not models:
        raise ReductionError(f"reduction.N has no possible dimension: {next(iter(refused.values()))}")
    return models


def _others(model: Model) -> Iterator[tuple[str, list[float]]]:
    """Titles and targets of the held-out motions; none where the motion has no target."""
    motion, d = model.scene.motion, model.system.layout.dimension
    if motion.profile != "quintic" or not any(motion.target or []):
        return
    target = np.array(motion.target, dtype=float)
    normal = plane(check_contact_scene(model)[0])[0]
    towards = float(target[:d] @ normal) * normal
    along = target[:d] - towards
    if not along.any():
        along = -ASIDE * np.linalg.norm(towards) * tangent(normal)
    for title, place in (
        ("straight towards the obstacle", towards),
        (f"{DEEPER:g} times as deep, twice as far the other way", DEEPER * towards - 2 * along),
        (f"{DEEP:g} times as deep, half as far the other way", DEEP * towards - along / 2),
    ):
        yield title, [*place.tolist(), *target[d:].tolist()]
