"""Error of the deformation against time, mesh by mesh: ``python -m benchmarks accuracy``."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI

from benchmarks import driver
from benchmarks.driver import Goal, cpu_seconds
from softgrasp import __version__
from softgrasp.fem import _stack as _stack  # threads and MPI before anything numerical
from softgrasp.fem.accuracy import adapt
from softgrasp.fem.model.build import Model, Stopwatch, build
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import Scene
from softgrasp.lqr.design.feedback import Design, design
from softgrasp.reduction.reduce import reduce_linear
from softgrasp.reduction.replay import full_run, replay_linear
from softgrasp.study.report.origin import machine
from softgrasp.study.shell.session import list_files

STEPS, N, METHOD, REPEATS = 600, 20, "craig_bampton", 3
REFERENCE, REFERENCE_COST = 1e-5, 1e-4  # tolerances of the graded P3 meshes of the references; none is a row
EVEN = {1: (16, 32, 64), 2: (8, 16, 32), 3: (8, 16)}  # cells across
GRADED = {1: (0.1, 0.03), 2: (0.03, 0.01, 3e-3, 1e-3), 3: (0.03, 0.01, 1e-3)}  # tolerances of a-priori meshes
# Most unknowns, seconds of mesh, assembly and run, and the same with estimate and passes, by tolerance with P2
TOLERANCES = {1e-2: (2000, 0.15, 0.15), 1e-3: (6000, 0.5, 1.0), 1e-4: (14000, None, None)}
SOLVES, RESIDUAL = 60, 1e-10
CONTROL = ("control.method=newton-adi", "effects.damping={kind='kelvin-voigt',beta=0.002}", "time.end=300.0")
HELP = f"""Error of the deformation against time on even and graded meshes of P1, P2 and P3.

For every mesh: a full run of paper_forward with {STEPS} steps, a reduced one ({METHOD}, N = {N}) and the Riccati
equation of paper_lqr by Newton-ADI, each with its time and its error: of the tip against the hand, and of the cost from
the scene's start, both against graded P3 meshes; and what the tolerances of [tissue.refine] reach with P2. Seconds are
of the processor, the median of {REPEATS} after a first one; those of Riccati equations are of the clock. Some minutes;
keep the machine quiet."""


@dataclass(frozen=True)
class MeshPoint:
    """One mesh: unknowns; seconds of mesh and assembly, of factor and steps, of a reduced run, of P; errors."""

    mesh: str  # mesh and element order in words
    n_e: int  # number of tissue unknowns
    time_build: float  # processor time of mesh and assembly [s]
    time_run: float  # processor time of factor and steps [s]
    error: float  # error of the deformation [1]
    time_reduced: float  # processor time of a reduced run [s]
    error_reduced: float  # error of the deformation of the reduced run [1]
    time_riccati: float  # wall time of the Riccati solution [s]
    error_cost: float  # relative error of the optimal cost [1]
    solves: int  # number of solves of the Riccati solution
    residual: float  # relative residual of the Riccati solution [1]


@dataclass(frozen=True)
class TolerancePoint:
    """One tolerance: mesh, estimate and bound over the true error, error of the corrected outputs over it; seconds."""

    tolerance: float  # tolerance of [tissue.refine] [1]
    n_e: int  # number of tissue unknowns
    passes: int  # number of passes of refinement
    error: float  # true error of the deformation [1]
    estimate: float  # estimated over true error [1]
    bound: float  # bound over true error [1]
    corrected: float  # error of the corrected outputs over that of the outputs [1]
    time_run: float  # a-priori mesh, assembly and run
    time_all: float  # processor time of run, estimate and further passes [s]


COLUMNS = {
    "mesh": "mesh", "n_e": "n_e", "build [s]": "time_build .2g", "run [s]": "time_run .2g", "error": "error .1e",
    "reduced run [s]": "time_reduced .1g", "its error": "error_reduced .1e", "Riccati [s]": "time_riccati .2g",
    "error of the cost": "error_cost .1e", "solves": "solves", "residual": "residual .0e",
}  # fmt: skip
COLUMNS_REACHED = {
    "tolerance, P2": "tolerance .0e", "n_e": "n_e", "passes": "passes", "error": "error .1e",
    "estimate / error": "estimate .2f", "bound / error": "bound .2f", "corrected / error": "corrected .2f",
    "mesh, assembly, run [s]": "time_run .2g", "with estimate and passes [s]": "time_all .2g",
}  # fmt: skip


def meshes() -> dict[str, list[str]]:
    """Name and ``--set`` of every mesh."""
    result: dict[str, list[str]] = {}
    for order in (1, 2, 3):
        for n in EVEN[order]:
            result[f"even {n} x {2 * n}, P{order}"] = [f"tissue.order={order}", f"tissue.cells=[{n},{2 * n}]"]
        for goal in GRADED[order]:
            result[f"graded {goal:g}, P{order}"] = graded(order, goal)
    return result


def graded(order: int, goal: float, more: str = ",passes=0") -> list[str]:
    """``--set`` of a graded mesh, a-priori unless ``more`` names another method."""
    return [f"tissue.order={order}", f"tissue.refine={{tolerance={goal:g}{more}}}"]


def paper(sets: list[str]) -> Scene:
    """The paper's forward scene on a mesh."""
    return load_scene("paper_forward", [f"time.steps={STEPS}", *sets])


