"""How runs grow with unknowns and ranks, stage by stage, beside the cost model: ``python -m benchmarks scale``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import psutil
import typer
from mpi4py import MPI
from rich.console import Console

from benchmarks import driver
from benchmarks.driver import Failure, Goal
from benchmarks.scale_rows import STEPS, ScaleCost, scale_scene
from softgrasp.fem.run.forecast import forecast
from softgrasp.study.report.document import Table, number
from softgrasp.study.shell.timing import power_law

SIZES = (
    "2d1:10000,2d1:30000,2d1:100000,2d1:400000,2d2:30000,2d2:100000,3d1:7000,3d1:21000,3d1:68000,3d2:8000,3d2:21000:mumps,"
    "3d2:68000:mumps,3d2:21000:stars,3d2:68000:stars,3d2:198000:stars"
)
WEAK = "3d2:21000:stars"
PATTERN = r"([23]d[123]):(\d+)(?::(cholesky|mumps|cg|stars))?"
STAGES = ("build", "set-up", "equilibrium", "step", "frame")
FRAMES = 60  # field files of a run up to 1e5 unknowns
GROWTH = 1.4  # largest exponent but that of a factor in 3D, which is 2 by nested dissection
LARGEST, LEAST = 10**8, 10**3  # unknowns of the model's lines
DRAWN = (1, 2, 16, 128, 1024)  # ranks of the model's lines
PER_RANK = 16.0 * 2**30  # memory of a rank beyond which a line ends [byte]
HELP = f"""Measure how runs grow with unknowns and ranks, stage by stage, and how wrong the cost model is.

Stages: mesh and assembly (build), factor or set-up of the preconditioner, equilibrium under gravity, one of {STEPS}
steps, one field file. Every row is a program of its own under mpiexec; seconds are processor time of its slowest rank.
Rows on more ranks than there are cores give counts only: iterations, and the operations of the busiest rank over the
mean. Strong scaling: --ranks on the same sizes; weak scaling: --weak, the unknowns of a rank, on --counts ranks.

The figure has the model's lines to {LARGEST:.0e} unknowns on {DRAWN[-1]} ranks, and the rows measured here on them."""


def kind_of(text: str) -> str:
    """``3d2`` as rows name it."""
    return f"{text[0]}D P{text[2]}"


def total(stages: dict[str, float]) -> float:
    """Seconds of a run of 200 steps."""
    return float(sum({"step": STEPS, "frame": FRAMES}.get(name, 1) * value for name, value in stages.items()))


def timed(rows: Sequence[ScaleCost]) -> list[ScaleCost]:
    """Rows with a core for each rank."""
    cores = psutil.cpu_count(logical=False) or 1
    return [row for row in rows if row.ranks <= cores]


def exponents(rows: Sequence[ScaleCost]) -> dict[str, dict[str, float | None]]:
    """Growth with n_e by kind and solver on one rank, of stages, whole run and memory above the libraries."""
    result = {}
    for kind, solver in sorted({(row.kind, row.solver) for row in rows if row.ranks == 1}):
        own = [row for row in rows if (row.kind, row.solver, row.ranks) == (kind, solver, 1)]
        n = [row.n_e for row in own]
        powers = {name: power_law(n, [row.seconds[name] for row in own]) for name in STAGES}
        powers["run"] = power_law(n, [total(row.seconds) for row in own])
        powers["memory"] = power_law(n, [row.memory_mb - row.memory_base_mb for row in own])
        if powers["run"] is not None:
            result[f"{kind}, {solver}"] = powers
    return result


def wrong(rows: Sequence[ScaleCost]) -> dict[str, tuple[float, float]]:
    """Factor by which the model is wrong, geometric mean and largest, of stages, whole run and memory."""
    result = {}
    for name in (*STAGES, "run", "memory"):
        pairs = [_pair(row, name) for row in rows]
        logs = [abs(np.log(a / b)) for a, b in pairs if a > 0 and b > 0]
        if logs:
            result[name] = (float(np.exp(np.mean(logs))), float(np.exp(max(logs))))
    return result


def _pair(row: ScaleCost, name: str) -> tuple[float, float]:
    if name == "memory":
        return row.memory_mb, row.memory_modelled_mb
    if name == "run":
        return total(row.seconds), total(row.modelled)
    return row.seconds[name], row.modelled[name]


def goals(rows: Sequence[ScaleCost]) -> list[Goal]:
    """Exponents that the rows determine; a factor in 3D, the equilibrium and the run with one are left out."""
    result = []
    for label, powers in exponents(timed(rows)).items():
        direct = label.startswith("3D") and not label.endswith(("stars", "cg"))
        for name, power in powers.items():
            if power is not None and not (direct and name in ("set-up", "equilibrium", "run")):
                result.append(Goal(f"{label}, {name}: exponent", power, GROWTH))
    return result


