"""The midpoint step that a system needs, and the store of its states."""

from __future__ import annotations

from pathlib import Path

from softgrasp.fem.errors import SolverError
from softgrasp.fem.run.inexact import InexactMidpoint
from softgrasp.fem.run.midpoint import TissueMidpoint
from softgrasp.fem.run.states.snapshots import MemoryStore, NoStore
from softgrasp.fem.solve.costs import STEP_RTOL
from softgrasp.fem.solve.solvers import ITERATIVE, Reproducible, SolverName
from softgrasp.fem.system import BlockSystem


def make_midpoint(
    system: BlockSystem,
    dt: float,
    solver: SolverName,
    rtol: float | None = None,
    reproducible: Reproducible = "auto",
    touching: bool = False,
) -> TissueMidpoint:
    """The step of a system, linear or of finite strain; arguments as for `TissueMidpoint`. Collective.

    ``rtol``: None for that of the solver, `STEP_RTOL`; Newton's method, which has a tolerance of its own, uses 1e-4.
    ``touching``: contact with obstacles acts on the step. Raises SolverError: the solver cannot do that.
    """
    if touching:
        if solver in ITERATIVE:
            raise SolverError(
                f"contact needs a factor of the step, and '{solver}' has none; use time.solver = 'mumps' and "
                "the memory for it, or a coarser mesh"
            )
        if system.points is not None:
            from softgrasp.fem.run.contact.finite import FiniteContactMidpoint  # few scenes pay for it

            return FiniteContactMidpoint(system, dt, solver, reproducible=reproducible)
        from softgrasp.fem.run.contact.step import ContactMidpoint  # only scenes with contact pay for it

        return ContactMidpoint(system, dt, solver, reproducible=reproducible)
    if system.frame is not None:
        from softgrasp.fem.run.frame.midpoint import LinearTurningStep, TurningStep  # only such scenes pay for it

        step = LinearTurningStep if system.points is None else TurningStep
        return step(system, dt, solver, STEP_RTOL["stars"] if rtol is None else rtol, reproducible)
    if rtol is None:
        rtol = STEP_RTOL["stars"] if system.points is not None else STEP_RTOL.get(solver, STEP_RTOL["cg"])
    if system.points is None and solver in ITERATIVE:
        return InexactMidpoint(system, dt, solver, rtol, reproducible)
    if system.points is None:
        return TissueMidpoint(system, dt, solver, rtol, reproducible)
    from softgrasp.fem.run.finite_strain import FiniteStrainMidpoint  # only scenes with finite strain pay for it

    return FiniteStrainMidpoint(system, dt, solver, rtol, reproducible)


def make_store(
    system: BlockSystem, kind: str, steps: int, every: int, directory: Path, run: str | None, few: int | None = None
) -> NoStore:
    """Store of a run: memory, hdf5 or none; ``run`` is the name of a new run, None resumes. Collective.

    ``few``: states that "auto" keeps; None keeps all.
    """
    if kind in ("auto", "memory"):
        return MemoryStore(system, steps, every, few if kind == "auto" else None)
    if kind == "hdf5":
        from softgrasp.fem.run.states.streamed import Hdf5Store  # brings h5py

        return Hdf5Store(system, steps, every, directory, run)
    return NoStore(system)
