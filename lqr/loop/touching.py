"""A closed loop whose tissue meets obstacles that its design does not contain.

A step without contact is solved under the law first; then the obstacles press. A sampled input is known before the
step, and nothing else changes. A continuous one depends on the midpoint, which the forces x of the obstacles move:

    u = clip(u_bar + K (x_mid(u, x) - x_bar)),   0 <= x,  g(u, x) >= 0,  x'g = 0   at the end of the step.

Rounds solve it: each begins anew from the step without contact, moved by L^-1 (u - u_0), lets the obstacles press, and
updates the input towards that of the law by the secant method of Broyden [Broyden65], from (I - F L^-1)^-1 of the loop
without contact. At the end both law and contact are satisfied.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem.errors import SolverError
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.contact.general import Contact
from softgrasp.fem.run.contact.rest import resting
from softgrasp.fem.run.contact.step import begin_contact
from softgrasp.fem.run.contact.touching import Touching
from softgrasp.fem.run.midpoint import TissueState
from softgrasp.lqr.loop.drive import GainDrive, ImplicitDrive
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import PlantState

if TYPE_CHECKING:
    from softgrasp.fem.model.build import Model

MOST = 60  # rounds of a step
CLOSE = 1e-11  # difference of input and law over the largest part of either, which rounding in K x allows [1]


class TouchingDrive:
    """A drive whose steps contact corrects; q, v and u are the arrays of the drive.

    Attributes:
        c: coefficients of the load G c of each step, (steps, n_s).
        most: largest part of the input seen, the scale of `CLOSE` [N, N m].
        w: half the change of z in the step without contact, on the rows here [m].
        r: right-hand side of that step, on the rows here.
    """

    def __init__(self, drive: GainDrive, contact: Contact, scene: Model) -> None:
        self.drive, self.contact, self.time, self.plant = drive, contact, scene.scene.time, drive.plant
        self.q, self.v, self.u, self.c = drive.q, drive.v, drive.u, np.zeros_like(drive.u)
        self.most = float(np.abs(drive.offset).max())
        self.w, self.r = (array.copy() for array in (self.plant.midpoint.w_array, self.plant.midpoint.r_array))

    def settled(self, start: PlantState) -> PlantState:
        """The start, at rest on the obstacles where the scene starts in equilibrium. Collective."""
        if self.time.start != "equilibrium":
            return start
        return PlantState(start.q_s, start.v_s, resting(self.contact, start.q_s, self.time), start.v_z)

    def release(self) -> None:
        """Let nothing touch in the runs that come. Collective."""
        assert isinstance(self.plant.midpoint, Touching)
        self.plant.midpoint.contact = None
        self.contact.destroy()

    def solve(self, n: int, state: TissueState) -> None:
        """One step. Collective. Raises SolverError: the rounds of contact, or those of the law, do not end."""
        drive, midpoint = self.drive, self.plant.midpoint
        drive.solve(n, state)
        self.c[n] = midpoint.c
        if not isinstance(drive, ImplicitDrive):
            self.contact.press(n, self)
            return
        self.w[:], self.r[:] = midpoint.w_array, midpoint.r_array
        before = self.c[n].copy(), self.q[n + 1].copy(), self.v[n + 1].copy(), self.contact.table.energy.copy()
        self.contact.press(n, self)
        if self.contact.table.touching[n].any():
            self._agree(n, drive, state, before)

    def _agree(self, n: int, drive: ImplicitDrive, state: TissueState, before: tuple[Array, ...]) -> None:
        """Find the input that is the law at the midpoint of the step with contact. Collective."""
        u, first, J = self.u[n], self.u[n].copy(), drive.input.inverse.copy()
        left = drive.law(n, state) - u
        for _ in range(MOST):
            self.most = max(self.most, float(np.abs(u).max()))
            if np.abs(left).max() <= CLOSE * self.most:
                return
            last, asked = u.copy(), left
            u += J @ left
            if drive.bound is not None:
                np.clip(u, -drive.bound, drive.bound, out=u)
            self._again(n, u - first, before)
            left = drive.law(n, state) - u
            du, df = u - last, asked - left
            if abs(size := du @ J @ df) > 0:
                J += np.outer(du - J @ df, du @ J) / size
        raise SolverError(
            f"feedback and the forces of obstacles do not agree after {MOST} rounds; use a smaller time step, or "
            "control.loop.sampling = 'held'"
        )

    def _again(self, n: int, du: Array, before: tuple[Array, ...]) -> None:
        """The step under an input that differs by du from the first one, with its contact. Collective."""
        plant, midpoint, table = self.plant, self.plant.midpoint, self.contact.table
        c, q, v, table.energy[:] = before
        a = plant.inverse @ du
        w, r = midpoint.w.array_w, midpoint.r.array_w  # PETSc sees that they change
        w[:] = self.w - midpoint.Y @ (plant.kappa * a)
        r[:] = self.r - midpoint.G @ (plant.kappa * a)
        self.c[n] = c - plant.kappa * a
        midpoint.c = self.c[n]
        self.q[n + 1], self.v[n + 1] = q + plant.dt**2 / 2 * a, v + plant.dt * a
        for each in (table.force, table.touching, table.hand):
            each[n] = 0.0
        self.contact.press(n, self)


def touching_drive(scene: Model | None, drive: GainDrive, steps: int) -> TouchingDrive:
    """The drive of a loop whose tissue meets the obstacles of a scene. Collective.

    Raises:
        ControlError: the loop was made without a scene or with one of another size or without contact, or its plant has
            finite strain.
        SceneError: a path of an obstacle does not fit.
    """
    if scene is None:
        raise ControlError("the loop has no obstacles; make it with ClosedLoop(..., scene=model)")
    plant, mine, its = drive.plant, scene.system.layout, drive.plant.system.layout
    if not scene.scene.effects.obstacles:
        raise ControlError("the model of ClosedLoop(..., scene=model) has effects.obstacles = false; set it to true")
    if (mine.n_e, mine.n_s) != (its.n_e, its.n_s):
        raise ControlError(
            f"the model of ClosedLoop(..., scene=model) has {mine.n_e} unknowns and {mine.n_s} of the hand, the plant "
            f"{its.n_e} and {its.n_s}; give the model of the same mesh and hand"
        )
    if plant.system.points is not None:
        raise ControlError("a loop at finite strain cannot meet obstacles yet; set one of the two effects to false")
    hand = plant if plant.system.two_way else None
    return TouchingDrive(drive, begin_contact(scene, plant.midpoint, steps, hand), scene)
