"""What stands behind the sizes at which softgrasp changes its method: ``python -m softgrasp.study.bench switches``."""

from __future__ import annotations

import itertools
import operator
import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass, fields, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI

import softgrasp.fem.petsc
import softgrasp.fem.solve.solvers
import softgrasp.lqr.lowrank.modal_start
import softgrasp.lqr.lowrank.shifted
import softgrasp.lqr.riccati
import softgrasp.reduction.online
from softgrasp.fem.model.build import build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array, PETSc, times_columns, to_scipy
from softgrasp.fem.run.midpoint import TissueMidpoint, state_on
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene_collective, shipped_scenes
from softgrasp.fem.solve.solvers import SolverName
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.lowrank.modal_start import plant_modes, restrict, solve_small
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.lowrank.plant import Plant
from softgrasp.lqr.lowrank.shifted import make_shifted
from softgrasp.reduction.bases.registry import make_basis
from softgrasp.reduction.bases.states import States
from softgrasp.reduction.online import run, run_batch
from softgrasp.reduction.projection import project as project_model
from softgrasp.reduction.propagator import propagator
from softgrasp.study.bench import driver
from softgrasp.study.bench.driver import Failure
from softgrasp.study.bench.forward_rows import DT, bench_scene, cells_for
from softgrasp.study.bench.riccati_rows import problem_for
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.timing import interleave, medians, timed

BATCH = 100  # models of a batch
STEPS = 600
CALLS = 8  # products of one sample
FREED = 3_900_000  # numbers, a little less than the 32 MiB up to which it keeps any
SHIFT = -0.5 + 5.0j  # a shift in the middle of the paper's spectrum
HELP = """Measure two methods at sizes near those at which softgrasp changes from one to the other.

Each row compares a first and a second method at one size, medians of runs in turn (set-ups and the largest sizes are
timed once); 'second / first' above 1 means that the first is the faster one. The switches:

batch: many reduced models step together (first) or one after the other (second), up to reduction.online.TOGETHER byte.
start: the modal Riccati equation from few modes (first) or from one Schur form (second), lqr.lowrank.modal_start.
FEW_MODES.
dense: the dense Riccati solver (first, used up to lqr.riccati.DENSE_STATES states) or Newton-ADI (second).
shift: a shifted factor and solve for each rank, SuperLU on whole matrices (first) or MUMPS (second), GATHER_LIMIT of
lqr.lowrank.shifted.
set-up, step: of the forward run with PETSc Cholesky (first) or MUMPS (second), fem.solve.solvers.
CHOLESKY_LIMIT.
whole: the same with MUMPS' whole factor on every rank (first) or a spread one (second), fem.solve.solvers.
REPEATED_LIMIT.
product: K_ee times many columns on one rank by fem.petsc.times_columns (first), or by SciPy's CSR product or PETSc's
matMult (second), CPU seconds; fem.petsc.BLOCK_ENTRIES.
finite: CPU seconds of a run of paper_forward, linear (first) and at finite strain (second); at most ten times as many.

Keep the machine quiet. A fast look: --switches batch,start --repeats 3."""


@dataclass(frozen=True)
class SwitchPoint:
    """Two methods at one size."""

    switch: str
    limit: str  # the constant and its value
    setting: str  # the size
    ranks: int
    first: float  # first, second: median seconds
    second: float


def compare(
    comm: MPI.Intracomm,
    names: tuple[str, str],
    setting: str,
    calls: tuple[Callable[[], Any], Callable[[], Any]],
    n: int,
) -> SwitchPoint:
    """Time two calls in turn, after one run of each. Collective."""
    for call in calls:
        call()
    seconds = medians(interleave({str(i): partial(timed, comm, call) for i, call in enumerate(calls)}, n))
    return SwitchPoint(*names, setting, comm.size, seconds["0"], seconds["1"])


