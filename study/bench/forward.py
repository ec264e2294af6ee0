"""What the forward run costs, as one table, JSON, CSV and figure: ``python -m softgrasp.study.bench forward``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from softgrasp.study.bench import driver
from softgrasp.study.bench.driver import Goal, Row, number
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.jobs import launch_worker

SIZES = "2d:1000,2d:10000,2d:100000,3d:50000"
LARGE = (("2d", 1_000_000), ("3d", 200_000))
LARGE_STEPS, LARGE_RANKS = 60, 2
LIMIT_SMALL, LIMIT = 1.5, 1.15  # TS step over bare solve, below and from n_e = 9000 on
BIG = 9_000
MEMORY_LIMIT_MB = 24 * 1024
MEMORY_FLOOR_MB = 8.0  # growth of memory above the libraries is noise below
METHODS = {
    "ts": "PETSc TS",
    "solve": "bare solve",
    "own": "bare solve, blocks",
    "loop": "textbook loop",
    "scipy": "SciPy",
    "pymor": "pyMOR",
}
HELP = f"""Measure what a forward run costs and print one table.

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


def parse_sizes(text: str) -> list[tuple[str, int]]:
    """``2d:1000,3d:50000`` as pairs; a bare number is 2D. Raises typer.BadParameter: anything else."""
    advice = "size; write 2d:1000 or 3d:50000 with at least 20 unknowns"
    return [
        (kind or "2d", int(size))
        for kind, size in driver.parse_list(text, r"(?:(2d|3d)?:)?([2-9]\d|[1-9]\d\d+)", advice)
    ]


def exponents(rows: Sequence[Row]) -> dict[str, dict[str, float | None]]:
    """Growth over the 2D sizes for each rank count, memory counted above that of the libraries."""
    result = {}
    good = [row for row in driver.measured(rows) if row["dimension"] == 2 and not row["large"]]
    for ranks in sorted({row["ranks"] for row in good}):
        own = [row for row in good if row["ranks"] == ranks]
        n = [row["n_e"] for row in own]
        memory = [row["memory_mb"] - row["memory_base_mb"] for row in own]
        result[str(ranks)] = {
            "assembly": driver.growth(n, [row["seconds"]["assembly"] for row in own]),
            "factor": driver.growth(n, [row["seconds"]["factor"] for row in own]),
            "step": driver.growth(n, [row["step_us"]["ts"] for row in own]),
            "memory": driver.growth(n, [m if m > MEMORY_FLOOR_MB else 0.0 for m in memory]),
        }
    return result


def goals(rows: Sequence[Row]) -> list[Goal]:
    """All goals that the rows can speak for."""
    result = []
    for row in driver.measured(rows):
        label = f"{row['problem']}, {row['ranks']} rank(s)"
        if "ratio" in row:
            limit = LIMIT if row["n_e"] >= BIG else LIMIT_SMALL
            result.append(Goal(f"{label}: TS step / bare solve", row["ratio"], limit))
        seconds = (row["whole"] or {}).get("seconds", {})
        if "scipy" in seconds:
            # both keep every state
            text = f"{row['problem']}, whole run: TS / SciPy"
            result.append(Goal(text, seconds["ts_memory"] / seconds["scipy"], 1.0))
        if row["large"]:
            text = f"{label}, {row['drift_steps']} steps end to end: MiB"
            result.append(Goal(text, row["memory_mb"], MEMORY_LIMIT_MB))
    return result


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
CSV |= {name: name for name in ("ratio", "ratio_own", "drift", "residual", "memory_mb", "memory_base_mb", "error")}


def table_of(rows: Sequence[Row]) -> Table:
    """The table of the terminal and the README."""
    shown = [{"n_e": "-", "solver": "failed"} | row if "error" in row else row for row in rows]
    return driver.table_of(shown, COLUMNS, "cost of a forward run, medians; µs are per time step")


