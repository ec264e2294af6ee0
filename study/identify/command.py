"""The arguments of ``softgrasp identify``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from softgrasp.fem.errors import SceneError
from softgrasp.study.shell.ending import console
from softgrasp.study.shell.folder import default_folder
from softgrasp.study.shell.loading import loading
from softgrasp.study.shell.options import takes


@takes(
    "scene data fit noise offset shift robust refine law certified columns posterior suggest_markers motions rate out "
    "set_ quiet pictures empty pdf"
)
def identify(
    fit: Annotated[str, typer.Option(help="parameters: mu, lambda, rho, beta; of a layer as skin.mu; with commas")],
    noise: Annotated[
        str, typer.Option(help="standard deviation of the measured numbers, in m: 1e-3, or tip=1e-3,mid_x=2e-3")
    ],
    offset: Annotated[bool, typer.Option("--offset", help="fit a constant error of each output too")] = False,
    shift: Annotated[bool, typer.Option("--shift", help="fit a time shift between hand and outputs too")] = False,
    robust: Annotated[bool, typer.Option("--robust", help="a loss in which outliers count little")] = False,
    refine: Annotated[
        bool, typer.Option("--refine", help="refine the mesh and the time step where they exceed the noise")
    ] = False,
    columns: Annotated[int, typer.Option(help="dimension of the reduced models; full runs correct them", min=6)] = 36,
    law: Annotated[
        str,
        typer.Option(
            help="linear, neo-hooke, neo-hooke-quadratic or stvk; auto: the scene's, and neo-hooke where linear "
            "elasticity is beyond its range"
        ),
    ] = "auto",
    certified: Annotated[
        Path | None, typer.Option(help="certified model of the scene, whose bound is the part of the reduction")
    ] = None,
    posterior: Annotated[
        int, typer.Option(help="samples of the posterior by emcee, a check of the errors by the noise; 0: none", min=0)
    ] = 0,
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            help="CSV files, an experiment each: columns time, outputs as tip_x, perhaps the hand as q_x; s and m"
        ),
    ] = None,
    suggest_markers: Annotated[
        int | None, typer.Option(help="no fit: choose so many markers that would determine the values best", min=1)
    ] = None,
    motions: Annotated[
        list[str] | None, typer.Option(help="with --suggest-markers: motions to choose from, as in duration=0.5;1;2")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="with --suggest-markers: samples a second; one a time step if not given")
    ] = None,
    *,
    scene: Path,
    out: Path | None,
    set_: list[str] | None,
    **shared: Any,
) -> None:
    """Fit the material of a scene to measurements, with the error of each value by its causes.

    The scene gives the motion of the hand, the outputs and the values to start from; empty cells are missing samples.

    The error has parts by noise, mesh, time step and reduction. fitted.toml is the scene with the values.

    Refused, with exit status 3: a misfit beyond chance, a mesh or time step that changes a value by more than the noise
    (--refine mends both), a direction that the data do not determine, a fit that does not converge.

    Where linear elasticity is beyond its range, the fit is made at finite strain, with reduced models of full runs;
    where the data do not decide between both, the values are linear and the difference is a part of their errors.

    Example: softgrasp identify my.toml camera.csv --fit mu,lambda,beta --noise 1e-3

    Before measuring: softgrasp identify my.toml --fit mu,lambda --noise 1e-3 --suggest-markers 4
    """
    if suggest_markers is not None:
        with loading():
            from softgrasp.study.identify.suggest.run import run_suggest

        if data or robust or refine or posterior or certified is not None or law not in ("auto", "linear"):
            raise SceneError(
                "--suggest-markers plans a measurement by linear elasticity; leave out data, --robust, --refine, "
                "--posterior, --certified and --law"
            )
        status = run_suggest(
            scene, out or default_folder("suggest", scene), set_ or [], console(), fit=fit, noise=noise,
            markers=suggest_markers, motions=motions or [], rate=rate, offset=offset, shift=shift, columns=columns,
            **shared,
        )  # fmt: skip
        raise typer.Exit(status)
    if not data or motions or rate is not None:
        raise SceneError(
            "identify needs measurements, CSV files behind the scene; --motions and --rate go with --suggest-markers K"
        )
    with loading():
        from softgrasp.study.identify.run import run_identify

    folder = out or default_folder("identify", scene)
    status = run_identify(
        scene, folder, set_ or [], console(), data=data, fit=fit, noise=noise, offset=offset, shift=shift,
        robust=robust, refine=refine, columns=columns, law=law, certified=certified,
        posterior=posterior, **shared,
    )  # fmt: skip
    raise typer.Exit(status)
