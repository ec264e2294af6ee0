"""Factors made once for all that need them: K_ee for equilibrium, sag, modes, mesh estimate; K + s D + s^2 M."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, cast

from softgrasp.fem.petsc import Array
from softgrasp.fem.solve.costs import FEW_SOLVES, UNKNOWN
from softgrasp.fem.solve.solvers import (
    ITERATIVE,
    Reproducible,
    SolverName,
    TissueSolver,
    factor_on_every_rank,
    make_solver,
    work_of,
)

if TYPE_CHECKING:
    from softgrasp.fem.system import BlockSystem

# Unknowns up to which the factor stays with the system, beside that of the steps: about 0.5 GiB in 2D and 1 GiB in 3D.
KEPT_LIMIT = {1: 400_000, 2: 400_000, 3: 100_000}
PREFIX = "softgrasp_stiffness_"
SHARED = "shared factors"  # key of those in system.kept, by name with what they belong to


class Shared(Protocol):
    """A factor, or what holds one."""

    def destroy(self) -> None:
        """Free it. Collective."""


@contextmanager
def sharing_factors(system: BlockSystem, large: bool = True) -> Iterator[None]:
    """Factors made inside stay with the system to the end of the block, on any ranks. Collective.

    ``large``: those of more than `KEPT_LIMIT` unknowns too.
    """
    if SHARED in system.kept or not (large or system.layout.n_e <= KEPT_LIMIT[system.layout.dimension]):
        yield
        return
    shared: dict[str, tuple[object, Shared]] = {}
    system.kept[SHARED] = shared
    try:
        yield
    finally:
        del system.kept[SHARED]
        for _, solver in shared.values():
            solver.destroy()


@contextmanager
def shared_factor[S: Shared](system: BlockSystem, name: str, key: object, make: Callable[[], S]) -> Iterator[S]:
    """The last factor of a name if its key is this one; else a new one, freed at the end unless shared. Collective."""
    shared = system.kept.get(SHARED)
    old = None if shared is None else shared.get(name)
    if old is not None and old[0] == key:
        yield cast(S, old[1])  # names stand for types too
        return
    if shared is not None and old is not None:
        del shared[name]
        old[1].destroy()
    made = make()
    if shared is not None:
        shared[name] = key, made
    try:
        yield made
    finally:
        if shared is None:
            made.destroy()


def resting_solves(n: int, dimension: int) -> int:
    """Static solves that an equilibrium is counted as: those of all that share its factor, where that is kept."""
    return FEW_SOLVES if n <= KEPT_LIMIT[dimension] else 1


def static_solver(system: BlockSystem, requested: str = "auto", solves: int = FEW_SOLVES) -> SolverName:
    """The solver of the least modelled time for static solves with K_ee, or K_ee + s D_ee + s^2 M_ee."""
    # tangents of finite strain may lose definiteness, which a factor reports
    known = bool(system.materials) and system.points is None
    work = work_of(system.layout, solves, True, system.contrast if known else UNKNOWN)
    return replace(work, graded=system.graded).solver(requested, system.memory)


@contextmanager
def factored_stiffness(
    system: BlockSystem,
    solver: SolverName | None = None,
    rtol: float = 1e-12,
    reproducible: Reproducible = "auto",
) -> Iterator[TissueSolver]:
    """K_ee, factored (or the set-up of cg and stars) on the first request, and kept while it is small. Collective.

    Args:
        solver: its name; None: that of :func:`static_solver`.
        rtol: of cg and stars, where no direct solver fits.

    Raises SolverError: the factorisation fails.
    """
    layout, K = system.layout, system.K_ee
    name = solver or static_solver(system)
    everywhere = factor_on_every_rank(layout, name, reproducible)
    key = (K.handle, K.stateGet(), name, everywhere, rtol if name in ITERATIVE else 0.0)
    kept = system.kept.get("factor")
    if kept is not None and kept[0] == key:
        yield kept[1]
        return

    def make() -> TissueSolver:
        return make_solver(K.copy(), name, layout, PREFIX, rtol, reproducible)

    # a factor spread over ranks is freed by all of them at once, which the end of a system cannot promise
    if layout.n_e <= KEPT_LIMIT[layout.dimension] and (everywhere or layout.comm.size == 1):
        if kept is not None:
            kept[1].destroy()
        system.kept["factor"] = key, make(), K  # no other matrix can get the handle of one that is referenced
        yield system.kept["factor"][1]
        return
    with shared_factor(system, "stiffness", key, make) as factor:
        yield factor


def static_columns(system: BlockSystem, X: Array) -> Array:
    """K_ee^-1 X of local rows (n_local, k), Fortran order; columns of zeros are not solved. Collective.

    Raises SolverError: the factorisation fails, or the solution has a large residual.
    """
    with factored_stiffness(system) as factor:
        return factor.columns(X, "the static solution")
