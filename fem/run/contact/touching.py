"""What contact adds to the end of a step, linear or of finite strain, and to its restart file."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from softgrasp.fem.petsc import Array, PETSc
from softgrasp.fem.run.contact.landing import Landing, Landings
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState

if TYPE_CHECKING:
    from softgrasp.fem.run.contact.general import Contact


class Touching(TissueMidpoint):
    """What a step with contact does at its end; ``contact`` is set before the start, and None lets nothing touch."""

    SUBTREES: ClassVar[bool] = False
    contact: Contact | None = None

    def _prepare(self) -> None:
        super()._prepare()
        self.landings = Landings(self.system.materials)

    def solve_by(self, solve: Callable[[PETSc.Vec, PETSc.Vec], None]) -> None:
        """Let `solve_midpoint` do this with r and w in the place of a solve; who asks for it completes w."""
        self._solve = solve

    def advance(self, old: TissueState, new: TissueState) -> None:
        """Write the new state, carry k and r on, and stop what is pressed. Collective."""
        contact = self.contact
        if contact is None:
            super().advance(old, new)
            return
        landing = Landing.of(self, old) if self.landings.has(contact.table, contact.n) and self.mends() else None
        super().advance(old, new)
        contact.finish(new)
        if landing is not None:
            landing.finish(self, new)
        contact.table.add()
        contact.table.show(contact.n + 1, contact.pressing)

    def mends(self) -> bool:
        """Whether the momentum of a step can lose its residual: K, M and their multiples are all that S has."""
        return self.system.points is None and self.operators.D is None

    def load_size(self) -> float:
        """See :meth:`TissueMidpoint.load_size`: with the forces of obstacles, which may balance. Collective."""
        pressing = 0.0 if self.contact is None else float(np.linalg.norm(self.contact.pressing()))
        return super().load_size() + pressing

    def restart_arrays(self) -> dict[str, Array]:
        """Further arrays of a restart file: those of the step, then record and sets of the contact."""
        assert self.contact is not None
        step, contact = super().restart_arrays(), self.contact.restart_arrays()
        table, own = contact["solver_rows"], step.get("solver_numbers", np.zeros(0))
        head = np.array([len(own), *table.shape], dtype=float)
        return {**step, "solver_numbers": np.concatenate([head, own, table.ravel(), contact["solver_numbers"]])}

    def restore(self, rows: Array | None, numbers: Array | None) -> None:
        """Continue with what `restart_arrays` returned, after `adopt`. Collective."""
        if numbers is None:
            return
        assert self.contact is not None
        count, *shape = (int(x) for x in numbers[:3])
        own, table, sets = np.split(numbers[3:], np.cumsum([count, shape[0] * shape[1]]))
        super().restore(rows, own)
        self.contact.restore(table.reshape(shape), sets)
        for n in range(shape[0]):
            self.landings.has(self.contact.table, n)

    def destroy(self) -> None:
        """Free all PETSc objects. Collective."""
        if self.contact is not None:
            self.contact.destroy()
        super().destroy()
