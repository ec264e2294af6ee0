"""Set-up and solves of every linear solver against the cost model that chooses: ``python -m benchmarks solvers``."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated

import numpy as np
import typer
from mpi4py import MPI

from benchmarks.driver import cpu_seconds
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.midpoint import midpoint_matrix
from softgrasp.fem.solve.costs import FEW_SOLVES, ITERATIVE, SolverName, Work
from softgrasp.fem.solve.solvers import TissueSolver, make_solver
from softgrasp.fem.system import dynamic_stiffness
from softgrasp.study.report.document import number

DT = 5e-3  # [s]
STEP_RTOL = 1e-8  # from zero, what the model's iterations are of
STATIC_RTOL = 1e-12
STEPS = 200
REPEATS = 5
KINDS = "3D P1,3D P2,3D P3,2D P1,2D P2"
HELP = f"""Measure set-up and solves of every solver in processor time on one rank, beside the model of fem.solve.costs.

Steps of {DT} s and static solves of a block in 3D and of the paper's block in 2D. A ratio of 1 is the model's time;
solves of cg and stars are from zero to {STEP_RTOL:g}, static ones to {STATIC_RTOL:g}. The solver that the model chooses
for {STEPS} steps and for {FEW_SOLVES} static solves is compared with the fastest one here.
"""
Sizes = Annotated[str, typer.Option(help="cells along the shortest edge of P2, with commas")]
Kinds = Annotated[str, typer.Option(help="dimension and order, with commas")]
Poisson = Annotated[float, typer.Option(help="Poisson's ratio in 3D")]


@dataclass(frozen=True)
class Row:
    """One solver on one mesh, for one kind of solves."""

    kind: str  # dimension and order
    solves: str  # kind of solves
    n_e: int  # unknowns
    solver: SolverName  # solver that was measured
    iterations: int  # iterations of a solve; 0 by a factor
    setup: float  # processor time [s]
    solve: float  # processor time, the median [s]
    setup_ratio: float  # measured over modelled
    solve_ratio: float  # measured over modelled
    total: float  # processor time of the set-up and all solves; of steps with the model's share of iterations [s]
    chosen: bool  # whether the model chooses it


def models(sizes: list[int], kinds: Sequence[str], poisson: float) -> Iterator[tuple[str, int, Model]]:
    """Blocks of each dimension and order, with its name and its order."""
    material = f"tissue.material={{young=69e3, poisson={poisson}, rho=1070.0}}"
    for m, kind in product(sizes, kinds):
        order = int(kind[-1])
        k = round(2 * m / order)  # the same unknowns for every order
        space = [f"tissue.order={order}", "tissue.refine=false"]
        if kind.startswith("3D"):
            cells = f"tissue.cells=[{round(4 * k / 3)}, {k}, {round(8 * k / 3)}]"
            yield kind, order, build("block_3d", [*space, cells, material], MPI.COMM_SELF)
        else:
            yield kind, order, build("paper_forward", [*space, f"tissue.cells=[{10 * k}, {20 * k}]"], MPI.COMM_SELF)


def measure(kind: str, order: int, model: Model) -> Iterator[Row]:
    """A row for every solver in the model of costs at this size, of steps and of static solves."""
    system = model.system
    layout = system.layout
    for few, solves, rtol in ((False, STEPS, STEP_RTOL), (True, FEW_SOLVES, STATIC_RTOL)):
        work = Work(layout.n_e, layout.dimension, order, 1, solves, few, system.contrast)
        for name in work.candidates():
            S, made = dynamic_stiffness(system, 0.0) if few else midpoint_matrix(system, DT), list[TissueSolver]()
            setup = cpu_seconds(lambda: made.append(make_solver(S, name, layout, "bench_", rtol)))  # noqa: B023
            solver = made[0]
            r, w = solver.S.createVecs()
            r.array_w[:] = system.G[:, 0]
            solve = statistics.median(cpu_seconds(lambda: solver.solve(r, w)) for _ in range(REPEATS))  # noqa: B023
            count, share = 0, 1.0
            if name in ITERATIVE:
                count = int(solver.ksp.getIterationNumber())
                share = 1.0 if few else work.share(name)
            solver.destroy()
            ratios = setup / work.setup(name), share * solve / work.solve(name)
            total = setup + solves * share * solve
            words = "static" if few else "steps"
            yield Row(kind, words, layout.n_e, name, count, setup, solve, *ratios, total, name == work.solver())


def lost(rows: Sequence[Row]) -> float:
    """Time of the chosen solver over that of the fastest one of the same mesh and solves [1]."""
    return next(row.total for row in rows if row.chosen) / min(row.total for row in rows)


def main(sizes: Sizes = "3,6", kinds: Kinds = KINDS, poisson: Poisson = 0.49) -> None:
    """Measure and print."""
    head = f"{'elements':9}{'solves':8}{'n_e':>8}  {'solver':9}{'iterations':>10}{'set-up [s]':>12}{'solve [s]':>12}"
    print(f"{head}{'all [s]':>10}  measured / model")  # noqa: T201
    ratios, losses = list[float](), list[float]()
    for kind, order, model in models([int(size) for size in sizes.split(",")], kinds.split(","), poisson):
        rows = list(measure(kind, order, model))
        for row in rows:
            ratios += [row.setup_ratio, row.solve_ratio]
            print(  # noqa: T201
                f"{row.kind:9}{row.solves:8}{row.n_e:8d}  {row.solver:9}{row.iterations:10d}{number(row.setup):>12}"
                f"{number(row.solve):>12}{number(row.total):>10}  {row.setup_ratio:.2f}, {row.solve_ratio:.2f}"
                f"{', chosen' if row.chosen else ''}"
            )
        losses += [lost([row for row in rows if row.solves == words]) for words in ("steps", "static")]
    spread = np.exp(np.abs(np.log(ratios)).mean())
    print(f"The error of the model is a factor of {spread:.2g} in the geometric mean.")  # noqa: T201
    text = f"{sum(loss == 1 for loss in losses)} of {len(losses)} times the solver that it chooses is the fastest"
    print(f"{text}; at worst it takes {max(losses):.2f} times as long as the fastest one.")  # noqa: T201