def show(console: Console, rows: Sequence[Row]) -> None:
    """Table, whole runs, exponents and goals."""
    console.print(table_of(rows).terminal())
    for row in rows:
        if "error" in row:
            console.print(f"{row['problem']}, {row['ranks']} rank(s) failed: {row['error']}", markup=False)
            continue
        factors = {"here": row["seconds"]["factor"], **row.get("factor_peer_s", {})}
        if len(factors) > 1:
            names = {"here": "here", "petsc": "PETSc's Cholesky", "scipy": "SciPy (SuperLU)"}
            parts = [f"{names[name]} {number(value)} s" for name, value in factors.items()]
            console.print(f"set-up of the factor, {row['problem']}, {row['ranks']} rank(s): {', '.join(parts)}")
        if row["whole"]:
            seconds = row["whole"]["seconds"]
            names = {"ts_none": "TS", "ts_memory": "TS storing every state", "scipy": "SciPy storing", "pymor": "pyMOR"}
            parts = [f"{names[name]} {1e3 * value:.3g} ms" for name, value in seconds.items()]
            console.print(
                f"whole run, {row['problem']}, 2n = {row['states']}, {row['whole']['steps']} steps, "
                f"{row['ranks']} rank(s), factor included: {', '.join(parts)}; drift {row['whole']['drift']:.0e}"
            )
    for ranks, powers in exponents(rows).items():
        parts = [f"{name} {power:.2f}" for name, power in powers.items() if power is not None]
        if parts:
            console.print(f"growth exponents in n_e over the 2D sizes, {ranks} rank(s): {', '.join(parts)}")
    driver.show_goals(console, goals(rows))


def draw(path: Path, rows: Sequence[Row]) -> tuple[Path, ...]:
    """Per-step time against size for every method, log-log, 2D full and 3D hollow, on one rank (else the fewest)."""
    from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE, SKY

    fewest = min((row["ranks"] for row in driver.measured(rows)), default=1)
    good = [row for row in driver.measured(rows) if row["ranks"] == fewest]
    curves: list[driver.Curve] = []
    for (name, label), colour in zip(METHODS.items(), (BLUE, HAND, SKY, GREEN, ORANGE, PURPLE), strict=True):
        for d, fill in ((2, "full"), (3, "none")):
            own = [row for row in good if row["dimension"] == d and name in row["step_us"]]
            look = {"color": colour, "ls": "--" if name in ("solve", "own") else "-", "fillstyle": fill}
            curves.append((label, [(row["n_e"], row["step_us"][name]) for row in own], look))
            label = f"_{label}" if own else label  # named once
    title = f"median, {'one rank' if fewest == 1 else f'{fewest} ranks'}; hollow: 3D"
    return driver.loglog(path, curves, "tissue unknowns $n_e$", "time of one step [µs]", title)


def collect(console: Console, sizes: list[tuple[str, int]], ranks: list[int], repeats: int, large: bool) -> list[Row]:
    """Launch all workers one after the other."""
    rows: list[Row] = []
    jobs: list[tuple[str, int, int, bool]] = [(kind, size, k, False) for kind, size in sizes for k in ranks]
    if large:
        jobs += [(kind, size, LARGE_RANKS, True) for kind, size in LARGE]
    for kind, size, k, big in jobs:
        paper = (kind, size) == ("2d", 1000)
        problem = f"{kind.upper()} paper" if paper else f"{kind.upper()} {size:.0e}".replace("e+0", "e")
        spec: dict[str, Any] = {"dimension": int(kind[0]), "size": size, "large": big}
        spec |= {"steps": LARGE_STEPS} if big else {"repeats": repeats, "whole": paper}
        with console.status(f"{problem}, {k} rank(s)"):
            row = launch_worker("forward", spec, k)
        rows.append({"ranks": k} | row | {"problem": problem, "large": big})
    return rows


def main(
    sizes: Annotated[str, typer.Option(help="tissue unknowns; 2d:1000 is the paper's scene exactly")] = SIZES,
    ranks: Annotated[str, typer.Option(help="MPI rank counts; no more than there are cores")] = "1,2",
    repeats: Annotated[int, typer.Option(help="repeats behind each median", min=1)] = 25,
    out: Annotated[Path, typer.Option(help="folder for bench.json, bench.csv, bench.png and bench.pdf")] = Path("out"),
    large: Annotated[bool, typer.Option("--large", help=f"also 1e6 (2D) and 2e5 (3D), {LARGE_STEPS} steps")] = False,
) -> None:
    """See HELP."""
    console = driver.open_console(175)
    rows = collect(console, parse_sizes(sizes), driver.parse_ranks(ranks), repeats, large)
    show(console, rows)
    content = {"command": "bench_forward", "rows": rows, "exponents": exponents(rows)}
    content |= {"goals": driver.goal_rows(goals(rows))}
    markdown = table_of(driver.measured(rows)).markdown()
    files = driver.write_bench(out, "bench", content, driver.table_of(rows, CSV), markdown)
    driver.list_bench(console, [*files, *draw(out / "bench.png", rows)], any("error" in row for row in rows))
