"""What contact adds to the end of a step, linear or of finite strain, and to its restart file."""

from __future__ import annotations

import numpy as np

from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.general import Contact
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState


class Touching(TissueMidpoint):
    """What a step with contact does at its end; ``contact`` is set before the start."""

    contact: Contact

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write the new state, carry k and r on, and stop what is pressed. Collective."""
        super().advance(old, new)
        self.contact.finish(new)

    def restart_arrays(self) -> dict[str, Array]:
        """Further arrays of a restart file: those of the step, then record and sets of the contact."""
        step, contact = super().restart_arrays(), self.contact.restart_arrays()
        table, own = contact["solver_rows"], step.get("solver_numbers", np.zeros(0))
        head = np.array([len(own), *table.shape], dtype=float)
        return {**step, "solver_numbers": np.concatenate([head, own, table.ravel(), contact["solver_numbers"]])}

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what `restart_arrays` returned, after `adopt`. Collective."""
        if numbers is None:
            return
        count, *shape = (int(x) for x in numbers[:3])
        own, table, sets = np.split(numbers[3:], np.cumsum([count, shape[0] * shape[1]]))
        super().restore(rows, own)
        self.contact.restore(table.reshape(shape), sets)

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        self.contact.destroy()
        super().destroy()
