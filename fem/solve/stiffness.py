"""K_ee factored once for all that need it: equilibrium, sag, modes, estimate of the mesh."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from softgrasp.fem.petsc import Array
from softgrasp.fem.solve.solvers import (
    ITERATIVE,
    Reproducible,
    SolverName,
    TissueSolver,
    choose_solver,
    factor_on_every_rank,
    make_solver,
)

if TYPE_CHECKING:
    from softgrasp.fem.system import BlockSystem

# Unknowns up to which the factor stays with the system, beside that of the steps: about 0.5 GiB in 2D and 1 GiB in 3D.
KEPT_LIMIT = {1: 400_000, 2: 400_000, 3: 100_000}
PREFIX = "softgrasp_stiffness_"


@contextmanager
def factored_stiffness(
    system: BlockSystem,
    solver: SolverName | None = None,
    rtol: float = 1e-12,
    reproducible: Reproducible = "auto",
) -> Iterator[TissueSolver]:
    """K_ee, factored (or the set-up of cg and stars) on the first request, and kept while it is small. Collective.

    Args:
        solver: its name; None: the one that suits few solves.
        rtol: of cg and stars, where no direct solver fits.

    Raises SolverError: the factorisation fails.
    """
    layout, K = system.layout, system.K_ee
    name = solver or choose_solver(layout, few=True)[0]
    everywhere = factor_on_every_rank(layout, name, reproducible)
    key = (K.handle, K.stateGet(), name, everywhere, rtol if name in ITERATIVE else 0.0)
    kept = system.kept.get("factor")
    if kept is not None and kept[0] == key:
        yield kept[1]
        return
    made = make_solver(K.copy(), name, layout, PREFIX, rtol, reproducible)
    # a factor spread over ranks is freed by all of them at once, which the end of a system cannot promise
    if layout.n_e <= KEPT_LIMIT[layout.dimension] and (everywhere or layout.comm.size == 1):
        if kept is not None:
            kept[1].destroy()
        system.kept["factor"] = key, made, K  # no other matrix can get the handle of one that is referenced
        yield made
        return
    try:
        yield made
    finally:
        made.destroy()


def static_columns(system: BlockSystem, X: Array) -> Array:
    """K_ee^-1 X of local rows (n_local, k), Fortran order; columns of zeros are not solved. Collective.

    Raises SolverError: the factorisation fails, or the solution has a large residual.
    """
    with factored_stiffness(system) as factor:
        return factor.columns(X, "the static solution")
