"""Time and memory of the large Riccati equation, beside other codes: ``python -m benchmarks riccati``."""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import scipy.linalg
import typer
from mpi4py import MPI
from pydantic import TypeAdapter
from rich.console import Console

from benchmarks import driver
from benchmarks.driver import Failure, Goal
from softgrasp.fem.errors import CheckpointError, SoftgraspError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.file import load_scene_collective, shipped_scenes
from softgrasp.lqr.dense.modal import factor_psd
from softgrasp.lqr.dense.paper import paper_form
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import costates_to_relative, gain_to_absolute
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.riccati import gain_error, tissue_gain_error
from softgrasp.lqr.riccati import Method, make_solver
from softgrasp.study.report.document import number
from softgrasp.study.report.files import write_json
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell.timing import power_law, repeated

SIZES = "10,20,40,80,160"
LARGEST, LARGEST_RANKS = 355, 2  # 2n = 1 009 660
PEER_LIMIT = {"scipy": 10, "slycot": 10, "pymor": 40}  # nx; minutes beyond
LIMITS = {("newton_adi", 10): 0.2, ("newton_adi", 80): 20.0, ("galerkin", 10): 0.03, ("galerkin", 80): 4.0}  # [s]
LARGE_SECONDS, LARGE_MB = 900.0, 24 * 1024
RESIDUAL, GAIN = 1e-10, 1e-6
METHODS: tuple[Method, ...] = ("newton_adi", "radi", "galerkin")
REPEAT_SECONDS = 3.0  # a method is repeated until its runs have lasted so long
STAGES = {
    "factor": ("factor",),
    "solve": ("solve",),
    "shifts": ("start", "shifts"),
    "dense": ("small", "products", "compress"),
    "residual": ("residual",),
}
HELP = f"""Measure the large Riccati equation of the paper's control scene and print one table.

Every row is a program of its own under mpiexec: Newton-ADI, RADI and structured Galerkin on nx x 2 nx cells. Columns:
solves with a complex tissue matrix, rank of Z, seconds (median) split into factorisations, triangular solves, start
and shifts, products with small dense algebra and compression, and the recomputation of the residual; the true relative
residual from Z; the relative difference of the gain to that of Newton-ADI, whole and of the tissue's rows alone, which
weigh little beside the hand's; peak memory of all ranks. Below: SciPy, slycot and pyMOR on the paper's own matrices
where they are installed and can run (slycot and SciPy to nx = 10, pyMOR to nx = 40), growth exponents over the meshes,
and the goals. On one rank Newton-ADI and RADI make the next factor on a second core where there is one.
bench_riccati.json is written after every row; --resume keeps the rows it has.

Keep the machine quiet while it runs. A fast look: --sizes 10 --ranks 1 --no-peers.
--large adds nx = {LARGEST} (2n > 1e6) on {LARGEST_RANKS} ranks by Newton-ADI and Galerkin: up to half an hour."""
COLUMNS = {
    "nx": "nx", "2n": "states", "ranks": "ranks", "method": "method", "solves": "solves", "rank": "rank",
    "total s": "seconds 3", **{f"{name} s": f"split.{name} 3" for name in STAGES}, "true residual": "residual .1e",
    "gain diff.": "gain_difference .1e", "of the tissue": "tissue_difference .1e", "MiB": "memory_mb 3",
}  # fmt: skip
CSV = {name: name for name in ("nx", "states", "ranks", "method", "solves", "newton_steps", "rank", "seconds")}
CSV |= {name: name for name in ("residual", "gain_difference", "tissue_difference", "memory_mb", "memory_base_mb")}
CSV |= {f"{name}_s": f"split.{name}" for name in STAGES}


