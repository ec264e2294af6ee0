"""The midpoint step that a system needs."""

from __future__ import annotations

from softgrasp.fem.run.inexact import InexactMidpoint
from softgrasp.fem.run.midpoint import TissueMidpoint
from softgrasp.fem.solve.costs import STEP_RTOL
from softgrasp.fem.solve.solvers import ITERATIVE, Reproducible, SolverName
from softgrasp.fem.system import BlockSystem


def make_midpoint(
    system: BlockSystem, dt: float, solver: SolverName, rtol: float | None = None, reproducible: Reproducible = "auto"
) -> TissueMidpoint:
    """The step of a system, linear or of finite strain; arguments as for `TissueMidpoint`. Collective.

    ``rtol``: None for that of the solver, `STEP_RTOL`; Newton's method, which has a tolerance of its own, takes 1e-4.
    """
    if rtol is None:
        rtol = STEP_RTOL["stars"] if system.points is not None else STEP_RTOL.get(solver, STEP_RTOL["cg"])
    if system.points is None and solver in ITERATIVE:
        return InexactMidpoint(system, dt, solver, rtol, reproducible)
    if system.points is None:
        return TissueMidpoint(system, dt, solver, rtol, reproducible)
    from softgrasp.fem.run.finite_strain import FiniteStrainMidpoint  # only scenes with finite strain pay for it

    return FiniteStrainMidpoint(system, dt, solver, rtol, reproducible)
