"""What the large Riccati equation costs, as table, JSON, CSV, figure: ``python -m softgrasp.study.bench riccati``."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer
from pydantic import TypeAdapter
from rich.console import Console

from softgrasp.fem.errors import CheckpointError
from softgrasp.study.bench import driver
from softgrasp.study.bench.driver import Failure, Goal, number
from softgrasp.study.bench.riccati_rows import STAGES, RiccatiPoint
from softgrasp.study.report.files import write_json

SIZES = "10,20,40,80,160"
EVERY = ("newton_adi", "radi", "galerkin")
LARGEST, LARGEST_RANKS = 355, 2  # 2n = 1 009 660
PEER_LIMIT = {"scipy": 10, "slycot": 10, "pymor": 40}  # nx; minutes beyond
LIMITS = {("newton_adi", 10): 0.2, ("newton_adi", 80): 20.0, ("galerkin", 10): 0.03, ("galerkin", 80): 4.0}  # [s]
LARGE_SECONDS, LARGE_MB = 900.0, 24 * 1024
RESIDUAL, GAIN = 1e-10, 1e-6
HELP = f"""Measure the large Riccati equation of the paper's control scene and print one table.

Every row is a program of its own under mpiexec: Newton-ADI, RADI and structured Galerkin on nx x 2 nx cells. Columns:
solves with a complex tissue matrix, rank of Z, seconds (median) split into factorisations, triangular solves, start
and shifts, products with small dense algebra and compression, and the recomputation of the residual; the true relative
residual from Z; the relative difference of the gain to that of Newton-ADI; peak memory of all ranks. Below: SciPy,
slycot and pyMOR on the paper's own matrices where they are installed and can run (slycot and SciPy to nx = 10, pyMOR to
nx = 40), growth exponents over the meshes, and the goals. On one rank Newton-ADI and RADI make the next factor on a
second core where there is one. bench_riccati.json is written after every row; --resume keeps the rows it has.

Keep the machine quiet while it runs. A fast look: --sizes 10 --ranks 1 --no-peers.
--large adds nx = {LARGEST} (2n > 1e6) on {LARGEST_RANKS} ranks by Newton-ADI and Galerkin: up to half an hour."""
COLUMNS = {
    "nx": "nx", "2n": "states", "ranks": "ranks", "method": "method", "solves": "solves", "rank": "rank",
    "total s": "seconds 3", **{f"{name} s": f"split.{name} 3" for name in STAGES}, "true residual": "residual .1e",
    "gain diff.": "gain_difference .1e", "MiB": "memory_mb 3",
}  # fmt: skip
CSV = {name: name for name in ("nx", "states", "ranks", "method", "solves", "newton_steps", "rank", "seconds")}
CSV |= {name: name for name in ("residual", "gain_difference", "memory_mb", "memory_base_mb")}
CSV |= {f"{name}_s": f"split.{name}" for name in STAGES}
Rows = list[RiccatiPoint | Failure]


@dataclass
class Record:
    """Rows as they come, in a file that outlives whatever goes wrong with the next one."""

    file: Path  # bench_riccati.json
    beta: float  # Kelvin-Voigt time of all rows [s]
    # rows, peers: what is measured
    rows: Rows = field(default_factory=list)
    peers: Rows = field(default_factory=list)

    @property
    def points(self) -> list[RiccatiPoint]:
        """Rows that did not fail."""
        return driver.of(RiccatiPoint, self.rows)

    def resume(self) -> None:
        """Take over what an earlier run with the same damping has measured.

        Raises:
            CheckpointError: the file is not one of these.
        """
        adapter = TypeAdapter(list[RiccatiPoint])
        try:
            old = json.loads(self.file.read_text()) if self.file.is_file() else {}
            if old.get("beta") == self.beta:
                rows, peers = (adapter.validate_python(old[key]) for key in ("rows", "peers"))
                self.rows, self.peers = [*rows], [*peers]
        except (ValueError, KeyError, AttributeError) as error:
            raise CheckpointError(f"{self.file} holds no rows of this version; run once without --resume") from error

    def kept(self, nx: int, ranks: int, methods: Sequence[str]) -> Rows:
        """The points of a row where all its methods are there."""
        own = [p for p in driver.of(RiccatiPoint, [*self.rows, *self.peers]) if (p.nx, p.ranks) == (nx, ranks)]
        return [p for p in own if p.method in methods] if {p.method for p in own} >= set(methods) else []

    def save(self) -> None:
        """Write the file."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        peers = driver.of(RiccatiPoint, self.peers)
        report = {"command": "bench_riccati", "beta": self.beta, "rows": driver.as_rows(self.points)}
        report |= {"peers": driver.as_rows(peers), "exponents": exponents(self.points)}
        report |= {"failed": driver.as_rows(driver.failures([*self.rows, *self.peers]))}
        write_json(self.file, report | {"goals": driver.goal_rows(goals(self.points))})