def under(module: ModuleType, name: str, value: float, call: Callable[..., Any], *args: Any) -> Any:
    """A call with another value of a module's constant."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        return call(*args)
    finally:
        setattr(module, name, before)


def batch(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """Reduced models of random materials, together and one by one. One rank."""
    changes = ["effects.damping={kind='kelvin-voigt', beta=0.002}", "motion={drive='force', profile='hold'}"]
    model = build(load_scene_collective(comm, shipped_scenes()["paper_forward"], changes), comm=comm)
    system = model.system
    material, rng = system.materials[0], np.random.default_rng(0)
    force = np.ones((STEPS, system.layout.n_s))
    for N in (12, 18, 26, 34, 50):
        basis = make_basis("craig_bampton", States(system), N)
        rom = project_model(basis, system, make_outputs(model.scene, system), "")
        many = [
            propagator(rom.at((replace(material, lam=a, mu=b),)), DT)
            for a, b in zip(rng.uniform(30, 500, BATCH), rng.uniform(20, 500, BATCH), strict=True)
        ]
        size = sum(p.block.nbytes for p in many)
        together = partial(under, softgrasp.reduction.online, "TOGETHER", 2**62, run_batch, many, DT, force)

        def alone(many: list[Any] = many) -> None:
            for p in many:
                run(p, None, force)

        limit = f"TOGETHER = {softgrasp.reduction.online.TOGETHER / 1e6:g} MB"
        yield compare(
            comm, ("batch", limit), f"{BATCH} models, N = {N}, {size / 1e6:.1f} MB", (together, alone), repeats
        )


def start(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """The Riccati equation of the modal start. One rank."""
    few = softgrasp.lqr.lowrank.modal_start.FEW_MODES
    plant = Plant(problem_for(comm, 10, 0.002))
    for k in (15, 16, 30, 60):
        omega, V = plant_modes(plant, k)
        solve = partial(solve_small, plant, restrict(plant, V, omega, plant.mass(V)))
        calls = (solve, partial(under, softgrasp.lqr.lowrank.modal_start, "FEW_MODES", 2**30, solve))
        yield compare(comm, ("start", f"FEW_MODES = {few}"), f"2D, {k} modes", calls, repeats)


def dense(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """All modes against low rank. One rank."""
    for nx in (2, 3, 4, 5, 8):
        problem = problem_for(comm, nx, 0.002)
        calls = (lambda p=problem: DenseRiccati().solve(p), lambda p=problem: NewtonADI().solve(p))
        limit = f"DENSE_STATES = {softgrasp.lqr.riccati.DENSE_STATES}"
        yield compare(comm, ("dense", limit), f"2D, {problem.layout.states} states", calls, repeats)


def shift(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """Factor and solve at one shift a rank, with whole matrices and spread ones."""
    for d, size in ((2, 10_000), (2, 100_000), (3, 8_000), (3, 20_000), *(((3, 39_000),) if large else ())):
        model = build(bench_scene(comm, d, cells_for(d, size), 1), comm=comm)
        layout = model.system.layout
        F = np.ones((layout.n_local, 3))
        solvers = [make_shifted(model.system, name) for name in ("gathered", "distributed")]
        turn = [0]

        def once(solver: Any, F: np.ndarray = F, turn: list[int] = turn, p: int = comm.size) -> None:
            """As many shifts as there are ranks, new ones each time."""
            shifts = [SHIFT * (1 + 1e-3 * (turn[0] * p + i)) for i in range(p)]
            turn[0] += 1
            for i, s in enumerate(shifts):
                solver.solve(s, F, shifts[i + 1 :])

        calls = (lambda s=solvers[0]: once(s), lambda s=solvers[1]: once(s))
        limit = f"GATHER_LIMIT = {softgrasp.lqr.lowrank.shifted.GATHER_LIMIT[d]}"
        yield compare(comm, ("shift", limit), f"{d}D, n_e = {layout.n_e}", calls, 1 if layout.n_e > 30_000 else repeats)
        for solver in solvers:
            solver.destroy()


def step_and_set_up(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """Set-up and step of the forward run with PETSc's Cholesky and with MUMPS."""
    for d, size in ((2, 10_000), (2, 100_000), (3, 4_000), (3, 10_000), (3, 20_000)):
        model = build(bench_scene(comm, d, cells_for(d, size), 1), comm=comm)
        names = f"CHOLESKY_LIMIT = {softgrasp.fem.solve.solvers.CHOLESKY_LIMIT[d]}"
        yield from _two(comm, model, ("cholesky", "auto"), ("mumps", "auto"), ("set-up", "step"), names, repeats)