def deformation(run: Trajectory) -> Array:
    """Tip against the hand over the run, (steps + 1, d) [m]."""
    return np.asarray(run.outputs - run.outputs_rigid)


def off(y: Array, exact: Array) -> float:
    """Error of a deformation over the largest one."""
    return float(np.linalg.norm(y - exact, axis=1).max() / np.linalg.norm(exact, axis=1).max())


def median(task: Callable[[], object]) -> float:
    """Processor time of a task [s], the median of repeats after a first one."""
    return statistics.median([cpu_seconds(task) for _ in range(REPEATS + 1)][1:])


def optimal_feedback(sets: list[str]) -> Design:
    """The optimal feedback of paper_lqr on a mesh. Collective."""
    model = build(load_scene("paper_lqr", [*CONTROL, *sets]), comm=MPI.COMM_WORLD)
    return design(model, Stopwatch(MPI.COMM_WORLD))


def measure(name: str, sets: list[str], exact: Array, cost: float) -> MeshPoint:
    """One row, against deformation (steps + 1, d) [m] and cost of the references. Collective."""
    comm, scene = MPI.COMM_WORLD, paper(sets)
    model = build(scene, comm=comm)
    full = simulate(model)
    rom = reduce_linear(model, [full_run(model, full)], METHOD, N)
    small = replay_linear(rom, model, full)
    feedback = optimal_feedback(sets)
    solution = feedback.solution
    return MeshPoint(
        name, model.system.layout.n_e, median(lambda: build(scene, comm=comm)), median(lambda: simulate(model)),
        off(deformation(full), exact), median(lambda: replay_linear(rom, model, full)),
        off(small.outputs - full.outputs_rigid, exact),
        solution.seconds.get("total", sum(solution.seconds.values())),
        abs(feedback.gain_check.optimal - cost) / abs(cost),
        solution.counts.get("solves", 0), solution.residual,
    )  # fmt: skip


def reach(goal: float, exact: Array) -> TolerancePoint:
    """What ``tissue.refine.tolerance`` reaches with quadratic elements, whatever the steps leave. Collective."""
    comm, first, scene = MPI.COMM_WORLD, paper(graded(2, goal)), paper(graded(2, goal, ""))

    def whole() -> Model:
        return adapt.build(scene, comm=comm, steps=False)

    model = whole()
    run, estimate = simulate(model), model.accuracy
    assert estimate is not None
    error = off(deformation(run), exact)
    return TolerancePoint(
        goal, estimate.n_e, estimate.passes, error, estimate.estimate / error, estimate.bound / error,
        off(estimate.corrected(run.outputs) - run.outputs_rigid, exact) / error,
        median(lambda: simulate(build(first, comm=comm))), median(lambda: simulate(whole())),
    )  # fmt: skip


def goals(rows: list[MeshPoint], reached: list[TolerancePoint]) -> list[Goal]:
    """What was to be reached."""
    result = [
        Goal("solves of a Riccati equation, graded", max(r.solves for r in rows if "graded" in r.mesh), SOLVES),
        Goal("its residual", max(row.residual for row in rows), RESIDUAL),
    ]
    for r in reached:
        name, (most, run, whole) = f"tolerance {r.tolerance:g}, P2:", TOLERANCES[r.tolerance]
        result += [Goal(f"{name} error", r.error, r.tolerance), Goal(f"{name} n_e", r.n_e, most)]
        seconds = ((r.time_run, run, "mesh, assembly, run"), (r.time_all, whole, "these, estimate, passes"))
        result += [Goal(f"{name} seconds of {what}", t, limit) for t, limit, what in seconds if limit]
    return result


def main(
    out: Annotated[Path, typer.Option(help="folder of accuracy.json, .csv and .md")] = Path("out/bench"),
) -> None:
    """Measure every mesh and print the tables."""
    console = driver.open_console(150)
    exact = deformation(simulate(build(paper(graded(3, REFERENCE)), comm=MPI.COMM_WORLD)))
    cost = optimal_feedback(graded(3, REFERENCE_COST)).gain_check.optimal
    reached, rows = [reach(goal, exact) for goal in TOLERANCES], []
    for name, sets in meshes().items():
        rows.append(measure(name, sets, exact, cost))
        console.print(f"{name}: n_e = {rows[-1].n_e}, error {rows[-1].error:.2e}", style="dim")
    content: dict[str, Any] = {"rows": rows, "reached": reached}
    table = driver.table_of(rows, COLUMNS, "error of the deformation against time")
    tolerances = driver.table_of(reached, COLUMNS_REACHED, "what tissue.refine.tolerance reaches")
    for part in (table, tolerances):
        console.print(part.terminal())
    aims = goals(rows, reached)
    driver.show_goals(console, aims)
    content |= {"goals": driver.goal_rows(aims), "version": __version__, "machine": machine()}
    markdown = f"{table.markdown()}\n{tolerances.markdown()}"
    list_files(console, driver.write_bench(out, "accuracy", content, table, markdown))
