"""Reduced models in the frame of the hand: every basis at every N beside the full run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from softgrasp.fem import Scene
from softgrasp.reduction import FullRun
from softgrasp.reduction.bases.basis import ReductionError
from softgrasp.reduction.bases.registry import find_method, possible_sizes
from softgrasp.reduction.bases.states import BasisError
from softgrasp.reduction.turning.model import TurningModel
from softgrasp.reduction.turning.projection import TURNING_METHODS, errors_turning, reduce_turning, replay_turning
from softgrasp.study.reduce.times import Say
from softgrasp.study.shell import median_processor_seconds

SIZES = {3: (10, 14, 20, 26, 36), 6: (16, 24, 36, 52, 72)}  # N unless the scene names some, by the hand's freedoms
RUNS = 3  # behind each median of the online time


@dataclass(frozen=True)
class TurningPoint:
    """One model."""

    method: str  # key of the basis
    N: int  # dimension, the hand included
    error: float  # of the deformation z [1]
    error_velocity: float  # of z' [1]
    error_energy_norm: float  # of both in the energy norm [1]
    error_force: float  # largest of the force and torque on the hand, over their largest [1]
    time_offline: float  # basis and integrals [s]
    time_setup: float  # a new parameter [s]
    time_online: float  # a run [s]
    caution: str  # why the linear law does not serve; empty where it does


def turning_methods(scene: Scene) -> tuple[str, ...]:
    """Bases of the scene. Raises BasisError: a basis that does not turn."""
    names = tuple(scene.reduction.methods) or TURNING_METHODS
    if wrong := [name for name in names if name not in TURNING_METHODS]:
        raise BasisError(f"basis '{wrong[0]}' does not turn with effects.frame; name {' or '.join(TURNING_METHODS)}")
    return names


def measure_turning(
    full: FullRun, names: Sequence[str], say: Say
) -> tuple[list[TurningPoint], dict[str, TurningModel], dict[str, str]]:
    """Points, the best model of each basis, and what was refused with its reason. Collective."""
    model, options = full.model, full.model.scene.reduction
    comm, n_s = model.system.layout.comm, model.system.layout.n_s
    wanted = options.N if "N" in options.model_fields_set else SIZES[n_s]
    points, models, refused = [], dict[str, TurningModel](), dict[str, str]()
    start, force = model.scene.time.start, full.trajectory.force
    inner = None if options.inner == "auto" else options.inner
    for name in names:
        method = find_method(name)
        for i, N in enumerate(sizes := possible_sizes(method, n_s, wanted)):
            say(name, i, len(sizes))
            try:
                rom = reduce_turning(model, [full], name, N, inner if method.snapshots else None, options.engine)
            except BasisError as error:
                refused[f"{name}, N = {N}"] = str(error)
                continue
            run, small = replay_turning(rom, full), rom.at(full.dt)
            errors = errors_turning(rom, run, full)
            setup = median_processor_seconds(comm, partial(rom.at, full.dt), RUNS)
            online = median_processor_seconds(comm, partial(small.run, full.hand, start=start), RUNS)
            missed = float(np.abs(run.force - force).max() / max(np.abs(force).max(), 1e-300))
            points.append(TurningPoint(
                name, N, errors.z, errors.v, errors.energy_norm, missed, sum(rom.seconds.values()), setup, online,
                run.caution,
            ))  # fmt: skip
            models[name] = rom
    if not points:
        raise ReductionError(f"no basis has any of N = {list(wanted)}: {'; '.join(refused.values())}")
    return points, models, refused
