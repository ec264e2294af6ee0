"""``softgrasp simulate``: run, show, write."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from fem.build import build
from fem.results import simulate_result, write_results
from fem.run import Run, RunOptions, simulate
from fem.scene_file import load_scene_collective


def run_simulate(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    quiet: bool = False,
    resume: bool = False,
    until: int | None = None,
) -> dict[str, Any]:
    """Simulate a scene file and write its results. Collective.

    Raises:
        SoftgraspError: with one sentence.
    """
    comm = MPI.COMM_WORLD
    scene = load_scene_collective(comm, path, overrides)
    console.print(f"[bold]{scene.name}[/bold]  {scene.description}")
    model = build(scene, comm)
    layout = model.system.layout
    console.print(f"n_s = {layout.n_s}, n_e = {layout.n_e}, 2n = {layout.states}, {comm.size} rank(s)")
    columns = (
        TextColumn("steps"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True) as bar:
        task = bar.add_task("steps", total=scene.time.steps)

        def progress(run: Run) -> None:
            bar.update(task, completed=run.reached)

        run = simulate(model, RunOptions(directory=out, resume=resume, until=until, progress=progress))
    result = simulate_result(model, run)
    if comm.rank == 0:
        files = write_results(out, model, run, result)
        show(console, result)
        for file in files:
            console.print(f"  {file}", soft_wrap=True)
    comm.Barrier()
    return result


def show(console: Console, result: dict[str, Any]) -> None:
    """The short table of a run."""
    table = Table(box=None, show_header=False, pad_edge=False)
    seconds = result["time"]
    table.add_row("hand at the end", _numbers(result["hand_final"]))
    for name, value in zip(result["output_names"], result["output_final"], strict=True):
        table.add_row(name, f"{value:.6g}")
    table.add_row("energy drift", f"{result['energy_drift']:.1e}")
    table.add_row("residual, first and last", f"{result['residual_first']:.1e}, {result['residual_last']:.1e}")
    table.add_row("solver", f"{result['solver']['name']} ({result['solver']['reason']})")
    table.add_row("assembly", f"{seconds['assembly']:.3g} s")
    table.add_row("factor", f"{seconds['factor']:.3g} s")
    table.add_row("steps", f"{result['steps']} in {seconds['steps']:.3g} s, {1e6 * seconds['per_step']:.3g} us each")
    table.add_row("memory, all ranks", f"{result['memory_peak_mb']:.0f} MiB")
    console.print(table)


def _numbers(values: list[float]) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in values) + ")"
