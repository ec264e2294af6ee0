"""What the large Riccati equation costs, as table, JSON, CSV, figure: ``python -m softgrasp.study.bench riccati``."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from softgrasp.study.bench import driver
from softgrasp.study.bench.driver import Goal, Row, number
from softgrasp.study.report.tables import Table
from softgrasp.study.shell.jobs import launch_worker

SIZES = "10,20,40,80,160"
LARGEST, LARGEST_RANKS = 355, 2  # 2n = 1 009 660
PEER_LIMIT = {"scipy": 10, "slycot": 10, "pymor": 40}  # nx; minutes beyond
LIMITS = {("newton_adi", 10): 0.2, ("newton_adi", 80): 20.0, ("galerkin", 10): 0.03, ("galerkin", 80): 4.0}  # [s]
LARGE_SECONDS, LARGE_MB = 900.0, 24 * 1024
RESIDUAL, GAIN = 1e-10, 1e-6
SPLIT = ("factor", "solve", "shifts", "dense", "residual")
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


def parse_meshes(text: str) -> list[int]:
    """``10,20`` as numbers of cells. Raises typer.BadParameter: anything else."""
    return driver.parse_numbers(text, r"([2-9]|[1-9]\d+)", "number of cells; write 10,20,40")


def launch(spec: dict[str, Any], ranks: int) -> Row:
    """Run one worker under mpiexec; its numbers, or ``error`` with the reason it gave.

    The methods that were through when a worker ran out of time or memory keep their numbers.
    """
    with tempfile.TemporaryDirectory() as folder:
        partial = Path(folder) / "partial.json"
        extra = {"partial": str(partial)} if "methods" in spec else {}
        row = {"ranks": ranks} | launch_worker("riccati", spec | extra, ranks)
        if "error" in row and partial.is_file():
            reason = row.pop("error")
            row |= json.loads(partial.read_text())
            row["methods"] = {name: {"error": reason} for name in spec["methods"]} | row["methods"]
    return row


@dataclass
class Record:
    """Rows as they come, in a file that outlives whatever goes wrong with the next one."""

    file: Path  # bench_riccati.json
    beta: float  # Kelvin-Voigt time of all rows [s]
    # rows, peers: what is measured
    rows: list[Row] = field(default_factory=list)
    peers: list[Row] = field(default_factory=list)

    def resume(self) -> None:
        """Take over the rows of an earlier run with the same damping that have no error."""
        if not self.file.is_file():
            return
        old = json.loads(self.file.read_text())
        if old.get("beta") == self.beta:
            self.rows = [row for row in old["rows"] if not any("error" in entry for entry in [row, *flat([row])])]
            self.peers = [row for row in old["peers"] if "error" not in row and not row.get("missing")]

    def save(self) -> None:
        """Write the file."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        report = {"command": "bench_riccati", "beta": self.beta, "rows": self.rows, "peers": self.peers}
        report |= {"exponents": exponents(self.rows), "goals": driver.goal_rows(goals(self.rows))}
        self.file.write_text(json.dumps(report, indent=2) + "\n")


def flat(rows: Sequence[Row]) -> list[Row]:
    """One entry for each mesh, rank count and method that ran."""
    result = []
    for row in rows:
        for name, method in row.get("methods", {}).items():
            common = {key: row[key] for key in ("nx", "states", "ranks")}
            result.append(common | {"method": name} | method)
    return result


def exponents(rows: Sequence[Row]) -> dict[str, float | None]:
    """Growth of time with the number of states, from nx = 20 on, by method and rank count."""
    result: dict[str, float | None] = {}
    good = [entry for entry in driver.measured(flat(rows)) if entry["nx"] >= 20]
    for key in sorted({(entry["method"], entry["ranks"]) for entry in good}):
        own = [entry for entry in good if (entry["method"], entry["ranks"]) == key]
        result[f"{key[0]}, {key[1]} rank(s)"] = driver.growth([e["states"] for e in own], [e["seconds"] for e in own])
    return result


