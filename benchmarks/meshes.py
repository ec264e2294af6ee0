"""Reduced online time stays flat while the full model grows: ``python -m benchmarks meshes``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI
from rich.console import Console

from benchmarks.driver import Curve, loglog, parse_list
from softgrasp import __version__
from softgrasp.fem import _stack as _stack  # threads and MPI before anything numerical
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.bases.registry import METHODS, find_method
from softgrasp.reduction.replay import full_run
from softgrasp.study.reduce.linear.measure import sweep
from softgrasp.study.reduce.times import steps_seconds
from softgrasp.study.report.document import Table
from softgrasp.study.report.files import write_json
from softgrasp.study.report.origin import machine
from softgrasp.study.shell.ending import console
from softgrasp.study.shell.session import list_files
from softgrasp.study.shell.timing import power_law

SIZES = "1e3,1e4,1e5,1e6"
KEPT = 60  # snapshots of a run, the same on every mesh: those of all steps would not fit in memory at n_e = 1e6
HELP = f"""Mesh study of the paper's block: tissue unknowns from 1e3 to 1e6, one method and one N.

Prints for every mesh the full run, the offline time (basis and projection, from {KEPT} snapshots) and the online time
of the reduced model, then the exponents with which they grow and the mesh from which a reduced run is faster than a
full one. LONG: the full run at n_e = 1e6 needs many minutes and several GB; a fast look: --sizes 1e3,3e3,1e4. Keep the
machine quiet."""


@dataclass(frozen=True)
class MeshRow:
    """One mesh; times in seconds."""

    cells: int  # cells of the short side
    n_e: int  # tissue unknowns
    time_factor: float  # factorisation of the full run
    time_full: float  # all steps of the full run
    time_offline: float  # basis and projection
    time_setup: float  # new parameter of the reduced model
    time_online: float  # run of the reduced model
    N: int  # its dimension
    error: float  # |X - X_r|_F / |X|_F of X = [q_s, v_s, q_e, v_e]
    error_deformation: float  # |X - X_r|_F / |X|_F of X = [z, v_z]
    stable: bool  # whether the reduced model is stable


def block(n_e: int, steps: int, method: str, N: int) -> Scene:
    """The paper's block with about n_e tissue unknowns, 4 nx^2 on nx x 2 nx cells."""
    nx = max(4, round(math.sqrt(n_e / 4)))
    keys = [f"tissue.cells=[{nx}, {2 * nx}]", f"time.steps={steps}", f"output.every={max(1, steps // KEPT)}"]
    return load_scene("paper_forward", [*keys, f"reduction={{methods=['{method}'], N=[{N}]}}"])


def measure_mesh(scene: Scene, comm: MPI.Intracomm) -> MeshRow:
    """One mesh. Collective. Raises SoftgraspError: a solve failed, the snapshots do not fit, or no model has this N."""
    model = build(scene, comm=comm)
    run = simulate(model)
    result = sweep(scene.reduction.methods[0], full_run(model, run), scene.reduction)
    if not result.points:
        refused = [f"N = {N}: {reason}" for N, reason in result.refused.items()]
        reason = next(iter(refused), f"reduction.N = {scene.reduction.N} fits no basis of this method")
        raise SoftgraspError(f"{scene.reduction.methods[0]}: {reason}")
    cells = scene.tissue.cells[0] if scene.tissue.cells else 0
    times = run.seconds["factor"], steps_seconds(run)
    names = ("time_offline", "time_setup", "time_online", "N", "error", "error_deformation", "stable")
    return MeshRow(cells, model.system.layout.n_e, *times, **{name: getattr(result.points[0], name) for name in names})


def break_even(rows: Sequence[MeshRow]) -> float | None:
    """n_e from which a reduced run is faster than a full one, by the straight line through log times."""
    if len(rows) < 2:
        return None
    n_e = np.log([row.n_e for row in rows])
    ratio = np.log([row.time_full / row.time_online for row in rows])
    slope, constant = np.polyfit(n_e, ratio, 1)
    return float(np.exp(-constant / slope)) if slope > 0 else None


def findings(rows: Sequence[MeshRow]) -> dict[str, Any]:
    """Exponents, spread of the online time, break-even mesh; None where there is one mesh only."""
    n_e, online = [row.n_e for row in rows], [row.time_online for row in rows]
    return {
        "exponent_full": power_law(n_e, [row.time_full for row in rows]),
        "exponent_offline": power_law(n_e, [row.time_offline for row in rows]),
        "exponent_online": power_law(n_e, online),
        "online_spread": max(online) / min(online),
        "break_even_n_e": break_even(rows),
    }


