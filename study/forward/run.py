"""``softgrasp simulate``: run, show, write."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from rich.console import Console
from rich.progress import MofNCompleteColumn
from rich.table import Table

from softgrasp.fem.effects import EFFECTS
from softgrasp.fem.errors import Interrupted, ResourceError
from softgrasp.fem.mesh.check import counted
from softgrasp.fem.model.outputs import unit
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.scene.file import resolved_toml
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.forward import accuracy
from softgrasp.study.forward.cautions import run_warnings
from softgrasp.study.forward.result import force_unit, simulate_result, write_results
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.report.equation import equation
from softgrasp.study.report.origin import command_line, made_with
from softgrasp.study.report.page import Section, equation_text, write_report
from softgrasp.study.shell.session import list_files, open_model, open_scene, progress_bar, show_warnings

Rows = list[tuple[str, str]]


def run_simulate(
    path: Path,
    out: Path,
    overrides: list[str],
    console: Console,
    *,
    quiet: bool = False,
    resume: bool = False,
    until: int | None = None,
    pictures: bool = True,
    certify: bool = False,
) -> dict[str, Any]:
    """Simulate a scene file and write its results. Collective.

    Raises:
        SoftgraspError: with one sentence.
    """
    comm = MPI.COMM_WORLD
    scene = open_scene(path, overrides, console)
    model = open_model(scene, console)
    frames = Frames(model, out, pictures)

    def join(run: Run) -> None:
        frames.begin(run)
        if resume:
            lost = frames.lacking(run.begun)
            missing = (
                f"; {counted(lost, 'earlier frame')} {'is' if lost == 1 else 'are'} not kept, the pictures do without"
            )
            more = missing if lost else ""
            more += "; the fields before are left out: another run has written in their place" if frames.foreign else ""
            console.print(f"resumed from step {run.begun} of {run.steps}{more}", soft_wrap=True)

    with progress_bar(console, MofNCompleteColumn(), quiet=quiet) as bar:
        task = bar.add_task("steps", total=scene.time.steps)

        def progress(run: Run) -> None:
            bar.update(task, completed=run.reached)

        options = RunOptions(out, resume, until, progress, frames, join, frames.keep)
        try:
            run = simulate(model, options)
        except (Interrupted, ResourceError):
            if files := frames.close():
                list_files(console, files)
            raise
    files = frames.close()
    result = simulate_result(model, run)
    judged, unknown = accuracy.judge(model, run.seconds["steps"], certify)
    result |= accuracy.keys(judged, run)
    warnings = run_warnings(model, run, frames.most[1:])
    result["warnings"] = [*model.space.mesh.notes, *warnings, *accuracy.warnings(judged), *unknown]
    if comm.rank == 0:
        begin = time.perf_counter()
        files = write_results(out, model, run, result) + files + frames.draw(out, run)
        if pictures and judged is not None:
            files += accuracy.draw(out / "mesh_error.png", run, judged)
        rows = [*result_rows(result), *accuracy.rows(judged)]
        files.append(_report(out, scene, result, rows, path, overrides))
        result["time"]["pictures"] = time.perf_counter() - begin
        show(console, rows)
        show_warnings(console, warnings)
        list_files(console, files)
    comm.Barrier()
    return result


def result_rows(result: dict[str, Any]) -> Rows:
    """The short table of a run as label and text."""
    seconds = result["time"]
    rows = [("hand at the end", "(" + ", ".join(f"{v:.6g}" for v in result["hand_final"]) + ")")]
    rows += [
        (name, f"{value:.6g} {unit(name)}")
        for name, value in zip(result["output_names"], result["output_final"], strict=True)
    ]
    rows += [(name, place) for name, place in result["output_places"].items()]
    if "force_peak" in result:
        peak = ", ".join(f"{axis} {value:.4g} {force_unit(axis)}" for axis, value in result["force_peak"].items())
        rows.append(("largest force on the hand", peak))
    timed = seconds["steps_timed"]
    steps = f"{timed}" if timed == result["steps"] else f"{timed} of {result['steps']}, since the run was resumed,"
    return [
        *rows,
        ("energy drift", f"{result['energy_drift']:.1e}"),
        ("residual, first and last", f"{result['residual_first']:.1e}, {result['residual_last']:.1e}"),
        ("solver", result["solver"]["name"]),
        ("", result["solver"]["reason"]),
        ("mesh, assembly, factor", f"{seconds['mesh']:.3g} s, {seconds['assembly']:.3g} s, {seconds['factor']:.3g} s"),
        ("steps", f"{steps} in {seconds['steps']:.3g} s, {1e6 * seconds['per_step']:.4g} us each"),
        ("peak memory, all ranks", f"{result['memory_peak_mb']:.0f} MiB"),
    ]


def show(console: Console, rows: Rows) -> None:
    """Print the short table."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def _report(out: Path, scene: Scene, result: dict[str, Any], rows: Rows, path: Path, overrides: list[str]) -> Path:
    from softgrasp.study.pictures.animation import speed_up  # brings Matplotlib, which only rank 0 needs

    faster = speed_up(np.array([0.0, scene.time_end]))
    captions = {
        "move.png": "The body at some instants of the move.",
        "move.gif": "The move in real time." if faster == 1 else f"The move at {faster:g} times its speed.",
        "mesh_error.png": "Outputs relative to the hand on this mesh and corrected, with the band of the error bound.",
        "traces.png": "Hand and outputs against time; below, the outputs relative to the hand.",
    }
    figures = [(out / name, text) for name, text in captions.items() if (out / name).exists()]
    sizes = [
        ("hand n_s", result["n_s"]),
        ("tissue n_e", result["n_e"]),
        ("states 2n", result["states"]),
        ("cells", result["cells"]),
        ("steps", result["steps"]),
        ("time step", f"{result['dt']:.6g} s"),
        ("end", f"{scene.time_end:.6g} s"),
    ]
    effects = [
        (name, effect.active(scene), *((effect.term, effect.cost) if effect.active(scene) else ("", "")))
        for name, effect in EFFECTS.items()
    ]
    return write_report(
        out / "report.html",
        title=scene.name,
        subtitle=scene.description,
        sections=[
            Section("", figures=figures),
            Section("Result", rows=rows),
            *([Section("Look at", text="\n\n".join(result["warnings"]))] if result["warnings"] else []),
            Section("Equation", code=equation_text(equation(scene))),
            Section("Effects", header=("effect", "on", "adds", "cost"), rows=effects),
            Section("Size", rows=sizes),
            Section("Made with", rows=made_with(result)),
        ],
        scene=resolved_toml(scene),
        reproduce=command_line("simulate", path, overrides, result["ranks"]),
    )
