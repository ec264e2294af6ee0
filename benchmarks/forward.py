"""Time and memory of the forward run, as one table, JSON, CSV and figure: ``python -m benchmarks forward``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from benchmarks import driver
from benchmarks.driver import Failure, Goal
from benchmarks.forward_rows import ForwardCost
from softgrasp.study.report.document import Table, number
from softgrasp.study.shell.timing import power_law

SIZES = "2d:1000,2d:10000,2d:100000,3d:50000"
LARGE = (("2d", 1_000_000), ("3d", 200_000))
LARGE_STEPS, LARGE_RANKS = 60, 2
LIMIT_SMALL, LIMIT = 1.5, 1.15  # TS step over bare solve, below and from n_e = 9000 on
BIG = 9_000
MEMORY_LIMIT_MB = 24 * 1024
MEMORY_NOISE_MB = 8.0  # growth of memory above the libraries is noise below
METHODS = ("ts", "solve", "own", "loop", "scipy", "pymor")
LABELS = ("PETSc TS", "bare solve", "bare solve, blocks", "textbook loop", "SciPy", "pyMOR")
FACTORS = {"here": "here", "petsc": "PETSc's Cholesky", "scipy": "SciPy (SuperLU)"}
WHOLE = {"ts_none": "TS", "ts_memory": "TS storing every state", "scipy": "SciPy storing", "pymor": "pyMOR"}
HELP = f"""Measure time and memory of a forward run and print one table.

Every row is a program of its own under mpiexec. In it all methods take turns, several times, and the median
counts, so that noise of the machine hits all alike. Columns: assembly and factor [s]; microseconds of one time step
by PETSc TS (what `softgrasp simulate` does) and by the bare triangular solves alone, as PETSc's solver gives them
(-pc_type cholesky, or MUMPS); the median of their quotient, with its goal; the same for the solves that the step
itself does, with a Cholesky factor of d x d blocks: what a step adds to them is the product with K, vectors and TS;
microseconds by a textbook loop (PETSc's solve, on several ranks ours; products with K and M), by SciPy (sparse LU,
same loop) and by pyMOR's implicit midpoint (up to n_e = 12 000, where installed); energy drift; peak memory of all
ranks before SciPy and pyMOR start. Below: set-up of the factor here, by PETSc and by SciPy; the paper's scene as a
whole run; growth exponents p of cost ~ n^p over the 2D sizes.