def show(console: Console, rows: Sequence[MeshRow], trends: dict[str, Any], title: str) -> None:
    """Print table and exponents."""
    header = ("n_e", "factor", "full", "offline", "run", "new", "x again", "x new", "error", "deform.")
    console.print(
        f"{title}; seconds, run and new in milliseconds; again: full steps over a run of the same small model, "
        "new: factorisation and steps over set-up and run at a new parameter"
    )
    cells = [
        (
            row.n_e, row.time_factor, row.time_full, row.time_offline, 1e3 * row.time_online,
            1e3 * (row.time_setup + row.time_online), f"{row.time_full / row.time_online:.0f}",
            f"{(row.time_factor + row.time_full) / (row.time_setup + row.time_online):.0f}", f"{row.error:.1e}",
            f"{row.error_deformation:.1e}" + ("" if row.stable else " !"),
        )
        for row in rows
    ]  # fmt: skip
    console.print(Table(header, cells).terminal())
    if trends["exponent_offline"] is None:
        return
    console.print(
        f"growth with n_e: full run n_e^{trends['exponent_full']:.2f}, offline n_e^{trends['exponent_offline']:.2f}, "
        f"online n_e^{trends['exponent_online']:.2f} (largest over least online time {trends['online_spread']:.2f})"
    )
    if trends["break_even_n_e"] is not None:
        console.print(
            f"break-even mesh: a reduced run is faster than a full one from n_e = {trends['break_even_n_e']:.0f}"
        )


def draw(path: Path, rows: Sequence[MeshRow], trends: dict[str, Any]) -> tuple[Path, ...]:
    """Times against n_e; PNG and PDF."""
    from softgrasp.study.pictures.style import BLUE, GREEN, ORANGE

    curves: list[Curve] = []
    for key, text, colour, marker in (
        ("full", "full run", ORANGE, "o"), ("offline", "offline", BLUE, "s"), ("online", "online run", GREEN, "^"),
    ):  # fmt: skip
        slope = trends[f"exponent_{key}"]
        power = "" if slope is None else rf", $n_e^{{{slope:.2f}}}$"
        points = [(row.n_e, getattr(row, f"time_{key}")) for row in rows]
        curves.append((text + power, points, {"color": colour, "marker": marker}))
    return loglog(path, curves, "tissue unknowns $n_e$", "time [s]")


def run_mesh_study(
    sizes: Sequence[int], steps: int, method: str, N: int, out: Path, console: Console, comm: MPI.Intracomm
) -> dict[str, Any]:
    """Measure all meshes and write mesh_study.json, mesh_study.png and .pdf. Collective."""
    find_method(method)
    rows = []
    for size in sizes:
        scene = block(size, steps, method, N)
        console.print(f"n_e about {size}: {scene.tissue.cells} cells, {steps} steps", markup=False)
        rows.append(measure_mesh(scene, comm))
    trends = findings(rows)
    title = METHODS[method].title
    show(console, rows, trends, f"{title}, N = {N}, {comm.size} rank(s); !: unstable")
    result = {"command": "mesh_study", "method": method, "N": N, "steps": steps, "version": __version__}
    result |= {"ranks": comm.size, "machine": machine(), "rows": [asdict(row) for row in rows], **trends}
    if comm.rank == 0:
        out.mkdir(parents=True, exist_ok=True)
        numbers = write_json(out / "mesh_study.json", result)
        list_files(console, [numbers, *draw(out / "mesh_study.png", rows, trends)])
    comm.Barrier()
    return result


def parse_sizes(text: str) -> list[int]:
    """Tissue unknowns from "1e3,1e4". Raises typer.BadParameter: a part is no number from 50 on."""
    advice = "number of unknowns; give numbers from 50 on, such as 1e3,1e4"
    sizes = [round(float(part)) for part in parse_list(text, r"([0-9.]+(?:e[0-9]+)?)", advice)]
    for size in sizes:
        if not 50 <= size < 1e9:
            raise typer.BadParameter(f"'{size}' is no {advice}")
    return sizes


def main(
    sizes: Annotated[str, typer.Option(help="tissue unknowns")] = SIZES,
    steps: Annotated[int, typer.Option(help="time steps of a run", min=2)] = 600,
    method: Annotated[str, typer.Option(help="basis by key")] = "psd_fixed_relative",
    dimension: Annotated[int, typer.Option("--N", help="dimension of the reduced model", min=2)] = 14,
    out: Annotated[Path, typer.Option(help="folder for mesh_study.json, .png and .pdf")] = Path("out"),
) -> None:
    """See HELP."""
    run_mesh_study(parse_sizes(sizes), steps, method, dimension, out, console(), MPI.COMM_WORLD)