def goals(rows: Sequence[Row]) -> list[Goal]:
    """All goals that the rows can speak for."""
    result = []
    good = driver.measured(flat(rows))
    for entry in good:
        label = f"{entry['method']}, 2n = {entry['states']}, {entry['ranks']} rank(s)"
        limit = LIMITS.get((entry["method"], entry["nx"]))
        if limit is not None and entry["ranks"] == 1:
            result.append(Goal(f"{label}: seconds", entry["seconds"], limit))
        if entry["method"] != "galerkin":
            result.append(Goal(f"{label}: true residual", entry["residual"], RESIDUAL))
        elif "gain_difference" in entry:
            result.append(Goal(f"{label}: gain difference", entry["gain_difference"], GAIN))
        if entry["states"] >= 1_000_000:
            result.append(Goal(f"{label}: seconds", entry["seconds"], LARGE_SECONDS))
            result.append(Goal(f"{label}: MiB", entry["memory_mb"], LARGE_MB))
    newton = [e for e in good if e["method"] == "newton_adi" and e["ranks"] == 1]
    if len(newton) > 1:
        counts = [e["solves"] for e in sorted(newton, key=lambda e: e["nx"])]
        result.append(Goal("newton_adi: solves on the finest mesh / coarsest", counts[-1] / counts[0], 1.5))
    for label, power in exponents(rows).items():
        if power is not None and len({e["nx"] for e in good if e["nx"] >= 20}) > 2:
            result.append(Goal(f"{label}: growth exponent", power, 1.3))
    return result


COLUMNS = {
    "nx": "nx", "2n": "states", "ranks": "ranks", "method": "method", "solves": "solves", "rank": "rank",
    "total s": "seconds 3", **{f"{name} s": f"split.{name} 3" for name in SPLIT}, "true residual": "residual .1e",
    "gain diff.": "gain_difference .1e", "MiB": "memory_mb 3",
}  # fmt: skip
CSV = {name: name for name in ("nx", "states", "ranks", "method", "solves", "newton_steps", "rank", "seconds")}
CSV |= {name: name for name in ("residual", "gain_difference", "memory_mb", "memory_base_mb", "error")}
CSV |= {f"{name}_s": f"split.{name}" for name in SPLIT}


def table_of(rows: Sequence[Row], title: str = "") -> Table:
    """One line a mesh, rank count and method."""
    shown = [{"solves": "failed"} | entry if "error" in entry else entry for entry in flat(rows)]
    return driver.table_of(shown, COLUMNS, title)


def peer_line(peer: Row) -> str:
    """One sentence about a peer."""
    label = f"{peer['peer']}, nx = {peer['nx']}"
    if peer.get("missing"):
        return f"{label}: not installed"
    if "skipped" in peer:
        return f"{label}: left out, {peer['skipped']}"
    if "error" in peer:
        return f"{label}: failed, {peer['error']}"
    return (
        f"{label}: {number(peer['seconds'])} s, rank {peer['rank']}, true residual {peer['residual']:.1e}, "
        f"gain difference {peer['gain_difference']:.1e}"
    )


def show(console: Console, rows: Sequence[Row], peers: Sequence[Row]) -> None:
    """Table, failures, peers, exponents and goals."""
    console.print(table_of(rows, "large Riccati equation, paper scene; seconds are medians").terminal())
    for row in [*rows, *flat(rows)]:
        if "error" in row:
            label = f"nx = {row['nx']}, {row.get('ranks', '?')} rank(s) {row.get('method', '')}"
            console.print(f"{label} failed: {row['error']}", markup=False)
    for peer in peers:
        console.print(peer_line(peer), markup=False)
    for label, power in exponents(rows).items():
        if power is not None:
            console.print(f"growth exponent of the time in 2n from nx = 20 on, {label}: {power:.2f}")
    driver.show_goals(console, goals(rows))


def markdown(rows: Sequence[Row], peers: Sequence[Row]) -> str:
    """The table as the README shows it, and a line a peer."""
    return table_of(rows).markdown() + "".join(f"\n- {peer_line(peer)}" for peer in peers) + "\n"


def draw(path: Path, rows: Sequence[Row], peers: Sequence[Row]) -> tuple[Path, ...]:
    """Time against states for every method on the fewest ranks, peers as single marks, log-log."""
    from softgrasp.study.pictures.style import BLUE, GREEN, HAND, ORANGE, PURPLE

    good = driver.measured(flat(rows))
    fewest = min((entry["ranks"] for entry in good), default=1)
    curves: list[driver.Curve] = []
    for name, colour in (("newton_adi", BLUE), ("radi", GREEN), ("galerkin", ORANGE)):
        own = [(e["states"], e["seconds"]) for e in good if e["method"] == name and e["ranks"] == fewest]
        curves.append((name, own, {"color": colour}))
    for name, mark, colour in (("scipy", "s", HAND), ("slycot", "^", HAND), ("pymor", "x", PURPLE)):
        ran = [p for p in peers if p["peer"] == name and "residual" in p]
        label = f"{name} (residual to {max((p['residual'] for p in ran), default=0.0):.0e})"
        look = {"color": colour, "ls": "", "marker": mark, "ms": 5}
        curves.append((label, [(p["states"], p["seconds"]) for p in ran], look))
    return driver.loglog(path, curves, "states 2n", "time [s]", f"{fewest} rank(s), median")