Keep the machine quiet while it runs. A fast look: --sizes 2d:1000 --ranks 1 --repeats 3.
--large adds 2D with 1e6 and 3D with 2e5 unknowns, {LARGE_STEPS} steps each on {LARGE_RANKS} ranks: minutes, GiB."""
COLUMNS = {
    "problem": "problem", "n_e": "n_e", "ranks": "ranks", "solver": "solver", "assembly [s]": "seconds.assembly 3",
    "factor [s]": "seconds.factor 3", "TS step [µs]": "step_us.ts 3", "bare solve [µs]": "step_us.solve 3",
    "TS / solve": "ratio 3", "own solve [µs]": "step_us.own 3", "TS / own": "ratio_own 3",
    "SciPy step [µs]": "step_us.scipy 3", "pyMOR step [µs]": "step_us.pymor 3", "drift": "drift .0e",
    "memory [MiB]": "memory_mb 3",
}  # fmt: skip
CSV = {name: name for name in ("problem", "dimension", "n_e", "ranks", "solver", "steps_per_repeat", "repeats")}
CSV |= {f"{stage}_s": f"seconds.{stage}" for stage in ("mesh", "assembly", "factor")}
CSV |= {f"{method}_us": f"step_us.{method}" for method in METHODS}
CSV |= {name: name for name in ("ratio", "ratio_own", "drift", "residual", "memory_mb", "memory_base_mb")}


def parse_sizes(text: str) -> list[tuple[str, int]]:
    """``2d:1000,3d:50000`` as pairs; a bare number is 2D. Raises typer.BadParameter: anything else."""
    advice = "size; write 2d:1000 or 3d:50000 with at least 20 unknowns"
    parts = driver.parse_list(text, r"(?:(2d|3d)?:)?([2-9]\d|[1-9]\d\d+)", advice)
    return [(kind or "2d", int(size)) for kind, size in parts]


def exponents(points: Sequence[ForwardCost]) -> dict[str, dict[str, float | None]]:
    """Growth over the 2D sizes for each rank count, memory counted above that of the libraries."""
    result = {}
    plane = [point for point in points if point.dimension == 2 and not point.large]
    for ranks in sorted({point.ranks for point in plane}):
        own = [point for point in plane if point.ranks == ranks]
        memory = [point.memory_mb - point.memory_base_mb for point in own]
        costs = {
            "assembly": [point.seconds["assembly"] for point in own],
            "factor": [point.seconds["factor"] for point in own],
            "step": [point.step_us["ts"] for point in own],
            "memory": [m if m > MEMORY_NOISE_MB else 0.0 for m in memory],
        }
        n = [point.n_e for point in own]
        result[str(ranks)] = {name: power_law(n, cost) for name, cost in costs.items()}
    return result


def goals(points: Sequence[ForwardCost]) -> list[Goal]:
    """All goals that the measured points decide."""
    result = []
    for p in points:
        label = f"{p.problem}, {p.ranks} rank(s)"
        if p.ratio is not None:
            result.append(Goal(f"{label}: TS step / bare solve", p.ratio, LIMIT if p.n_e >= BIG else LIMIT_SMALL))
        if p.whole is not None and "scipy" in p.whole.seconds:  # both keep every state
            ratio = p.whole.seconds["ts_memory"] / p.whole.seconds["scipy"]
            result.append(Goal(f"{p.problem}, whole run: TS / SciPy", ratio, 1.0))
        if p.large:
            result.append(Goal(f"{label}, {p.drift_steps} steps end to end: MiB", p.memory_mb, MEMORY_LIMIT_MB))
    return result


def table_of(points: Sequence[ForwardCost]) -> Table:
    """The table of the terminal and the README."""
    return driver.table_of(points, COLUMNS, "cost of a forward run, medians; µs are per time step")


def show(console: Console, points: Sequence[ForwardCost]) -> None:
    """Table, set-ups, whole runs, exponents and goals."""
    console.print(table_of(points).terminal())
    for p in points:
        label, factors = f"{p.problem}, {p.ranks} rank(s)", {"here": p.seconds["factor"], **p.factor_peer_s}
        if len(factors) > 1:
            parts = [f"{FACTORS[name]} {number(value)} s" for name, value in factors.items()]
            console.print(f"set-up of the factor, {label}: {', '.join(parts)}")
        if p.whole is not None:
            parts = [f"{WHOLE[name]} {1e3 * value:.3g} ms" for name, value in p.whole.seconds.items()]
            console.print(
                f"whole run, {p.problem}, 2n = {p.states}, {p.whole.steps} steps, {p.ranks} rank(s), factor included: "
                f"{', '.join(parts)}; drift {p.whole.drift:.0e}"
            )
    for ranks, powers in exponents(points).items():
        if parts := [f"{name} {power:.2f}" for name, power in powers.items() if power is not None]:
            console.print(f"growth exponents in n_e over the 2D sizes, {ranks} rank(s): {', '.join(parts)}")
    driver.show_goals(console, goals(points))


def draw(path: Path, points: Sequence[ForwardCost]) -> tuple[Path, ...]:
    """Per-step time against size for every method, log-log, 2D full and 3D hollow, on one rank (else the fewest)."""
    from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE, SKY

    fewest = min((point.ranks for point in points), default=1)
    curves: list[driver.Curve] = []
    for name, label, colour in zip(METHODS, LABELS, (BLUE, HAND, SKY, GREEN, ORANGE, PURPLE), strict=True):
        for d, fill in ((2, "full"), (3, "none")):
            own = [p for p in points if p.ranks == fewest and p.dimension == d and name in p.step_us]
            look = {"color": colour, "ls": "--" if name in ("solve", "own") else "-", "fillstyle": fill}
            curves.append((label, [(p.n_e, p.step_us[name]) for p in own], look))
            label = f"_{label}" if own else label  # named once
    title = f"median, {'one rank' if fewest == 1 else f'{fewest} ranks'}; hollow: 3D"
    return driver.loglog(path, curves, "tissue unknowns $n_e$", "time of one step [µs]", title)


def main(
    sizes: Annotated[str, typer.Option(help="tissue unknowns; 2d:1000 is the paper's scene exactly")] = SIZES,
    ranks: driver.Ranks = "1,2",
    repeats: driver.Repeats = 25,
    out: Annotated[Path, typer.Option(help="folder for bench.json, bench.csv, bench.png and bench.pdf")] = Path("out"),
    large: Annotated[bool, typer.Option("--large", help=f"also 1e6 (2D) and 2e5 (3D), {LARGE_STEPS} steps")] = False,
) -> None:
    """See HELP."""
    console, rows = driver.open_console(175), list[ForwardCost | Failure]()
    jobs = [(kind, size, k, False) for kind, size in parse_sizes(sizes) for k in driver.parse_ranks(ranks)]
    jobs += [(kind, size, LARGE_RANKS, True) for kind, size in LARGE] if large else []
    for kind, size, k, big in jobs:
        paper = (kind, size) == ("2d", 1000)
        problem = f"{kind.upper()} paper" if paper else f"{kind.upper()} {size:.0e}".replace("e+0", "e")
        spec: dict[str, Any] = {"problem": problem, "dimension": int(kind[0]), "size": size, "large": big}
        spec |= {"steps": LARGE_STEPS} if big else {"repeats": repeats, "whole": paper}
        rows += driver.measure(console, ForwardCost, "forward", spec, k, problem)
    points, failed = driver.of(ForwardCost, rows), driver.failures(rows)
    show(console, points)
    content: dict[str, Any] = {"command": "bench_forward", "rows": points}
    content |= {"failed": failed, "exponents": exponents(points)}
    content |= {"goals": driver.goal_rows(goals(points))}
    table = driver.table_of(points, CSV)
    files = driver.write_bench(out, "bench", content, table, table_of(points).markdown())
    driver.list_bench(console, [*files, *draw(out / "bench.png", points)], failed)
