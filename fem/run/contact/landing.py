"""The momentum of linear steps in which nodes land, where the residual of a solve would show in the balance.

With rho = r - S w and e = pi - M v, which rounding makes, e_1 = a rho / s - e_0. Where v changes smoothly the work of e
alternates and cancels; where an obstacle stops nodes, and while stiff modes ring behind that, it stays. There the
momentum becomes that of v, and a factor gives back the energy that this and the residual take,

    pi <- (1 + c) M v,   c v'M v = a w'rho - v_1'e_0,   v_1 = 2 s w - v_0 before the impulse.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.fem.material import LayerMaterial, of_layers
from softgrasp.fem.petsc import Array, rows_on_all
from softgrasp.fem.run.contact.record import Tables
from softgrasp.fem.run.energy import wide_product, wide_pull
from softgrasp.fem.run.midpoint import TissueMidpoint, TissueState

RISE = 1 / 8  # nodes that land in a step over those that are pressed then, from which it counts as a landing [1]
JUMP = 100  # stiffness of a layer over that of another, from which any number of nodes counts [1]
MANY = 100  # nodes that land then at the least: fewer leave below 5e-14, and products would double a step's time [1]
AFTER = 16  # steps behind a landing in which its stiff modes still ring [1]
ROUNDING = 1e-8  # a larger factor c is no rounding, and would hide an error [1]


class Landings:
    """Which steps of a run are landings, or close behind one."""

    def __init__(self, materials: Sequence[LayerMaterial]) -> None:
        mu = [m.mu for m in of_layers(materials)]
        self.least = 0 if max(mu) > JUMP * min(mu) else MANY
        self.pressed, self.until = 0, -1

    def has(self, table: Tables, n: int) -> bool:
        """Whether step n is one; ask for every step in turn."""
        if n == 0:
            self.pressed, self.until = 0, -1
        pressed = sum(table.touching[n].tolist())
        if pressed - self.pressed > max(RISE * pressed, self.least):
            self.until = n + AFTER
        self.pressed = pressed
        return n <= self.until


@dataclass(frozen=True)
class Landing:
    """Such a step, as it was before its end."""

    v: Array  # velocity at its start, on the owned rows, (n_local,) [m/s]
    r: Array  # right-hand side of its solve, on the owned rows, (n_local,) [N]

    @staticmethod
    def of(midpoint: TissueMidpoint, old: TissueState) -> Landing:
        """Keep what the end of the step overwrites."""
        return Landing(old.v.array_r.copy(), midpoint.r_array[midpoint.operators.rows].copy())

    def finish(self, midpoint: TissueMidpoint, new: TissueState) -> None:
        """Set the momentum to that of v. Collective."""
        system, s = midpoint.system, np.longdouble(midpoint.s)
        comm, n = system.layout.comm, system.layout.n_local
        w, v = midpoint.owned(), new.array[n:]
        moved, speed = (rows_on_all(comm, x) for x in (w, v))
        K, M = system.K_ee, system.M_ee
        rho = self.r - (1 + s * midpoint.beta) * wide_product(K, moved)
        rho -= s * (s + midpoint.alpha) * wide_product(M, moved)
        h = midpoint.r_array[midpoint.operators.rows] + system.G.astype(np.longdouble) @ midpoint.pending
        momentum, held = wide_product(M, speed), 0.0 if system.own_load is None else system.own_load
        late = (h + wide_pull(midpoint, new)[1] - held) / s - momentum
        early = midpoint.a / s * rho - late
        given = midpoint.a * (w @ rho) - (2 * s * w - self.v) @ early
        work, twice = (float(comm.allreduce(x)) for x in (given, v @ momentum))
        if not abs(work) <= ROUNDING * twice:
            return
        change = s * ((work / twice * momentum if work else 0.0) - late)
        midpoint.r.array_w[:] += midpoint.operators.gather(change.astype(float))
