"""Arguments of ``softgrasp export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from softgrasp.study.shell.ending import console


def export(
    model: Annotated[
        Path,
        typer.Argument(help="reduced model of `softgrasp reduce` or sg.save (.h5), or controller of `control` (.npz)"),
    ],
    c: Annotated[
        Path | None, typer.Option("--c", metavar="FOLDER", help="write C99 with its test into this folder")
    ] = None,
    fmu: Annotated[
        Path | None, typer.Option(help="write a file of FMI 3.0 for Simulink, Modelica and others, e.g. plant.fmu")
    ] = None,
    mujoco: Annotated[
        Path | None, typer.Option(help="write a body for MuJoCo of a model with effects.frame, e.g. hand.xml")
    ] = None,
    tick: Annotated[float, typer.Option(help="time step of a model in seconds; a controller has its own")] = 1e-3,
) -> None:
    """Write a reduced model or a controller for other programs: C99 for a robot, an FMU for simulators.

    Of a model, the load on the hand goes in, hand and outputs of the scene come out; mu, lambda and beta may change at
    any tick. Of a controller, the measured hand and the samples of its observer go in, the load comes out.

    The C allocates nothing and calls no library. It brings a log of our own steps, which `make test` compares.

    The FMU (FMI 3.0; of a model co-simulation and model exchange, of a controller co-simulation) contains the same C
    and a binary for this machine.

    Of a model in the frame of the hand, MuJoCo reads hand and rigid tissue; sg.bridges.MujocoTissue deforms it.

    Example: softgrasp reduce paper_forward, then
    softgrasp export out/paper_forward-reduce/models/craig_bampton.h5 --c plant --fmu plant.fmu; make -C plant test time
    """
    from softgrasp.study.export.run import run_export

    run_export(model, console(), c=c, fmu=fmu, mujoco=mujoco, tick=tick)
