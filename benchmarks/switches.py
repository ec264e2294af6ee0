"""What stands behind the sizes at which softgrasp changes its method: ``python -m benchmarks switches``."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
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
from benchmarks import driver
from benchmarks.driver import Failure
from benchmarks.forward_rows import DT, bench_scene, cells_for
from benchmarks.riccati import problem_for
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array, PETSc, times_columns, to_scipy
from softgrasp.fem.run.midpoint import TissueMidpoint, state_on
from softgrasp.fem.run.simulate import simulate
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

    @property
    def ratio(self) -> float:
        """Above 1 the first is the faster one."""
        return self.second / self.first


@dataclass(frozen=True)
class Setup:
    """What every switch is measured with."""

    comm: MPI.Intracomm
    repeats: int
    large: bool  # also the sizes that take minutes

    def point(self, switch: str, limit: str, setting: str, first: float, second: float) -> SwitchPoint:
        """Two times on these ranks."""
        return SwitchPoint(switch, limit, setting, self.comm.size, first, second)

    def compare(
        self, switch: str, limit: str, setting: str, calls: Sequence[Callable[[], Any]], repeats: int = 0
    ) -> SwitchPoint:
        """Time two calls in turn, after one run of each. Collective."""
        for call in calls:
            call()
        tasks = {str(i): partial(timed, self.comm, call) for i, call in enumerate(calls)}
        seconds = medians(interleave(tasks, repeats or self.repeats))
        return self.point(switch, limit, setting, seconds["0"], seconds["1"])

    def models(self, sizes: Sequence[tuple[int, int]], large: Sequence[tuple[int, int]] = ()) -> Iterator[Model]:
        """The bench's scene at dimensions and sizes, one after the other. Collective."""
        for d, size in (*sizes, *(large if self.large else ())):
            yield build(bench_scene(self.comm, d, cells_for(d, size), 1), comm=self.comm)


def under(module: ModuleType, name: str, value: float, call: Callable[..., Any], *args: Any) -> Any:
    """A call with another value of a module's constant."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        return call(*args)
    finally:
        setattr(module, name, before)


def batch(setup: Setup) -> Iterator[SwitchPoint]:
    """Reduced models of random materials, together and one by one. One rank."""
    changes = ["effects.damping={kind='kelvin-voigt', beta=0.002}", "motion={drive='force', profile='hold'}"]
    model = build("paper_forward", changes, setup.comm)
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
        alone = partial(lambda many: [run(p, None, force) for p in many], many)
        limit = f"TOGETHER = {softgrasp.reduction.online.TOGETHER / 1e6:g} MB"
        yield setup.compare("batch", limit, f"{BATCH} models, N = {N}, {size / 1e6:.1f} MB", (together, alone))


def start(setup: Setup) -> Iterator[SwitchPoint]:
    """The Riccati equation of the modal start. One rank."""
    few = softgrasp.lqr.lowrank.modal_start.FEW_MODES
    plant = Plant(problem_for(setup.comm, 10, 0.002))
    for k in (15, 16, 30, 60):
        omega, V = plant_modes(plant, k)
        solve = partial(solve_small, plant, restrict(plant, V, omega, plant.mass(V)))
        calls = (solve, partial(under, softgrasp.lqr.lowrank.modal_start, "FEW_MODES", 2**30, solve))
        yield setup.compare("start", f"FEW_MODES = {few}", f"2D, {k} modes", calls)


def dense(setup: Setup) -> Iterator[SwitchPoint]:
    """All modes against low rank. One rank."""
    for nx in (2, 3, 4, 5, 8):
        problem = problem_for(setup.comm, nx, 0.002)
        calls = partial(DenseRiccati().solve, problem), partial(NewtonADI().solve, problem)
        limit = f"DENSE_STATES = {softgrasp.lqr.riccati.DENSE_STATES}"
        yield setup.compare("dense", limit, f"2D, {problem.layout.states} states", calls)


def shift(setup: Setup) -> Iterator[SwitchPoint]:
    """Factor and solve at one shift a rank, with whole matrices and spread ones."""
    turn, p = itertools.count(), setup.comm.size

    def once(solver: Any, F: Array) -> None:
        """As many shifts as there are ranks, new ones each time."""
        first = next(turn) * p
        shifts = [SHIFT * (1 + 1e-3 * (first + i)) for i in range(p)]
        for i, s in enumerate(shifts):
            solver.solve(s, F, shifts[i + 1 :])

    for model in setup.models(((2, 10_000), (2, 100_000), (3, 8_000), (3, 20_000)), ((3, 39_000),)):
        layout = model.system.layout
        d, F = layout.dimension, np.ones((layout.n_local, 3))
        solvers = [make_shifted(model.system, name) for name in ("gathered", "distributed")]
        limit = f"GATHER_LIMIT = {softgrasp.lqr.lowrank.shifted.GATHER_LIMIT[d]}"
        calls, repeats = [partial(once, solver, F) for solver in solvers], 1 if layout.n_e > 30_000 else 0
        yield setup.compare("shift", limit, f"{d}D, n_e = {layout.n_e}", calls, repeats)
        for solver in solvers:
            solver.destroy()


def step_and_set_up(setup: Setup) -> Iterator[SwitchPoint]:
    """Set-up and step of the forward run with PETSc's Cholesky and with MUMPS."""
    for model in setup.models(((2, 10_000), (2, 100_000), (3, 4_000), (3, 10_000), (3, 20_000))):
        limit = f"CHOLESKY_LIMIT = {softgrasp.fem.solve.solvers.CHOLESKY_LIMIT[model.system.layout.dimension]}"
        yield from _two(setup, model, (("cholesky", "auto"), ("mumps", "auto")), "", limit)


