"""``softgrasp query`` as the command line takes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from softgrasp.study.shell.ending import console
from softgrasp.study.shell.options import Empty, Pdf, check_folder


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
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="also write a page, a picture and tables into this folder", callback=check_folder
        ),
    ] = None,
    empty: Empty = False,
    pdf: Pdf = False,
) -> None:
    """Ask a certified reduced model for other materials, motions or steps, and how far the answer can be off.

    An answer has three errors: of the reduction (proved), of the time step and of the mesh (both estimates).

    Above the tolerance it is refused, with exit status 3: take --fallback full, or --allow to see it all the same.

    Outside the box of the training there is a warning only: the bound holds everywhere.

    Example: softgrasp reduce paper_forward --tolerance 1e-2, then
    softgrasp query out/paper_forward-reduce/models/certified.h5 --set lambda=77 --set mu=60
    """
    from softgrasp.study.query.run import run_query

    status = run_query(
        model, console(), settings=set_ or [], motion=motion, dt=dt, tolerance=tolerance, allow=allow,
        fallback=fallback, scene=scene, batch=batch, out=csv, folder=out, empty=empty,
    )  # fmt: skip
    raise typer.Exit(status)