COLUMNS: driver.Columns = {
    "elements": "kind", "n_e": "n_e", "ranks": "ranks", "solver": "solver", "iterations": "iterations 3",
    "build [s]": "seconds.build 3", "set-up [s]": "seconds.set-up 3", "equilibrium [s]": "seconds.equilibrium 3",
    "step [ms]": lambda row: number(1e3 * row.seconds["step"]),
    "frame [ms]": lambda row: number(1e3 * row.seconds["frame"]),
    "run [s]": lambda row: number(total(row.seconds)), "model [s]": lambda row: number(total(row.modelled)),
    "MiB": "memory_mb .0f", "model [MiB]": "memory_modelled_mb .0f",
    "busiest / mean": lambda row: number(row.balance["step"]),
}  # fmt: skip


def table_of(rows: Sequence[ScaleCost]) -> Table:
    """One line a row; without times where ranks share cores."""
    table = driver.table_of(rows, COLUMNS, f"processor time of the slowest rank; a run has {STEPS} steps")
    known, first = timed(rows), list(COLUMNS).index("build [s]")
    last = list(COLUMNS).index("MiB")
    cells = [
        line if row in known else [*line[:first], *["-"] * (last - first), *line[last:]]
        for row, line in zip(rows, table.rows, strict=True)
    ]
    return Table(table.header, cells, table.title)


def show(console: Console, rows: Sequence[ScaleCost]) -> None:
    """Table, exponents, errors of the model, goals."""
    console.print(table_of(rows).terminal())
    for label, powers in exponents(timed(rows)).items():
        parts = [f"{name} {power:.2f}" for name, power in powers.items() if power is not None]
        console.print(f"growth exponents in n_e, {label}: {', '.join(parts)}")
    parts = [f"{name} {mean:.2g} (at most {most:.2g})" for name, (mean, most) in wrong(timed(rows)).items()]
    console.print(f"the model is wrong by a factor of: {', '.join(parts)}")
    driver.show_goals(console, goals(rows))


def lines(kind: str) -> dict[int, list[tuple[float, float]]]:
    """The model's seconds of a run against unknowns by the number of ranks, to where a rank's memory is full."""
    d, order = int(kind[0]), int(kind[-1])
    scene, result = scale_scene(MPI.COMM_SELF, kind, LEAST), dict[int, list[tuple[float, float]]]()
    per_cell = order**d * (1 if d == 2 else 0.5)
    for ranks in DRAWN:
        result[ranks] = []
        for n in np.geomspace(LEAST, LARGEST, 61):
            told = forecast(scene, int(n), d, int(n / per_cell), ranks)
            if told.memory <= ranks * PER_RANK:
                result[ranks].append((float(n), told.seconds))
    return result


def draw(path: Path, rows: Sequence[ScaleCost], kind: str) -> tuple[Path, ...]:
    """The model's lines of runs against unknowns on up to 1024 ranks, and what was measured."""
    from softgrasp.fem.run.forecast import START
    from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE

    curves: list[driver.Curve] = []
    for (ranks, points), colour in zip(lines(kind).items(), (BLUE, ORANGE, GREEN, PURPLE, HAND), strict=True):
        name = f"{ranks} rank{'s' * (ranks > 1)}"
        curves.append((f"model, {name}", points, {"color": colour, "marker": ""}))
        own = [(r.n_e, START + total(r.seconds)) for r in timed(rows) if (r.kind, r.ranks) == (kind, ranks)]
        curves.append((f"measured, {name}", own, {"color": colour, "ls": ""}))
    title = f"{kind}, {STEPS} steps, $\\nu$ = 0.49"
    return driver.loglog(path, curves, "tissue unknowns $n_e$", "time of a run [s]", title)


def main(
    sizes: Annotated[
        str, typer.Option(help="dimension, order, unknowns and a solver, if any: 3d2:68000:stars")
    ] = SIZES,
    ranks: driver.Ranks = "1,2",
    weak: Annotated[str, typer.Option(help="the same, of each rank; '' leaves weak scaling out")] = WEAK,
    counts: Annotated[str, typer.Option(help="ranks of weak scaling")] = "1,2,4,8",
    out: Annotated[Path, typer.Option(help="folder for scale.json, scale.csv, scale.png and scale.pdf")] = Path("out"),
) -> None:
    """See HELP."""
    console, rows = driver.open_console(175), list[ScaleCost | Failure]()
    advice = "size; write 3d2:68000 or 3d2:68000:stars"
    jobs = [(*one, 1, k) for one in driver.parse_list(sizes, PATTERN, advice) for k in driver.parse_ranks(ranks)]
    if weak:
        jobs += [(*one, k, k) for one in driver.parse_list(weak, PATTERN, advice) for k in driver.parse_ranks(counts)]
    for text, size, solver, times, k in jobs:
        spec: dict[str, Any] = {"kind": kind_of(text), "size": int(size) * times, "solver": solver or "auto"}
        rows += driver.measure(console, ScaleCost, "scale", spec, k, f"{spec['kind']} {spec['size']}")
    points, failed = driver.of(ScaleCost, rows), driver.failures(rows)
    show(console, points)
    content: dict[str, Any] = {"command": "bench_scale", "rows": points, "failed": failed}
    content |= {"exponents": exponents(timed(points)), "wrong": wrong(timed(points))}
    content |= {"goals": driver.goal_rows(goals(points))}
    table = table_of(points)
    files = driver.write_bench(out, "scale", content, table, table.markdown())
    driver.list_bench(console, [*files, *draw(out / "scale.png", points, "3D P2")], failed)
