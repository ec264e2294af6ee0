"""The ``softgrasp`` command."""

# ruff: noqa: E402  (the other imports take a second, in which Ctrl-C shall not end in a traceback)
from __future__ import annotations

from softgrasp.study.shell.loading import lasting_imports, loading, quiet_imports

quiet_imports()

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from softgrasp.fem.errors import SceneError
from softgrasp.study.export.command import export
from softgrasp.study.identify.command import identify
from softgrasp.study.serve.command import serve
from softgrasp.study.shell.ending import console, rank, run_command
from softgrasp.study.shell.folder import default_folder
from softgrasp.study.shell.options import OneReport, parse_tolerance, takes

RUN, MODEL, LOOK = "Run a scene", "Reduce, control and study", "Scenes, results and installation"  # groups of --help
EPILOG = """[bold]Examples[/bold]

softgrasp new my.toml, then softgrasp simulate my.toml

mpiexec -n 4 softgrasp simulate my.toml --set time.steps=400

softgrasp sweep my.toml tissue.material.mu=100:500:9

softgrasp reduce paper_forward --tolerance 1e-2

[bold]Exit status[/bold]

0: done, also where --until stopped a run.

1: refused or failed, with one sentence.

2: a wrong option, or a fault of the program.

3: an answer is refused, of query above its tolerance, of identify with its reason."""
app = typer.Typer(
    cls=OneReport,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    help="Simulate a rigid robot hand that holds soft tissue. Start with: softgrasp simulate SCENE",
    epilog=EPILOG,
    rich_markup_mode="rich",
)


def _show_version(show: bool) -> None:
    if show:
        from softgrasp import __version__

        typer.echo(f"softgrasp {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="print the version and leave")
    ] = False,
) -> None:
    """Options of the program itself."""


@app.command(rich_help_panel=LOOK)
def doctor() -> None:
    """Check Python, DOLFINx, MPI, threads, compiler and caches; one line each."""
    from softgrasp.study.shell.doctor import show

    raise typer.Exit(0 if show(console()) else 1)


@app.command(rich_help_panel=LOOK)
def scenes() -> None:
    """List the scenes that ship, with their descriptions."""
    from rich.table import Table

    from softgrasp.fem.scene.file import load_scene, shipped_scenes

    shipped = shipped_scenes()
    if not shipped:
        raise SceneError("no scenes here: they ship with the checkout, in demos/scenes")
    table = Table("scene", "description", box=None, pad_edge=False)
    for name, path in shipped.items():
        table.add_row(name, load_scene(path).description)
    console().print(table)
    folder = next(iter(shipped.values())).parent
    here = folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder
    console().print(f"in {here}/, each as NAME.toml", soft_wrap=True)


@app.command(rich_help_panel=LOOK)
def materials() -> None:
    """List the materials that a scene can name, with the sources of their numbers."""
    from softgrasp.study.runs.start import materials_table

    console().print(materials_table().terminal(wrap=[4], width=console().width))


@app.command(rich_help_panel=LOOK)
def new(
    file: Annotated[Path, typer.Argument(help="scene file to write, e.g. my.toml")],
    solid: Annotated[bool, typer.Option("--3d", help="a block in 3D instead of a strip in 2D")] = False,
    mesh: Annotated[Path | None, typer.Option(help="mesh file of the body, in any format of meshio")] = None,
) -> None:
    """Write a scene to begin with, and the schema of its keys for editors."""
    from softgrasp.study.runs.start import new_scene
    from softgrasp.study.shell.session import list_files

    if rank() == 0:
        list_files(console(), new_scene(file, solid=solid, mesh=mesh))
        console().print(f"next: softgrasp explain {file}; softgrasp simulate {file}", soft_wrap=True)


@app.command("list", rich_help_panel=LOOK)
def list_runs(folder: Annotated[Path, typer.Argument(help="folder that the runs lie below")] = Path("out")) -> None:
    """List the runs below a folder, the newest last."""
    from softgrasp.study.runs.listing import show_runs

    if rank() == 0:
        show_runs(folder, console())


@app.command(rich_help_panel=LOOK)
@takes("a b out pictures empty pdf")
def compare(
    a: Annotated[Path, typer.Argument(help="folder of a run")],
    b: Annotated[Path, typer.Argument(help="folder of another run")],
    out: Path | None,
    **shared: bool,
) -> None:
    """Show in which keys, numbers and trajectories two runs differ."""
    from softgrasp.study.runs.listing import run_compare

    run_compare(a, b, out or default_folder("compare", Path(f"{a.name}-{b.name}")), console(), **shared)


