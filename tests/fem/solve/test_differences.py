"""The product with K in a run on several ranks."""

from __future__ import annotations

import pytest
from mpi4py import MPI

from softgrasp.fem import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.midpoint import TissueMidpoint
from softgrasp.fem.solve import differences
from softgrasp.fem.solve.solvers import SolverName


@pytest.mark.ranks
@pytest.mark.parametrize("solver", ["cholesky", "cg"])
def test_ranks_with_and_without_a_compiler_are_refused(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, solver: SolverName
) -> None:
    """With cg the last rank would wait for messages that no other sends; with a factor its bits would differ."""
    code = differences.product_code()
    monkeypatch.setattr(differences, "product_code", lambda: None if comm.rank == comm.size - 1 else code)
    system = build("paper_forward", ["tissue.cells=[4, 4]"], comm=comm).system
    if comm.size == 1:  # all ranks alike
        TissueMidpoint(system, 1e-2, solver).destroy()
        return
    with pytest.raises(SolverError, match=f"rank {comm.size - 1} finds neither a C compiler nor"):
        TissueMidpoint(system, 1e-2, solver)