def collect(
    console: Console, meshes: list[int], ranks: list[int], repeats: int, large: bool, record: Record
) -> list[Row]:
    """Launch all workers one after the other, the largest last."""
    every = ["newton_adi", "radi", "galerkin"]
    jobs = [(nx, k, every, repeats) for nx in meshes for k in ranks]
    if large:
        jobs.append((LARGEST, LARGEST_RANKS, ["newton_adi", "galerkin"], 1))
    known = {(row["nx"], row["ranks"]): row for row in record.rows}
    record.rows = [known[job[:2]] for job in jobs if job[:2] in known]
    for i, (nx, k, methods, count) in enumerate(jobs):
        if (nx, k) in known:
            console.print(f"row {i + 1} of {len(jobs)}, nx = {nx}, {k} rank(s): kept")
            continue
        with console.status(f"row {i + 1} of {len(jobs)}, nx = {nx}, {k} rank(s)"):
            row = launch({"nx": nx, "beta": record.beta, "methods": methods, "repeats": count}, k) | {"nx": nx}
        record.rows.append(row)
        record.save()
        times = [f"{e['method']} {'failed' if 'error' in e else number(e['seconds']) + ' s'}" for e in flat([row])]
        console.print(f"row {i + 1} of {len(jobs)}, nx = {nx}, {k} rank(s): {', '.join(times) or 'failed'}")
    return record.rows


def collect_peers(console: Console, meshes: list[int], record: Record) -> list[Row]:
    """The peers on the meshes they can do, one rank."""
    known = {(row["peer"], row["nx"]): row for row in record.peers}
    record.peers = []
    for peer, limit in PEER_LIMIT.items():
        for nx in meshes:
            if (peer, nx) in known:
                row = known[peer, nx]
            elif nx > limit:
                row = {"skipped": f"it takes many minutes or too much memory beyond nx = {limit}"}
            else:
                with console.status(f"{peer}, nx = {nx}"):
                    row = launch({"nx": nx, "beta": record.beta, "peer": peer}, 1)
            record.peers.append(row | {"nx": nx, "peer": peer})
            record.save()
            if row.get("missing"):
                break
    return record.peers


def main(
    sizes: Annotated[str, typer.Option(help="meshes nx; 10 is the paper's")] = SIZES,
    ranks: Annotated[str, typer.Option(help="MPI rank counts; no more than there are cores")] = "1,2",
    beta: Annotated[float, typer.Option(help="Kelvin-Voigt time [s]")] = 0.002,
    repeats: Annotated[int, typer.Option(help="repeats behind each median, fewer for long runs", min=1)] = 7,
    out: Annotated[Path, typer.Option(help="folder for bench_riccati.json, .csv, .md, .png and .pdf")] = Path("out"),
    peers: Annotated[bool, typer.Option(help="also SciPy, slycot and pyMOR")] = True,
    large: Annotated[bool, typer.Option("--large", help=f"also nx = {LARGEST}, 2n > 1e6")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="keep the good rows of bench_riccati.json in --out")] = False,
) -> None:
    """See HELP."""
    meshes, counts = parse_meshes(sizes), driver.parse_ranks(ranks)
    console = driver.open_console(160)
    record = Record(out / "bench_riccati.json", beta)
    if resume:
        record.resume()
    rows = collect(console, meshes, counts, repeats, large, record)
    others = collect_peers(console, meshes, record) if peers else record.peers
    record.save()
    show(console, rows, others)
    (out / "bench_riccati.md").write_text(markdown(rows, others))
    table = driver.table_of(flat(rows), CSV).write_csv(out / "bench_riccati.csv")
    files = [out / "bench_riccati.json", out / "bench_riccati.md", table]
    files += draw(out / "bench_riccati.png", rows, others)
    driver.list_bench(console, files, any("error" in entry for entry in [*rows, *flat(rows)]))
