"""The arguments of ``softgrasp serve``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from softgrasp.study.shell.ending import console


def serve(
    model: Annotated[Path, typer.Argument(help="certified model that `reduce --tolerance` wrote")],
    inputs: Annotated[str, typer.Option(help="parameters of the input vector: some of lambda, mu, rho")] = "lambda,mu",
    host: Annotated[str, typer.Option(help="address; other machines reach it unless it is of the loopback")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="port; 0 chooses a free one", min=0, max=65535)] = 4242,
) -> None:
    """Let tools of uncertainty quantification ask a certified model, by the UM-Bridge protocol.

    Model "forward" gives the outputs over time with gradient and Jacobian, "bound" the errors of the outputs, proved
    unless the model was trained with certify = "estimate". A material whose error is above the tolerance of the
    model is refused.

    Example: softgrasp serve out/paper_forward-reduce/models/certified.h5
    """
    from softgrasp.study.serve.run import run_serve

    run_serve(model, console(), host=host, port=port, inputs=inputs)