@app.command(rich_help_panel=LOOK)
def schema() -> None:
    """Print the JSON schema of a scene: every key with its unit and meaning."""
    from softgrasp.fem.scene.scene import scene_schema

    if rank() == 0:
        typer.echo(json.dumps(scene_schema(), indent=2))


@app.command(rich_help_panel=RUN)
@takes("scene out set_ empty", out="also write result.json and report.html into this folder")
def explain(scene: Path, out: Path | None, set_: list[str] | None, empty: bool) -> None:
    """Say what a scene simulates: its equation, sizes, solver, and which effects matter."""
    with loading():
        from softgrasp.study.forward.explain_page import run_explain

    run_explain(scene, out, set_ or [], console(), empty=empty)


def _run(command: Callable[..., Any], *, scene: Path, out: Path | None, set_: list[str] | None, **options: Any) -> Any:
    """Run a command on a scene in the folder given or its own; named ``run_NAME``, it is the command NAME."""
    name = command.__name__.removeprefix("run_")
    return command(scene, out or default_folder(name, scene), set_ or [], console(), **options)


@app.command(rich_help_panel=RUN)
@takes("scene out set_ quiet resume pictures until certify empty pdf")
def simulate(
    resume: Annotated[bool, typer.Option("--resume", help="go on from the checkpoint in the output folder")] = False,
    until: Annotated[int | None, typer.Option(help="stop after this step and leave a checkpoint", min=1)] = None,
    certify: Annotated[
        bool, typer.Option("--certify", help="estimate the error of mesh and time step, whatever it costs")
    ] = False,
    **shared: Any,
) -> None:
    """Run a scene with the full model; also under `mpiexec -n N`."""
    with loading():
        from softgrasp.study.forward.run import run_simulate

    _run(run_simulate, resume=resume, until=until, certify=certify, **shared)


@app.command(rich_help_panel=RUN)
@takes("scene axes out set_ reduced ranks_each quiet pictures empty pdf")
def sweep(
    axes: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY=FIRST:LAST:COUNT...",
            help="values of a key: 100:500:9, 1e2:1e4:5:log or 20,50,500; one or two keys",
        ),
    ],
    reduced: Annotated[
        int | None, typer.Option(help="run a reduced model with this many columns instead of the full one", min=1)
    ] = None,
    ranks_each: Annotated[int, typer.Option(help="ranks of one point under `mpiexec -n N`", min=1)] = 1,
    **shared: Any,
) -> None:
    """Simulate a scene at many values of its keys; resumes; `mpiexec -n N` runs N points at a time."""
    with loading():
        from softgrasp.study.runs.run import run_sweep

    _run(run_sweep, axes=axes, reduced=reduced, each=ranks_each, **shared)


@app.command(rich_help_panel=LOOK)
def view(
    folder: Annotated[Path, typer.Argument(help="output folder of simulate or control")],
    field: Annotated[str, typer.Option(help="colour: von_mises, displacement, velocity, stress, strain, layer")] = (
        "von_mises"
    ),
    save: Annotated[
        Path | None, typer.Option(help="write a PNG, or a page (.html) to turn it in; no window then")
    ] = None,
) -> None:
    """Show the move of a run: a window with a time slider, a picture, or a page that turns it."""
    from softgrasp.study.pictures.view import view as show
    from softgrasp.study.shell.session import list_files

    show(folder, field, save)
    if save is not None:
        list_files(console(), [save])


@app.command(rich_help_panel=MODEL)
@takes("scene out set_ quiet pictures empty pdf tolerance")
def reduce(
    tolerance: Annotated[
        str | None,
        typer.Option(help="build one model that proves its error over the scene's box, to this relative error: 1e-2"),
    ] = None,
    **shared: Any,
) -> None:
    """Build the reduced models of a scene and compare error and time; also under `mpiexec -n N`."""
    with loading():
        from softgrasp.study.reduce.run import run_reduce

    _run(run_reduce, tolerance=None if tolerance is None else parse_tolerance(tolerance), **shared)