@dataclass(frozen=True)
class SolverPoint:
    """One method on nx x 2 nx cells; a peer has fewer numbers."""

    nx: int  # number of cells along the short side
    ranks: int  # number of ranks
    method: str  # solver
    states: int  # number of states, 2n
    seconds: float  # median
    rank: int  # of Z
    residual: float  # relative, recomputed from Z
    gain_difference: float | None  # relative, to the gain of the first method
    tissue_difference: float | None  # relative, of the tissue's rows alone, to the gain of the first method
    split: dict[str, float] = field(default_factory=dict)  # seconds by stage
    solves: int = 0  # number of shifted solves
    newton_steps: int = 0  # number of Newton steps
    memory_mb: float = 0.0  # peak of all ranks [MiB]
    memory_base_mb: float = 0.0  # peak of all ranks before the first method [MiB]


Rows = list[SolverPoint | Failure]


def problem_for(comm: MPI.Intracomm, nx: int, beta: float) -> RiccatiProblem:
    """The paper's control problem on nx x 2 nx cells. Collective."""
    changes = [f"tissue.cells=[{nx}, {2 * nx}]", f"effects.damping.beta={beta!r}"]
    return make_problem(build(load_scene_collective(comm, shipped_scenes()["paper_lqr"], changes), comm=comm))


def measure(nx: int, beta: float, methods: Sequence[Method], repeats: int) -> Iterator[SolverPoint | Failure]:
    """All methods on nx x 2 nx cells; gains are compared with the first one. Collective.

    ``beta`` is the Kelvin-Voigt time [s].
    """
    comm = MPI.COMM_WORLD
    problem = problem_for(comm, nx, beta)
    base = peak_memory_mb(comm)
    reference: Gain | None = None
    for name in methods:
        solved: list[RiccatiSolution] = []
        solve = partial(lambda name, to: to.append(make_solver(name).solve(problem)), name, solved)
        try:
            seconds = float(np.median(repeated(comm, solve, repeats, REPEAT_SECONDS)))
        except SoftgraspError as error:
            yield Failure(f"nx = {nx}, {name}", comm.size, str(error))
            continue
        s = solved[-1]
        yield SolverPoint(
            nx, comm.size, name, problem.layout.states, seconds, s.rank, s.residual,
            *_differences(problem, reference, s.gain),
            {part: sum(s.seconds.get(key, 0.0) for key in keys) for part, keys in STAGES.items()},
            s.counts["solves"], s.counts["newton_steps"], peak_memory_mb(comm), base,
        )  # fmt: skip
        reference = reference or s.gain


def _differences(problem: RiccatiProblem, reference: Gain | None, gain: Gain) -> tuple[float | None, float | None]:
    """Of the whole gain and of its tissue's rows; None without a reference. Collective."""
    if reference is None:
        return None, None
    return gain_error(problem, reference, gain), tissue_gain_error(problem, reference, gain)


class PaperPlant(NamedTuple):
    """E x' = A x + B u and y = C x in the paper's own sparse form, weighted by Q and R."""

    E: Any  # mass matrix of the first-order form, (2n, 2n)
    A: Any  # state matrix, (2n, 2n)
    B: Array  # input matrix, (2n, n_s)
    C: Array  # output matrix, (p, 2n)
    Q: Array  # weight of the outputs, (p, p)
    R: Array  # weight of the inputs, (n_s, n_s)


def scipy_solver(plant: PaperPlant) -> Callable[[], Array]:
    """SciPy's dense solver: X."""
    E, A, B, C, Q, R = plant
    return lambda: scipy.linalg.solve_continuous_are(A.toarray(), B, C.T @ Q @ C, R, e=E.toarray())


def slycot_solver(plant: PaperPlant) -> Callable[[], Array]:
    """SLICOT's SG02AD through slycot: X."""
    slycot = importlib.import_module("slycot")
    E, A, B, C, Q, R = plant
    n, m = B.shape
    options = ("C", "B", "N", "U", "Z", "N", "S", "R", n, m, len(C))
    return lambda: slycot.sg02ad(*options, A.toarray(), E.toarray(), B, C.T @ Q @ C, R, np.zeros((n, m)))[1]


