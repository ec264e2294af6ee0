"""Training of reduced models at finite strain in the frame of a hand, with cells as in `strain/training.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.frame.path import PathSteps
from softgrasp.fem.petsc import Array
from softgrasp.reduction.operators import Parameters
from softgrasp.reduction.replay import FullRun
from softgrasp.reduction.strain.training import Training, train
from softgrasp.reduction.turning.projection import turning_parts
from softgrasp.reduction.turning.strained import TurningStrainModel

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model


class TurningTraining(Training):
    """Full runs of one scene in the frame of its hand."""

    @cached_property
    def whole(self) -> TurningStrainModel:
        """The largest model on the cells of this rank, every weight 1. Collective."""
        model, system = self.model, self.model.system
        parts, p = system.layout.comm.bcast(turning_parts(system, self.Phi)), Parameters(system.materials)
        S, E, rigid = (p.density(parts[key]) for key in ("S", "E", "rigid"))
        return TurningStrainModel.of(
            super().whole, S=S, E=E, M_hand=system.M_hand, rigid=rigid, sizes=tuple(o.size for o in model.outputs),
            hand_weight=system.hand_weight,
        )  # fmt: skip

    def _felt(self, run: FullRun) -> Array:
        """Accelerations A - g and Omega' in the axes of the hand, and its angular speed, (steps, n_s + 1)."""
        d, g = self.model.system.layout.dimension, np.zeros(3)
        if self.model.system.gravity is not None:
            g[:d] = self.model.system.gravity[:d]
        path = PathSteps.of(*run.hand, run.dt, g, d)
        return np.column_stack([path.felt, np.linalg.norm(path.turns, axis=1)])


def train_turning(model: Model, runs: Sequence[FullRun], N: int) -> TurningTraining:
    """As :func:`softgrasp.reduction.strain.training.train`. Collective."""
    plain = train(model, runs, N)
    return TurningTraining(**{f.name: getattr(plain, f.name) for f in fields(plain) if f.init})