def whole(setup: Setup) -> Iterator[SwitchPoint]:
    """Set-up and step with MUMPS, its factor whole on every rank or spread. Two ranks or more."""
    if setup.comm.size == 1:
        return
    for model in setup.models(((3, 10_000), (3, 50_000)), ((3, 200_000), (2, 1_000_000))):
        limit = softgrasp.fem.solve.solvers.REPEATED_LIMIT[model.system.layout.dimension]
        ways: tuple[tuple[SolverName, Any], ...] = ("mumps", True), ("mumps", False)
        yield from _two(setup, model, ways, "whole, ", f"REPEATED_LIMIT = {limit} / ranks")


def product(setup: Setup) -> Iterator[SwitchPoint]:
    """K_ee times columns stored by rows and by columns. CPU seconds; a sample is a mean of calls in a row. One rank."""
    rng = np.random.default_rng(0)
    np.ones(FREED)  # given back at once: from now on the C library keeps arrays up to this size, as in any longer run
    for model in setup.models(((2, 1_000), (2, 14_638)), ((2, 100_000),)):
        A = model.system.K_ee
        rows, n = to_scipy(A), A.getSize()[0]
        limit = f"BLOCK_ENTRIES = {softgrasp.fem.petsc.BLOCK_ENTRIES}"
        for k, storage in itertools.product((10, 30, 120), ("rows", "columns")):
            X = np.asarray(rng.standard_normal((n, k)), order="C" if storage == "rows" else "F")
            calls = (partial(times_columns, A, X), partial(operator.matmul, rows, X), partial(by_petsc, A, X))
            ways = zip(("ours", "SciPy", "PETSc"), (partial(mean_seconds, call) for call in calls), strict=True)
            seconds = medians(interleave(dict(ways), 3 * setup.repeats))
            for way in ("SciPy", "PETSc"):
                setting = f"n_e = {n}, {k} columns by {storage}"
                yield setup.point(f"product, {way}", limit, setting, seconds["ours"], seconds[way])


def by_petsc(A: PETSc.Mat, X: Array) -> Any:
    """A X by PETSc's matMult with all columns at once."""
    return under(softgrasp.fem.petsc, "BLOCK_COLUMNS", X.shape[1] + 1, times_columns, A, np.asfortranarray(X))


def mean_seconds(call: Callable[[], Any]) -> float:
    """Mean CPU seconds of a call after one that is not counted: it pays for the pages that the way before left cold."""
    call()
    return driver.cpu_seconds(lambda: [call() for _ in range(CALLS)]) / CALLS


def finite(setup: Setup) -> Iterator[SwitchPoint]:
    """Whole runs with linear elasticity and with finite strain, CPU seconds. One rank."""

    def run_of(changes: list[str]) -> Callable[[], float]:
        return partial(driver.cpu_seconds, partial(simulate, build("paper_forward", changes, setup.comm)))

    for nx in (15, 60):
        cells = f"tissue.cells=[{nx}, {2 * nx}]"
        runs = {"off": run_of([cells]), "on": run_of([cells, "effects.finite_strain={}"])}
        seconds = medians(interleave(runs, setup.repeats))
        yield setup.point("finite", "effects.finite_strain off, on", f"2D, nx = {nx}", seconds["off"], seconds["on"])


def _two(
    setup: Setup, model: Model, ways: Sequence[tuple[SolverName, Any]], head: str, limit: str
) -> Iterator[SwitchPoint]:
    """Set-up and step with two solvers."""
    system = model.system
    setting = f"{system.layout.dimension}D, n_e = {system.layout.n_e}"
    seconds, midpoints = [], list[TissueMidpoint]()
    for name, reproducible in ways:
        make = partial(TissueMidpoint, system, DT, name, reproducible=reproducible)
        seconds.append(timed(setup.comm, lambda: midpoints.append(make())))  # noqa: B023  (called at once)
    yield setup.point(f"{head}set-up", limit, setting, *seconds)
    c = np.ones(system.layout.n_s)
    states = [state_on(np.zeros(2 * system.layout.n_local), system) for _ in midpoints]
    for midpoint, state in zip(midpoints, states, strict=True):
        midpoint.start(state)

    def step(i: int) -> None:
        midpoints[i].solve_midpoint(c)
        midpoints[i].advance(states[i], states[i])

    repeats = 3 if system.layout.n_e > 60_000 else max(setup.repeats, 3)
    yield setup.compare(f"{head}step", limit, setting, (partial(step, 0), partial(step, 1)), repeats)
    for midpoint in midpoints:
        midpoint.destroy()


SWITCHES: dict[str, Callable[[Setup], Iterator[SwitchPoint]]] = {
    "batch": batch, "start": start, "dense": dense, "shift": shift, "step": step_and_set_up, "whole": whole,
    "product": product, "finite": finite,
}  # fmt: skip
SERIAL = ("batch", "start", "dense", "product", "finite")
COLUMNS = {
    "switch": "switch", "constant": "limit", "size": "setting", "ranks": "ranks", "first s": "first .3g",
    "second s": "second .3g", "second / first": "ratio .2f",
}  # fmt: skip
CSV = {f.name: f.name for f in fields(SwitchPoint)}


def measure(switch: str, repeats: int, large: bool) -> Iterator[SwitchPoint]:
    """The points of one switch. Collective."""
    return SWITCHES[switch](Setup(MPI.COMM_WORLD, repeats, large))


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
    title = "two methods around the sizes of a switch, median seconds"
    console.print(driver.table_of(points, COLUMNS, title).terminal())
    content = {"command": "bench_switches", "rows": points, "failed": failed}
    driver.list_bench(console, driver.write_bench(out, "bench_switches", content, driver.table_of(points, CSV)), failed)
