"""Set-up and solves of every linear solver against the cost model that chooses: ``python -m benchmarks solvers``."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import typer
from mpi4py import MPI

from benchmarks.driver import cpu_seconds
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.solve.costs import GUESSED, ITERATIVE, SolverName, Work
from softgrasp.fem.solve.solvers import TissueSolver, make_solver
from softgrasp.study.report.document import number

DT = 5e-3  # [s]
STEP_RTOL = 1e-8  # from zero, what the model's iterations are of
REPEATS = 5
HELP = f"""Measure set-up and solves of every solver in processor time on one rank, beside the model of fem.solve.costs.

Steps of {DT} s of a silicone block in 3D (nu = 0.49) and of the paper's block in 2D. A ratio of 1 is the model's time;
solves of cg and stars are from zero to {STEP_RTOL:g}.
"""
Sizes = Annotated[str, typer.Option(help="cells along the shortest edge, with commas")]


@dataclass(frozen=True)
class Row:
    """One solver on one mesh."""

    kind: str  # dimension and order
    n_e: int  # unknowns
    solver: SolverName  # solver that was measured
    iterations: int  # iterations of a solve; 0 by a factor
    setup: float  # processor time [s]
    solve: float  # processor time, the median [s]
    setup_ratio: float  # measured over modelled
    solve_ratio: float  # measured over modelled


def models(sizes: list[int]) -> Iterator[tuple[str, int, Model]]:
    """Blocks of each dimension and order, with its name and its order."""
    for m in sizes:
        for order in (1, 2):
            k = m if order == 2 else 2 * m  # the same unknowns in both
            cells = f"tissue.cells=[{4 * k // 3}, {k}, {8 * k // 3}]"
            nearly = "tissue.material={young=69e3, poisson=0.49, rho=1070.0}"
            space = ["tissue.refine=false", f"tissue.order={order}", cells, nearly]
            yield f"3D P{order}", order, build("block_3d", space, MPI.COMM_SELF)
            flat = [f"tissue.order={order}", f"tissue.cells=[{10 * k}, {20 * k}]"]
            yield f"2D P{order}", order, build("paper_forward", flat, MPI.COMM_SELF)


def measure(kind: str, order: int, model: Model) -> Iterator[Row]:
    """A row for every solver in the model of costs at this size."""
    system = model.system
    layout = system.layout
    work = Work(layout.n_e, layout.dimension, order, 1, 1, False, system.contrast)
    for name in work.candidates():
        S, made = midpoint_matrix(system, DT), list[TissueSolver]()
        setup = cpu_seconds(lambda: made.append(make_solver(S, name, layout, "bench_", STEP_RTOL)))  # noqa: B023
        solver = made[0]
        r, w = solver.S.createVecs()
        r.array_w[:] = system.G[:, 0]
        solve = statistics.median(cpu_seconds(lambda: solver.solve(r, w)) for _ in range(REPEATS))  # noqa: B023
        count, modelled = 0, work.solve(name)
        if name in ITERATIVE:
            count, modelled = int(solver.ksp.getIterationNumber()), modelled / GUESSED[name]
        solver.destroy()
        yield Row(kind, layout.n_e, name, count, setup, solve, setup / work.setup(name), solve / modelled)


def main(sizes: Sizes = "3,6") -> None:
    """Measure and print."""
    head = (
        f"{'elements':9}{'n_e':>8}  {'solver':9}{'iterations':>10}{'set-up [s]':>12}{'solve [s]':>12}  measured / model"
    )
    print(head)  # noqa: T201
    ratios = []
    for kind, order, model in models([int(size) for size in sizes.split(",")]):
        for row in measure(kind, order, model):
            ratios += [row.setup_ratio, row.solve_ratio]
            print(  # noqa: T201
                f"{row.kind:9}{row.n_e:8d}  {row.solver:9}{row.iterations:10d}{number(row.setup):>12}"
                f"{number(row.solve):>12}  {row.setup_ratio:.2f}, {row.solve_ratio:.2f}"
            )
    spread = np.exp(np.abs(np.log(ratios)).mean())
    print(f"The error of the model is a factor of {spread:.2g} in the geometric mean.")  # noqa: T201
