"""Tissue solves at real shifts: S(-s) = s^2 M_ee + s D_ee + K_ee, symmetric positive definite for s >= 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from softgrasp.fem.petsc import Array, Complex
from softgrasp.fem.solve.solvers import TissueSolver, make_solver, work_of
from softgrasp.fem.solve.stiffness import static_columns
from softgrasp.fem.system import BlockSystem, dynamic_stiffness
from softgrasp.lqr.lowrank.shifted import PREFIX, ShiftedTissue
from softgrasp.lqr.plant.operators import least_beta

# Relative residual of an iterated response [1]: a direction of a Galerkin space needs no more, whose model is made of
# exact products. Gains with 1e-8 and 1e-12 differ by less than 1e-9.
RESPONSE_RTOL = 1e-8
# Damping ratio of the lowest mode left out from which real shifts serve: below, poles lie near the imaginary axis and
# responses at real shifts no longer resolve them. At 0.11 real shifts take as many solves as complex ones, at 0.01 the
# error of the gain stays 1e-5 however many there are.
DAMPED = 0.1


def well_damped(system: BlockSystem, omega: float) -> bool:
    """Whether every mode from ``omega`` [1/s] on has a damping ratio of :data:`DAMPED` or more."""
    return least_beta(system) * omega / 2 >= DAMPED


class DefiniteTissue(ShiftedTissue):
    """A factor, or multigrid where that takes less time, for each shift p = -s.

    Args:
        system: system of the tissue.
        columns: number of right-hand sides of a shift.
    """

    name = "definite"

    def __init__(self, system: BlockSystem, columns: int) -> None:
        super().__init__(system)
        self.system, self.columns = system, columns
        self.shift: complex = 0j
        self.solver: TissueSolver | None = None

    def _factor(self, shifts: list[complex]) -> None:
        """Set up the solver of the first shift; K_ee has its own."""
        p = shifts[0]
        assert p.imag == 0
        assert p.real <= 0
        if p == self.shift:
            return
        self.destroy()
        layout = self.system.layout
        work = work_of(layout, self.columns, True, self.system.contrast if self.system.materials else 1.0)
        fitting = replace(work, few=False).choose(self.system.memory)
        name = min(fitting, key=work.seconds)
        self.solver = make_solver(dynamic_stiffness(self.system, -p.real), name, layout, PREFIX, RESPONSE_RTOL)
        self.shift, self.package = p, self.solver.package
        self.factors += 1

    def _solve_each(self, shifts: Sequence[complex], rights: Sequence[Array | Complex]) -> list[Complex]:
        (F,) = rights
        right = np.asfortranarray(F.real)
        answer = static_columns(self.system, right) if self.solver is None else self.solver.columns(right)
        return [answer.astype(complex)]

    def destroy(self) -> None:
        """Free the solver. Collective."""
        if self.solver is not None:
            self.solver.destroy()
        self.solver, self.shift = None, 0j