def pymor_solver(plant: PaperPlant) -> Callable[[], Array]:
    """The low-rank RADI of pyMOR: Z with X = Z Z^T."""
    from pymor.core.logger import set_log_levels
    from pymor.operators.numpy import NumpyMatrixOperator
    from pymor.solvers.matrix_equations.equations import RiccatiEquation
    from pymor.solvers.matrix_equations.radi import RADIRiccatiSolver

    set_log_levels({"pymor": "ERROR"})
    A, E = NumpyMatrixOperator(plant.A), NumpyMatrixOperator(plant.E)
    weighted = scipy.linalg.sqrtm(plant.Q).real @ plant.C
    b, c = A.source.from_numpy(plant.B), A.source.from_numpy(weighted.T)
    equation = RiccatiEquation(A, E, b, c, R=plant.R, trans=True)
    return lambda: RADIRiccatiSolver().solve(equation).to_numpy()


PEERS = {"scipy": scipy_solver, "slycot": slycot_solver, "pymor": pymor_solver}


def measure_peer(nx: int, beta: float, peer: str) -> Iterator[SolverPoint | Failure]:
    """One peer on the paper's matrices against our Newton-ADI, on one rank."""
    problem = problem_for(MPI.COMM_WORLD, nx, beta)
    reference, s = make_solver("newton_adi").solve(problem).gain, 2 * problem.layout.n_s
    try:
        plant = PaperPlant(*paper_form(problem), problem.Q, problem.R)
        solve = PEERS[peer](plant)
        begin = time.perf_counter()
        Z = solve()
        seconds = time.perf_counter() - begin
        if peer != "pymor":
            Z = factor_psd(Z)
        K = -np.linalg.solve(plant.R, (plant.B.T @ Z) @ (plant.E.T @ Z).T).T
        relative = costates_to_relative(problem.system, Block(Z[:s], Z[s:]))
        gain = Gain.of_block(gain_to_absolute(problem.system, Block(K[:s], K[s:]), -1))
    except Exception as error:  # a peer's failure is a result of the comparison
        yield Failure(f"{peer}, nx = {nx}", 1, f"failed, {type(error).__name__}: {error}"[:200])
        return
    accuracy = residual(problem, relative), *_differences(problem, reference, gain)
    yield SolverPoint(nx, 1, peer, problem.layout.states, seconds, relative.columns, *accuracy)


def measure_row(**arguments: Any) -> Iterator[SolverPoint | Failure]:
    """The points that the launcher names. Collective."""
    return (measure_peer if "peer" in arguments else measure)(**arguments)