@app.command(rich_help_panel=MODEL)
@takes(
    "model set_ motion dt tolerance allow fallback scene batch csv out empty pdf",
    out="also write a page, a picture and tables into this folder",
)
def query(
    model: Annotated[Path, typer.Argument(help="certified model that `softgrasp reduce SCENE --tolerance` wrote")],
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", "-s", help="material of the first layer: lambda=77, mu=60 [Pa], rho=1; may be repeated"),
    ] = None,
    motion: Annotated[
        Path | None,
        typer.Option(help="CSV file of the hand: time, then a position (or force) a column; else as in the scene"),
    ] = None,
    dt: Annotated[float | None, typer.Option("--dt", help="time step in seconds; else as in the scene")] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="largest relative error of an answer; else as the model was built for")
    ] = None,
    allow: Annotated[bool, typer.Option("--allow", help="answer above the tolerance too, with a warning")] = False,
    fallback: Annotated[
        str | None, typer.Option(help="full: run the full model where the answer is refused, and say so")
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(help="scene of the full model; else the scene.toml beside the model")
    ] = None,
    batch: Annotated[
        Path | None, typer.Option(help="CSV table of parameters; its first line names lambda, mu, rho or some")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="write the trajectory with its bounds, or the answers of a batch, to this file")
    ] = None,
    out: Path | None = None,
    empty: bool = False,
) -> None:
    """Ask a certified reduced model for other materials, motions or steps; an answer comes with its errors.

    An answer has three errors: of the reduction (proved), of the time step and of the mesh (both estimates).

    Above the tolerance it is refused, with exit status 3: use --fallback full, or --allow to see it all the same.

    Outside the box of the training there is a warning only: the bound holds everywhere.

    Example: softgrasp reduce paper_forward --tolerance 1e-2, then
    softgrasp query out/paper_forward-reduce/models/certified.h5 --set lambda=77 --set mu=60
    """
    with loading():
        from softgrasp.study.query.run import run_query

    status = run_query(
        model, console(), settings=set_ or [], motion=motion, dt=dt, tolerance=tolerance, allow=allow,
        fallback=fallback, scene=scene, batch=batch, out=csv, folder=out, empty=empty,
    )  # fmt: skip
    raise typer.Exit(status)


app.command(rich_help_panel=MODEL)(identify)
app.command(rich_help_panel=MODEL)(export)
app.command(rich_help_panel=MODEL)(serve)


@app.command(rich_help_panel=MODEL)
@takes("scene out set_ quiet pictures gain_only retune empty pdf")
def control(
    gain_only: Annotated[
        bool, typer.Option("--gain-only", help="only the Riccati equation and the controllers: no loop, no pictures")
    ] = False,
    retune: Annotated[
        bool,
        typer.Option(
            "--retune",
            help="also re-tune gains at nine materials over reduction.lambda_range and mu_range, each against a full "
            "Riccati equation of its own: many times the work",
        ),
    ] = False,
    **shared: Any,
) -> None:
    """Design the optimal feedback of a scene, reduce it and close the loop; also under `mpiexec -n N`."""
    with loading():
        from softgrasp.study.control.run import run_control

    _run(run_control, gain_only=gain_only, retune=retune, **shared)


@app.command(rich_help_panel=MODEL)
@takes("scene out set_ tolerance budget question quiet empty pdf")
def study(
    tolerance: Annotated[
        str | None,
        typer.Option(help="find the cheapest setting with at most this error of the deformation, e.g. 1e-2"),
    ] = None,
    budget: Annotated[
        str | None, typer.Option(help="find the most accurate setting within this time per step, e.g. 1ms")
    ] = None,
    question: Annotated[
        list[str] | None,
        typer.Option(
            help="only this question: forward, reduced, bases, riccati or reduced_riccati; several with commas"
        ),
    ] = None,
    **shared: Any,
) -> None:
    """Show what accuracy costs in time; resumes what an earlier run of the same scene left in the output folder."""
    from softgrasp.study.precision.answer import parse_budget

    with loading():
        from softgrasp.study.precision.run import run_study

    limit = None if budget is None else parse_budget(budget)
    accuracy = None if tolerance is None else parse_tolerance(tolerance)
    _run(run_study, tolerance=accuracy, budget=limit, questions=question, **shared)


@app.command(rich_help_panel=MODEL)
@takes("scene out set_ quiet empty pdf")
def effects(**shared: Any) -> None:
    """Switch every effect on and off: what it costs, what it changes, and whether the scene needs it."""
    with loading():
        from softgrasp.study.effects.run import run_effects

    _run(run_effects, **shared)


def main() -> None:
    """Entry point. Collective, but for the commands that load no MPI: doctor, scenes, schema, --help, --version."""
    lasting_imports()
    run_command(app)


if __name__ == "__main__":
    main()