def exponents(points: Sequence[RiccatiPoint]) -> dict[str, float | None]:
    """Growth of time with the number of states, from nx = 20 on, by method and rank count."""
    result: dict[str, float | None] = {}
    for method, ranks in sorted({(p.method, p.ranks) for p in points if p.nx >= 20}):
        own = [p for p in points if p.nx >= 20 and (p.method, p.ranks) == (method, ranks)]
        result[f"{method}, {ranks} rank(s)"] = driver.growth([p.states for p in own], [p.seconds for p in own])
    return result


def goals(points: Sequence[RiccatiPoint]) -> list[Goal]:
    """All goals that the points can speak for."""
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


def peer_line(peer: RiccatiPoint | Failure) -> str:
    """One sentence about a peer."""
    if isinstance(peer, Failure):
        return f"{peer.label}: {peer.error}"
    return (
        f"{peer.method}, nx = {peer.nx}: {number(peer.seconds)} s, rank {peer.rank}, true residual "
        f"{peer.residual:.1e}, gain difference {peer.gain_difference:.1e}"
    )


def draw(path: Path, points: Sequence[RiccatiPoint], peers: Sequence[RiccatiPoint]) -> tuple[Path, ...]:
    """Time against states for every method on the fewest ranks, peers as single marks, log-log."""
    from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE

    fewest = min((p.ranks for p in points), default=1)
    curves: list[driver.Curve] = []
    for name, colour in zip(EVERY, (BLUE, GREEN, ORANGE), strict=True):
        own = [(p.states, p.seconds) for p in points if p.method == name and p.ranks == fewest]
        curves.append((name, own, {"color": colour}))
    for name, mark, colour in (("scipy", "s", HAND), ("slycot", "^", HAND), ("pymor", "x", PURPLE)):
        ran = [p for p in peers if p.method == name]
        label = f"{name} (residual to {max((p.residual for p in ran), default=0.0):.0e})"
        look = {"color": colour, "ls": "", "marker": mark, "ms": 5}
        curves.append((label, [(p.states, p.seconds) for p in ran], look))
    return driver.loglog(path, curves, "states 2n", "time [s]", f"{fewest} rank(s), median")


def collect(console: Console, meshes: list[int], ranks: list[int], repeats: int, large: bool, record: Record) -> None:
    """Launch all workers one after the other, the largest last."""
    jobs: list[tuple[int, int, tuple[str, ...], int]] = [(nx, k, EVERY, repeats) for nx in meshes for k in ranks]
    if large:
        jobs.append((LARGEST, LARGEST_RANKS, ("newton_adi", "galerkin"), 1))
    kept = [record.kept(*job[:3]) for job in jobs]
    record.rows = [point for points in kept for point in points]
    for i, ((nx, k, methods, count), known) in enumerate(zip(jobs, kept, strict=True), start=1):
        label = f"nx = {nx}"
        spec = {"nx": nx, "beta": record.beta, "methods": methods, "repeats": count}
        rows = known or driver.measure(console, RiccatiPoint, "riccati", spec, k, f"row {i} of {len(jobs)}, {label}")
        if not known:
            record.rows += rows
            record.save()
        times = ", ".join(f"{p.method} {number(p.seconds)} s" for p in driver.of(RiccatiPoint, rows))
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
            label, why = f"{peer}, nx = {nx}", "left out, it takes many minutes or too much memory beyond nx ="
            spec = {"nx": nx, "beta": record.beta, "peer": peer}
            record.peers += known[peer, nx] or (
                [Failure(label, 1, f"{why} {limit}")]
                if nx > limit
                else driver.measure(console, RiccatiPoint, "riccati", spec, 1, label)
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
    files += draw(out / "bench_riccati.png", points, driver.of(RiccatiPoint, record.peers))
    driver.list_bench(console, files, driver.failures(record.rows))
