"""The balance of a run's energy: work of loads and contact, dissipation, and the energy that they leave unexplained."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.energy import exact_energy
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState

if TYPE_CHECKING:
    from softgrasp.fem.run.contact.general import Contact


class Ledger:
    """E_n = E_0 + work of loads, sum 2 c'G'w, and of contact - energy dissipated, as the midpoint rule keeps it.

    Args:
        midpoint: step of the tissue, after the drive of the hand was made.
        loads: coefficients c of the load G c of each step, (steps, n_s); the run fills them in.
        contact: contact with obstacles, or None.

    Attributes:
        pulls: products G'w of each step on the rows here, (steps + 1, n_s or 2 n_s).
        taken: energy dissipated on the rows here, and work of contact, up to each time [J]; None where both are zero.
        first: energy at the start [J].
    """

    def __init__(self, midpoint: TissueMidpoint, loads: Array, contact: Contact | None = None) -> None:
        self.midpoint, self.loads, self.contact = midpoint, loads, contact
        rows = len(loads) + 1
        self.pulls = np.zeros((rows, len(midpoint.pull())))
        counts = midpoint.system.damping.active or contact is not None
        self.taken = np.zeros((rows, 2)) if counts else None
        self.first = 0.0

    def record(self, n: int) -> None:
        """Keep pull and dissipation of the step that ends at time n. Not collective."""
        self.pulls[n] = self.midpoint.pull()
        if self.taken is not None:
            self.taken[n, 0] = self.midpoint.dissipated
            if self.contact is not None:
                self.taken[n, 1] = self.contact.table.energies[0]

    def start(self, state: TissueState) -> None:
        """Keep the energy of the first state. Collective."""
        self.first = self._energy(state)

    def _energy(self, state: TissueState) -> float:
        """Energy of a state to as many digits as there are [J]. Collective."""
        system = self.midpoint.system
        if system.points is None and system.frame is None:
            return exact_energy(self.midpoint, state)
        return self.midpoint.energy(state)

    def balance(self, n: int) -> tuple[float, float]:
        """Work of loads and contact, and energy dissipated, from the start to step n, the last [J]. Collective."""
        work = self.midpoint.work(self.loads[:n], self.pulls[1 : n + 1])
        contact = 0.0 if self.contact is None else float(self.contact.table.energies[0])
        return self.midpoint.over_ranks(work) + contact, self.midpoint.over_ranks(self.midpoint.dissipated)

    def drift(self, state: TissueState, n: int) -> float:
        """Energy at step n that neither load nor damping explains, over the largest until then. Collective."""
        largest = float(np.abs(self.over_time()[0][: n + 1]).max())
        work, lost = self.balance(n)
        defect = self._energy(state) - self.first - work + lost
        scale = max(largest, abs(work), abs(lost))
        return abs(defect) / scale if scale > 0 else 0.0

    def over_time(self) -> tuple[Array, Array]:
        """Energy, and energy dissipated so far, at each time, (steps + 1,) [J]. Collective."""
        shares, contact = np.zeros((2, len(self.pulls))), np.zeros(len(self.pulls))
        np.cumsum(self.midpoint.works(self.loads, self.pulls[1:]), out=shares[0, 1:])
        if self.taken is not None:
            shares[1], contact = self.taken.T
        if not self.midpoint.operators.whole:
            shares = total(self.midpoint.system.layout.comm, shares)
        return self.first + shares[0] + contact - shares[1], shares[1]