@dataclass
class Record:
    """Rows as they come, in a file that outlives whatever goes wrong with the next one."""

    file: Path  # bench_riccati.json
    beta: float  # Kelvin-Voigt time of all rows [s]
    rows: Rows = field(default_factory=list)  # of the methods here
    peers: Rows = field(default_factory=list)  # of other codes

    @property
    def points(self) -> list[SolverPoint]:
        """Rows that did not fail."""
        return driver.of(SolverPoint, self.rows)

    def resume(self) -> None:
        """Read the rows of an earlier run with this damping. Raises CheckpointError: not such a file."""
        adapter = TypeAdapter(list[SolverPoint])
        try:
            old = json.loads(self.file.read_text()) if self.file.is_file() else {}
            if old.get("beta") == self.beta:
                rows, peers = (adapter.validate_python(old[key]) for key in ("rows", "peers"))
                self.rows, self.peers = [*rows], [*peers]
        except (ValueError, KeyError, AttributeError) as error:
            raise CheckpointError(f"{self.file} has no rows of this version; run once without --resume") from error

    def kept(self, nx: int, ranks: int, methods: Sequence[str]) -> Rows:
        """The points of a row where all its methods are there."""
        own = [p for p in driver.of(SolverPoint, [*self.rows, *self.peers]) if (p.nx, p.ranks) == (nx, ranks)]
        return [p for p in own if p.method in methods] if {p.method for p in own} >= set(methods) else []

    def save(self) -> None:
        """Write the file."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        peers = driver.of(SolverPoint, self.peers)
        report = {"command": "bench_riccati", "beta": self.beta, "rows": self.points}
        report |= {"peers": peers, "exponents": exponents(self.points)}
        report |= {"failed": driver.failures([*self.rows, *self.peers])}
        write_json(self.file, report | {"goals": driver.goal_rows(goals(self.points))})


def exponents(points: Sequence[SolverPoint]) -> dict[str, float | None]:
    """Growth of time with the number of states, from nx = 20 on, by method and rank count."""
    result: dict[str, float | None] = {}
    for method, ranks in sorted({(p.method, p.ranks) for p in points if p.nx >= 20}):
        own = [p for p in points if p.nx >= 20 and (p.method, p.ranks) == (method, ranks)]
        result[f"{method}, {ranks} rank(s)"] = power_law([p.states for p in own], [p.seconds for p in own])
    return result


def goals(points: Sequence[SolverPoint]) -> list[Goal]:
    """All goals that the measured points decide."""
    result = []
    for p in points:
        label = f"{p.method}, 2n = {p.states}, {p.ranks} rank(s)"
        limit = LIMITS.get((p.method, p.nx))
        if limit is not None and p.ranks == 1:
            result.append(Goal(f"{label}: seconds", p.seconds, limit))
        if p.method != "galerkin":
            result.append(Goal(f"{label}: true residual", p.residual, RESIDUAL))
        elif p.gain_difference is not None:
            result.append(Goal(f"{label}: gain difference", p.gain_difference, GAIN))
        if p.states >= 1_000_000:
            result.append(Goal(f"{label}: seconds", p.seconds, LARGE_SECONDS))
            result.append(Goal(f"{label}: MiB", p.memory_mb, LARGE_MB))
    newton = sorted((p.nx, p.solves) for p in points if p.method == "newton_adi" and p.ranks == 1)
    if len(newton) > 1:
        result.append(Goal("newton_adi: solves on the finest mesh / coarsest", newton[-1][1] / newton[0][1], 1.5))
    for label, power in exponents(points).items():
        if power is not None and len({p.nx for p in points if p.nx >= 20}) > 2:
            result.append(Goal(f"{label}: growth exponent", power, 1.3))
    return result


def peer_line(peer: SolverPoint | Failure) -> str:
    """One sentence about a peer."""
    if isinstance(peer, Failure):
        return f"{peer.label}: {peer.error}"
    return (
        f"{peer.method}, nx = {peer.nx}: {number(peer.seconds)} s, rank {peer.rank}, true residual "
        f"{peer.residual:.1e}, gain difference {peer.gain_difference:.1e}, of the tissue's rows "
        f"{peer.tissue_difference:.1e}"
    )


def draw(path: Path, points: Sequence[SolverPoint], peers: Sequence[SolverPoint]) -> tuple[Path, ...]:
    """Time against states for every method on the fewest ranks, peers as single marks, log-log."""
    from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE

    fewest = min((p.ranks for p in points), default=1)
    curves: list[driver.Curve] = []
    for name, colour in zip(METHODS, (BLUE, GREEN, ORANGE), strict=True):
        own = [(p.states, p.seconds) for p in points if p.method == name and p.ranks == fewest]
        curves.append((name, own, {"color": colour}))
    for peer, mark, colour in (("scipy", "s", HAND), ("slycot", "^", HAND), ("pymor", "x", PURPLE)):
        ran = [p for p in peers if p.method == peer]
        label = f"{peer} (residual to {max((p.residual for p in ran), default=0.0):.0e})"
        look = {"color": colour, "ls": "", "marker": mark, "ms": 5}
        curves.append((label, [(p.states, p.seconds) for p in ran], look))
    return driver.loglog(path, curves, "states 2n", "time [s]", f"{fewest} rank(s), median")


def collect(console: Console, meshes: list[int], ranks: list[int], repeats: int, large: bool, record: Record) -> None:
    """Launch all workers one after the other, the largest last."""
    jobs: list[tuple[int, int, tuple[Method, ...], int]] = [(nx, k, METHODS, repeats) for nx in meshes for k in ranks]
    if large:
        jobs.append((LARGEST, LARGEST_RANKS, ("newton_adi", "galerkin"), 1))
    kept = [record.kept(*job[:3]) for job in jobs]
    record.rows = [point for points in kept for point in points]
    for i, ((nx, k, methods, count), known) in enumerate(zip(jobs, kept, strict=True), start=1):
        label = f"nx = {nx}"
        spec = {"nx": nx, "beta": record.beta, "methods": methods, "repeats": count}
        rows = known or driver.measure(console, SolverPoint, "riccati", spec, k, f"row {i} of {len(jobs)}, {label}")
        if not known:
            record.rows += rows
            record.save()
        times = ", ".join(f"{p.method} {number(p.seconds)} s" for p in driver.of(SolverPoint, rows))
        console.print(f"row {i} of {len(jobs)}, {label}, {k} rank(s): {'kept' if known else times or 'failed'}")


def collect_peers(console: Console, meshes: list[int], record: Record) -> None:
    """The peers on the meshes they can do, one rank."""
    known = {(peer, nx): record.kept(nx, 1, [peer]) for peer in PEER_LIMIT for nx in meshes}
    record.peers = []
    for peer, limit in PEER_LIMIT.items():
        if importlib.util.find_spec(peer) is None:
            record.peers.append(Failure(peer, 1, "not installed"))
            continue
        for nx in meshes:
            label, why = f"{peer}, nx = {nx}", "left out, it needs many minutes or too much memory beyond nx ="
            spec = {"nx": nx, "beta": record.beta, "peer": peer}
            record.peers += known[peer, nx] or (
                [Failure(label, 1, f"{why} {limit}")]
                if nx > limit
                else driver.measure(console, SolverPoint, "riccati", spec, 1, label)
            )
            record.save()


def main(
    sizes: Annotated[str, typer.Option(help="meshes nx; 10 is the paper's")] = SIZES,
    ranks: driver.Ranks = "1,2",
    beta: Annotated[float, typer.Option(help="Kelvin-Voigt time [s]")] = 0.002,
    repeats: Annotated[int, typer.Option(help="repeats behind each median, fewer for long runs", min=1)] = 7,
    out: Annotated[Path, typer.Option(help="folder for bench_riccati.json, .csv, .md, .png and .pdf")] = Path("out"),
    peers: Annotated[bool, typer.Option(help="also SciPy, slycot and pyMOR")] = True,
    large: Annotated[bool, typer.Option("--large", help=f"also nx = {LARGEST}, 2n > 1e6")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="keep the good rows of bench_riccati.json in --out")] = False,
) -> None:
    """See HELP."""
    meshes = driver.parse_numbers(sizes, r"([2-9]|[1-9]\d+)", "number of cells; write 10,20,40")
    counts, console = driver.parse_ranks(ranks), driver.open_console(160)
    record = Record(out / "bench_riccati.json", beta)
    if resume:
        record.resume()
    collect(console, meshes, counts, repeats, large, record)
    if peers:
        collect_peers(console, meshes, record)
    record.save()
    points, lines = record.points, [peer_line(peer) for peer in record.peers]
    table = driver.table_of(points, COLUMNS, "large Riccati equation, paper scene; seconds are medians")
    console.print(table.terminal())
    for line in lines:
        console.print(line, markup=False)
    for label, power in exponents(points).items():
        if power is not None:
            console.print(f"growth exponent of the time in 2n from nx = 20 on, {label}: {power:.2f}")
    driver.show_goals(console, goals(points))
    files = [record.file, driver.table_of(points, CSV).write_csv(out / "bench_riccati.csv"), out / "bench_riccati.md"]
    files[-1].write_text(table.markdown() + "".join(f"\n- {line}" for line in lines) + "\n")
    files += draw(out / "bench_riccati.png", points, driver.of(SolverPoint, record.peers))
    driver.list_bench(console, files, driver.failures(record.rows))
