"""Full runs with contact repeated by a reduced model, and its errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.petsc import total
from softgrasp.fem.shown import Card, Shown, percent
from softgrasp.reduction.contact.model import ContactModel, ContactRun
from softgrasp.reduction.replay import FullRun
from softgrasp.reduction.system import ModelError

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model


@dataclass(frozen=True, repr=False)
class ContactErrors(Shown):
    """Errors of a reduced run with contact."""

    z: float
    """|Z - Z_r| / |Z| of the deformation over all nodes and steps [1]."""
    force: float | None
    """|F - F_r| / |F| of the forces of all obstacles over all steps [1]; None where the full run never touches."""

    def card(self) -> Card:
        """Both in percent."""
        force = "no contact" if self.force is None else percent(self.force)
        return Card(
            "Relative errors of a reduced run with contact",
            (("deformation", percent(self.z)), ("forces of the obstacles", force)),
        )


def replay_contact(rom: ContactModel, full: FullRun, model: Model | None = None) -> ContactRun:
    """The reduced run under the hand of a full run. Collective.

    Raises ModelError: the scene of ``model``, or of the run, differs in more than motion and time.
    """
    for each in (full.model,) if model is None else (full.model, model):
        rom.check_scene(each.scene_keys)
    return rom.run(*full.hand, full.dt)


def errors_contact(rom: ContactModel, run: ContactRun, full: FullRun) -> ContactErrors:
    """Errors against a full run. Collective.

    Raises ModelError: the model has no columns on the mesh, or the runs have other steps.
    """
    contact = full.trajectory.contact
    if contact is None or len(run.times) != full.snapshots.Z.shape[1]:
        raise ModelError("the full run has other steps than the reduced one, or no contact")
    Z, off = full.snapshots.Z[: full.snapshots.layout.n_local], 0.0
    for first in range(0, Z.shape[1], 64):  # instants
        part = slice(first, first + 64)
        off += float(((rom.deformation(run, part) - Z[:, part]) ** 2).sum())
    missed, size = total(full.snapshots.layout.comm, np.array([off, float((Z**2).sum())]))
    force = float(np.linalg.norm(contact.force))
    missed_force = float(np.linalg.norm(run.force - contact.force))
    return ContactErrors(float(np.sqrt(missed / size)), missed_force / force if force > 0 else None)
