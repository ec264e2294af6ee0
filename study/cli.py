"""The ``softgrasp`` command."""

from __future__ import annotations

import json
import signal
import sys
import traceback
from pathlib import Path
from typing import Annotated

import typer
from mpi4py import MPI
from rich.console import Console
from rich.text import Text

from fem import _stack as _stack  # threads and MPI before anything numerical
from fem.errors import SoftgraspError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Simulate a rigid robot hand that holds soft tissue. Start with: softgrasp simulate SCENE --out out",
)
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", help="override a scene key, e.g. --set tissue.cells=[40,80]; may be repeated"),
]
SceneFile = Annotated[Path, typer.Argument(help="scene file (TOML); `softgrasp scenes` lists those that ship")]


def console() -> Console:
    """A console that writes on rank 0 only."""
    return Console(quiet=MPI.COMM_WORLD.rank != 0, highlight=False)


@app.command()
def doctor() -> None:
    """Check Python, DOLFINx, MPI, threads, compiler and caches; one line each."""
    from study.doctor import show

    raise typer.Exit(0 if show(console()) else 1)


@app.command()
def scenes() -> None:
    """List the scenes that ship, with what they show."""
    from rich.table import Table

    from fem.scene_file import load_scene, shipped_scenes

    table = Table("scene", "what it shows", "file", box=None, pad_edge=False)
    for name, path in shipped_scenes().items():
        table.add_row(name, load_scene(path).description, str(path))
    console().print(table)


@app.command()
def schema() -> None:
    """Print the JSON schema of a scene: every key with its unit and meaning."""
    from fem.scene import scene_schema

    if MPI.COMM_WORLD.rank == 0:
        typer.echo(json.dumps(scene_schema(), indent=2))


@app.command()
def explain(scene: SceneFile, set_: Overrides = None) -> None:
    """Say what a scene simulates: its equation, sizes, solver, and which effects matter."""
    from fem.scene_file import load_scene_collective
    from study.explain import run_explain

    run_explain(load_scene_collective(MPI.COMM_WORLD, scene, set_ or []), MPI.COMM_WORLD, console())


@app.command()
def simulate(
    scene: SceneFile,
    out: Annotated[Path, typer.Option(help="folder for result.json, trajectories, pictures and fields")] = Path("out"),
    set_: Overrides = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="go on from the checkpoint in the output folder")] = False,
    no_pictures: Annotated[bool, typer.Option("--no-pictures", help="numbers and fields only")] = False,
    until: Annotated[int | None, typer.Option(help="stop after this step and leave a checkpoint", min=1)] = None,
) -> None:
    """Run a scene with the full-order model; also under `mpiexec -n N`."""
    from study.simulate import run_simulate

    run_simulate(
        scene,
        out,
        set_ or [],
        console(),
        quiet=quiet,
        resume=resume,
        until=until,
        pictures=not no_pictures,
    )


def main() -> None:
    """Entry point: one sentence and status 1 for a user's error; a bug on one rank ends all ranks."""
    comm = MPI.COMM_WORLD
    try:
        app()
    except SoftgraspError as error:
        if comm.rank == 0:
            Console(stderr=True, highlight=False).print(Text(f"error: {error}"), soft_wrap=True)
        sys.exit(1)
    except (SystemExit, KeyboardInterrupt):
        raise
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        if comm.size > 1:
            comm.Abort(1)
        sys.exit(2)


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    main()
