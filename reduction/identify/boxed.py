"""Fits with a certified model: one basis for its whole box, and a proved error of the outputs at every step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.petsc import Array
from softgrasp.reduction.certified.archive import load_certified
from softgrasp.reduction.certified.certificate import Bound
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import padded
from softgrasp.reduction.certified.training import scene_drive
from softgrasp.reduction.identify.near import RADIUS, Experiment, Fixed
from softgrasp.reduction.identify.unknowns import Unknown, materials_at, value_of
from softgrasp.reduction.online import ReducedTrajectory
from softgrasp.reduction.origin import check_origin
from softgrasp.reduction.system import ModelError

DAMPING = float(np.log(10.0))  # of log beta on both sides: no box has a range of it, and the bound holds for any


def load_for(model: Model, certified: CertifiedModel | str | Path) -> CertifiedModel:
    """A certified model of a scene, read where it is a file. Collective.

    Raises ModelError: the file is none, or of another mesh or scene, or the model has no box.
    """
    found = certified if isinstance(certified, CertifiedModel) else load_certified(Path(certified), model.system.layout)
    check_origin(found.fine.origin, model.scene_keys, found.fine.name)
    if found.box is None:
        raise ModelError(
            "the certified model has no box of materials; reduce the scene with --tolerance", found.fine.name
        )
    return found


class Boxed(Fixed):
    """The smaller basis of a certified model, whose larger one bounds its error."""

    whole_range = True

    def __init__(self, model: Model, unknowns: Sequence[Unknown], certified: CertifiedModel) -> None:
        super().__init__(model, unknowns)
        self.certified, self.rom = certified, certified.coarse

    def limits(self, theta: Array) -> tuple[Array, Array]:
        """The box of the training, in every layer the same factors; of the damping a factor of ten."""
        box, materials = self.certified.box, self.certified.fine.materials
        low, high = np.empty(len(theta)), np.empty(len(theta))
        for i, u in enumerate(self.unknowns):
            if box is None or u.kind not in ("mu", "lambda"):
                reach = DAMPING if u.kind == "beta" else RADIUS
                own = float(np.log(value_of(self.model.system.materials, u)))
                low[i], high[i] = own - reach, own + reach
                continue
            first, ends = (materials[0].mu, box.mu) if u.kind == "mu" else (materials[0].lam, box.lam)
            low[i], high[i] = np.log(np.array(ends) * value_of(materials, u) / first)
        return low, high

    def bound(self, values: Array, experiment: Experiment) -> Bound:
        """Error of the outputs of a run as certified, (steps + 1, p) [m, rad]."""
        drive = scene_drive(experiment.scene, experiment.M_hand, 1)
        materials = materials_at(self.model.system.materials, self.unknowns, values)
        return self.certified.run(materials, drive, allow=True).certificate.outputs

    def displacements(self, values: Array, answer: ReducedTrajectory, count: int) -> Array | None:
        """Displacements of the tissue at some instants, local rows (n_local, count) [m]; None without the mesh."""
        fine = self.certified.fine
        if fine.reconstruction is None:
            return None
        x = padded(self.some(answer, count), fine.N, answer.q_s.shape[1])
        return fine.reconstruct(fine.at(self.at(values)), x.T)[0]