def whole(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """Set-up and step with MUMPS, its factor whole on every rank or spread. Two ranks or more."""
    if comm.size == 1:
        return
    for d, size in ((3, 10_000), (3, 50_000), *(((3, 200_000), (2, 1_000_000)) if large else ())):
        model = build(bench_scene(comm, d, cells_for(d, size), 1), comm=comm)
        names = f"REPEATED_LIMIT = {softgrasp.fem.solve.solvers.REPEATED_LIMIT[d]} / ranks"
        heads = ("whole, set-up", "whole, step")
        yield from _two(comm, model, ("mumps", True), ("mumps", False), heads, names, 1 if size > 60_000 else repeats)


def product(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """K_ee times columns stored by rows and by columns. CPU seconds; a sample is a mean of calls in a row. One rank."""
    rng = np.random.default_rng(0)
    np.ones(FREED)  # given back at once: from now on the C library keeps arrays up to this size, as in any longer run
    for size in (1_000, 14_638, *((100_000,) if large else ())):
        A = build(bench_scene(comm, 2, cells_for(2, size), 1), comm=comm).system.K_ee
        rows, n = to_scipy(A), A.getSize()[0]
        limit = f"BLOCK_ENTRIES = {softgrasp.fem.petsc.BLOCK_ENTRIES}"
        for k, storage in itertools.product((10, 30, 120), ("rows", "columns")):
            X = np.asarray(rng.standard_normal((n, k)), order="C" if storage == "rows" else "F")
            calls = (partial(times_columns, A, X), partial(operator.matmul, rows, X), partial(by_petsc, A, X))
            ways = zip(("ours", "SciPy", "PETSc"), (partial(cpu_seconds, call) for call in calls), strict=True)
            seconds = medians(interleave(dict(ways), 3 * repeats))
            for way in ("SciPy", "PETSc"):
                setting = f"n_e = {n}, {k} columns by {storage}"
                yield SwitchPoint(f"product, {way}", limit, setting, comm.size, seconds["ours"], seconds[way])


def by_petsc(A: PETSc.Mat, X: Array) -> Any:
    """A X by PETSc's matMult with all columns at once."""
    return under(softgrasp.fem.petsc, "BLOCK_COLUMNS", X.shape[1] + 1, times_columns, A, np.asfortranarray(X))


def cpu_seconds(call: Callable[[], Any]) -> float:
    """Mean CPU seconds of a call after one that is not counted: it pays for the pages that the way before left cold."""
    call()
    begin = time.process_time()
    for _ in range(CALLS):
        call()
    return (time.process_time() - begin) / CALLS


def finite(comm: MPI.Intracomm, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """Whole runs with linear elasticity and with finite strain, CPU seconds. One rank."""

    def run_of(changes: list[str]) -> Callable[[], float]:
        model = build(load_scene_collective(comm, shipped_scenes()["paper_forward"], changes), comm=comm)

        def seconds() -> float:
            begin = time.process_time()
            simulate(model)
            return time.process_time() - begin

        return seconds

    for nx in (15, 60):
        cells = f"tissue.cells=[{nx}, {2 * nx}]"
        runs = {"off": run_of([cells]), "on": run_of([cells, "effects.finite_strain={}"])}
        seconds = medians(interleave(runs, repeats))
        yield SwitchPoint(
            "finite", "effects.finite_strain off, on", f"2D, nx = {nx}", comm.size, seconds["off"], seconds["on"]
        )


def _two(
    comm: MPI.Intracomm,
    model: Any,
    one: tuple[SolverName, Any],
    other: tuple[SolverName, Any],
    heads: tuple[str, str],
    limit: str,
    repeats: int,
) -> Iterator[SwitchPoint]:
    """Set-up and step with two solvers."""
    system = model.system
    setting = f"{system.layout.dimension}D, n_e = {system.layout.n_e}"
    seconds, midpoints = [], []
    for name, reproducible in (one, other):
        comm.Barrier()
        begin = time.perf_counter()
        midpoints.append(TissueMidpoint(system, DT, name, reproducible=reproducible))
        seconds.append(float(comm.allreduce(time.perf_counter() - begin, MPI.MAX)))
    yield SwitchPoint(heads[0], limit, setting, comm.size, *seconds)
    c = np.ones(system.layout.n_s)
    states = [state_on(np.zeros(2 * system.layout.n_local), system) for _ in midpoints]
    for midpoint, state in zip(midpoints, states, strict=True):
        midpoint.start(state)

    def step(i: int) -> None:
        midpoints[i].solve_midpoint(c)
        midpoints[i].advance(states[i], states[i])

    yield compare(comm, (heads[1], limit), setting, (partial(step, 0), partial(step, 1)), max(repeats, 3))
    for midpoint in midpoints:
        midpoint.destroy()


SWITCHES: dict[str, Callable[[MPI.Intracomm, int, bool], Iterator[SwitchPoint]]] = {
    "batch": batch,
    "start": start,
    "dense": dense,
    "shift": shift,
    "step": step_and_set_up,
    "whole": whole,
    "product": product,
    "finite": finite,
}
SERIAL = ("batch", "start", "dense", "product", "finite")


HEADER = ("switch", "constant", "size", "ranks", "first s", "second s", "second / first")


def measure(switch: str, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """The points of one switch. Collective."""
    return SWITCHES[switch](MPI.COMM_WORLD, repeats, large)


def table_of(points: list[SwitchPoint]) -> Table:
    """The one table."""
    cells = [(*astuple(p)[:4], f"{p.first:.3g}", f"{p.second:.3g}", f"{p.second / p.first:.2f}") for p in points]
    return Table(HEADER, cells, "two methods around the sizes of a switch, median seconds")


def main(
    switches: Annotated[str, typer.Option(help="which, with commas")] = ",".join(SWITCHES),
    ranks: driver.Ranks = "1,2",
    repeats: driver.Repeats = 5,
    large: Annotated[bool, typer.Option("--large", help="also sizes that take minutes")] = False,
    out: Annotated[Path, typer.Option(help="folder for bench_switches.json and bench_switches.csv")] = Path("out"),
) -> None:
    """See HELP."""
    names, counts = [name.strip() for name in switches.split(",")], driver.parse_ranks(ranks)
    for name in names:
        if name not in SWITCHES:
            raise typer.BadParameter(f"'{name}' is no switch; choose from {', '.join(SWITCHES)}")
        if name == "whole" and max(counts) == 1 and len(names) == 1:
            raise typer.BadParameter("whole and spread factors are the same on one rank; add --ranks 2")
    console, rows = driver.open_console(130), list[SwitchPoint | Failure]()
    for name in names:
        for k in [k for k in counts if k == 1 or name not in SERIAL]:
            spec = {"switch": name, "repeats": repeats, "large": large}
            rows += driver.measure(console, SwitchPoint, "switches", spec, k, name)
    points, failed = driver.of(SwitchPoint, rows), driver.failures(rows)
    console.print(table_of(points).terminal())
    content = {"command": "bench_switches", "rows": driver.as_rows(points), "failed": driver.as_rows(failed)}
    table = Table(tuple(f.name for f in fields(SwitchPoint)), [astuple(point) for point in points])
    driver.list_bench(console, driver.write_bench(out, "bench_switches", content, table), failed)
