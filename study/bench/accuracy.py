"""Error of the deformation against time, mesh by mesh: ``python -m softgrasp.study.bench accuracy``."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from mpi4py import MPI

from softgrasp import package_version
from softgrasp.fem import _stack as _stack  # threads and MPI before anything numerical
from softgrasp.fem.model.build import Model, Stopwatch, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.feedback import Design, design
from softgrasp.reduction.reduce import reduce_linear
from softgrasp.reduction.replay import full_run, replay_linear
from softgrasp.study.bench.driver import Goal, open_console, show_goals, write_bench
from softgrasp.study.report.origin import machine
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.session import list_files

STEPS, N, METHOD, REPEATS = 600, 20, "craig_bampton", 3
REFERENCE, REFERENCE_COST = 1e-5, 3e-4  # tolerances of the graded P3 meshes of the references; none is a row
EVEN = {1: (16, 32, 64), 2: (8, 16, 32), 3: (8, 16)}  # cells across
GRADED = {1: (0.1, 0.03), 2: (0.03, 0.01, 3e-3, 1e-3), 3: (0.03, 0.01, 1e-3)}  # tolerances of a-priori meshes
SOLVES, RESIDUAL = 60, 1e-10
CONTROL = ("control.method=newton-adi", "effects.damping={kind='kelvin-voigt',beta=0.002}", "time.end=300.0")
HELP = f"""Error of the deformation against time on even and graded meshes of P1, P2 and P3.

For every mesh: a full run of paper_forward with {STEPS} steps, a reduced one ({METHOD}, N = {N}) and the Riccati
equation of paper_lqr by Newton-ADI, each with its time and its error: of the tip against the hand, and of the cost from
the scene's start, both against graded P3 meshes. Some minutes; keep the machine quiet."""


@dataclass(frozen=True)
class Row:
    """One mesh: unknowns; seconds of mesh and assembly, of factor and steps, of a reduced run, of P; errors."""

    mesh: str
    n_e: int
    time_build: float
    time_run: float
    error: float
    time_reduced: float
    error_reduced: float
    time_riccati: float
    error_cost: float
    solves: int
    residual: float


HEADER = (
    "mesh", "n_e", "build [s]", "run [s]", "error", "reduced run [s]", "its error", "Riccati [s]", "error of the cost",
    "solves", "residual",
)  # fmt: skip


def meshes() -> dict[str, list[str]]:
    """Name and ``--set`` of every mesh."""
    result: dict[str, list[str]] = {}
    for order in (1, 2, 3):
        for n in EVEN[order]:
            result[f"even {n} x {2 * n}, P{order}"] = [f"tissue.order={order}", f"tissue.cells=[{n},{2 * n}]"]
        for goal in GRADED[order]:
            result[f"graded {goal:g}, P{order}"] = graded(order, goal)
    return result


def graded(order: int, goal: float) -> list[str]:
    """``--set`` of an a-priori graded mesh."""
    return [f"tissue.order={order}", f"tissue.refine={{tolerance={goal:g},passes=0}}"]


def deformation(model: Model) -> Array:
    """Tip against the hand over the run, (steps + 1, d) [m]. Collective."""
    run = simulate(model)
    return np.asarray(run.outputs - run.outputs_rigid)


def median(task: Callable[[], object]) -> float:
    """Seconds of a task, the median of repeats."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def controlled(sets: list[str]) -> Design:
    """The optimal feedback of paper_lqr on a mesh. Collective."""
    model = build(load_scene("paper_lqr", [*CONTROL, *sets]), comm=MPI.COMM_WORLD)
    return design(model, Stopwatch(MPI.COMM_WORLD))


def measure(name: str, sets: list[str], exact: Array, cost: float) -> Row:
    """One row. Collective.

    Args:
        name: of the mesh.
        sets: that make it.
        exact: deformation of the reference (steps + 1, d) [m].
        cost: of the reference.
    """
    comm, scene = MPI.COMM_WORLD, load_scene("paper_forward", [f"time.steps={STEPS}", *sets])
    model = build(scene, comm=comm)
    full = simulate(model)
    rom = reduce_linear(model, [full_run(model, full)], METHOD, N)
    small = replay_linear(rom, model, full)
    found = controlled(sets)
    scale = np.linalg.norm(exact, axis=1).max()

    def error(y: Array) -> float:
        return float(np.linalg.norm(y - exact, axis=1).max() / scale)

    return Row(
        name,
        model.system.layout.n_e,
        median(lambda: build(scene, comm=comm)),
        median(lambda: simulate(model)),
        error(full.outputs - full.outputs_rigid),
        median(lambda: replay_linear(rom, model, full)),
        error(small.outputs - full.outputs_rigid),
        found.solution.seconds.get("total", sum(found.solution.seconds.values())),
        abs(found.judge.optimal - cost) / abs(cost),
        found.solution.counts.get("solves", 0),
        found.solution.residual,
    )


def main(
    out: Annotated[Path, typer.Option(help="folder of accuracy.json and accuracy.csv")] = Path("out/bench"),
) -> None:
    """Measure every mesh and print the table."""
    console = open_console(150)
    finest = graded(3, REFERENCE)
    exact = deformation(build(load_scene("paper_forward", [f"time.steps={STEPS}", *finest]), comm=MPI.COMM_WORLD))
    cost = controlled(graded(3, REFERENCE_COST)).judge.optimal
    rows = []
    for name, sets in meshes().items():
        rows.append(measure(name, sets, exact, cost))
        console.print(f"{name}: n_e = {rows[-1].n_e}, error {rows[-1].error:.2e}", style="dim")
    table = Table(HEADER, [astuple(row) for row in rows], "error of the deformation against time")
    console.print(table.terminal())
    goals = [
        Goal("solves of a Riccati equation, graded", max(r.solves for r in rows if "graded" in r.mesh), SOLVES),
        Goal("its residual", max(row.residual for row in rows), RESIDUAL),
        Goal(
            "error on the graded P2 mesh of the tolerance 1e-3",
            next(r.error for r in rows if r.mesh == "graded 0.001, P2"),
            1e-3,
        ),
    ]
    show_goals(console, goals)
    content = {"rows": [asdict(row) for row in rows], "version": package_version(), "machine": machine()}
    list_files(console, write_bench(out, "accuracy", content, table))
