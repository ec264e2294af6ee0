"""``python -m benchmarks``: accuracy, certified, figures, forward, meshes, mujoco, outputs, riccati, scale, seeds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer
from mpi4py import MPI

from benchmarks import (
    accuracy,
    certified,
    figures,
    flex,
    forward,
    forward_rows,
    meshes,
    outputs,
    riccati,
    scale,
    scale_rows,
    seeds,
    solvers,
)
from softgrasp.study.shell.ending import run_command

COMMANDS = {
    "forward": forward, "riccati": riccati, "meshes": meshes, "accuracy": accuracy, "certified": certified,
    "outputs": outputs, "seeds": seeds, "figures": figures, "solvers": solvers, "scale": scale,
    "mujoco": flex,
}  # fmt: skip
WORKERS: dict[str, Callable[..., Iterable[Any]]] = {
    "forward": forward_rows.measure_row, "riccati": riccati.measure_row, "scale": scale_rows.measure_row,
}  # fmt: skip

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="What runs and Riccati equations cost, beside other codes. Keep the machine quiet.",
)
for _name, _module in COMMANDS.items():
    app.command(name=_name, help=_module.HELP)(_module.main)


@app.command(hidden=True)
def worker(name: str, spec: str) -> None:
    """Measure points of a benchmark and leave each where the launcher looks, see `launch_worker`. Collective."""
    arguments = json.loads(spec)
    file = Path(arguments.pop("file"))
    for point in WORKERS[name](**arguments):
        if MPI.COMM_WORLD.rank == 0:
            with file.open("a") as lines:
                lines.write(json.dumps(asdict(point)) + "\n")


if __name__ == "__main__":
    run_command(app)
