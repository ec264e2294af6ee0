"""PETSc options of the user reach every solver, on every number of ranks."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import SolverError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.solve.solvers import SolverName, make_solver
from tests.helpers.models import make_scene

ROOT = Path(__file__).parents[3]
MIDPOINT = "softgrasp_midpoint_"
ITERATION = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-12, "ksp_max_it": 2000}


@contextmanager
def given(prefix: str, options: dict[str, object]) -> Iterator[None]:
    """Options as PETSC_OPTIONS would set them."""
    database = PETSc.Options(prefix)
    for key, value in options.items():
        database[key] = value
    try:
        yield
    finally:
        for key in options:
            database.delValue(key)


LU = {"pc_type": "lu"}
CASES = [  # on one rank each, and spread
    ("cholesky", True, LU),
    ("cholesky", True, ITERATION),
    ("mumps", True, LU),
    ("mumps", False, LU),
    ("mumps", False, ITERATION),
    ("cg", True, ITERATION),
    ("stars", True, LU),
]


@pytest.mark.ranks(2)
@pytest.mark.parametrize(("name", "reproducible", "options"), CASES)
def test_options_win_and_the_run_is_the_same(
    comm: MPI.Intracomm, name: SolverName, reproducible: bool, options: dict[str, object]
) -> None:
    time = {"steps": 6, "solver": name, "rtol": 1e-12, "reproducible": reproducible}
    model = build(make_scene({"time": time, "tissue": {"order": 2}}), comm=comm)
    plain = simulate(model)
    with given(MIDPOINT, options):
        asked = simulate(model)
        solver = make_solver(model.system.K_ee.copy(), name, model.system.layout, MIDPOINT)
        assert solver.ksp.getPC().getType() == options["pc_type"]
        solver.destroy()
    assert "softgrasp_midpoint_pc_type" in asked.solver.reason
    assert "softgrasp" not in plain.solver.reason
    scale = np.abs(plain.outputs - plain.outputs[:, :1]).max()
    assert np.abs(asked.outputs - plain.outputs).max() < 1e-8 * scale  # residuals 1e-12, condition about 1e3


@pytest.mark.ranks(2)
@pytest.mark.parametrize("name", ["cholesky", "cg"])
def test_an_iteration_that_does_not_converge_is_an_error(comm: MPI.Intracomm, name: SolverName) -> None:
    model = build(make_scene({"time": {"steps": 6, "solver": name}}), comm=comm)
    words = r"no convergence after 2 iterations .* change the PETSc options -softgrasp_midpoint_\*"
    with given(MIDPOINT, ITERATION | {"ksp_max_it": 2}), pytest.raises(SolverError, match=words):
        simulate(model)


@pytest.mark.serial
def test_the_page_lists_every_prefix() -> None:
    """Prefixes as they stand in the source, whatever names them."""
    code = "\n".join(path.read_text() for room in ("fem", "reduction", "lqr") for path in (ROOT / room).rglob("*.py"))
    page = (ROOT / "docs" / "guide" / "petsc.md").read_text()
    used = set(re.findall(r'"(softgrasp_[a-z]+_)"', code))
    assert used - {"softgrasp_"} == set(re.findall(r"^\| `(softgrasp_\w+_)`", page, re.MULTILINE))
