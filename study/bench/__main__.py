"""``python -m softgrasp.study.bench forward | riccati | bases | switches | meshes | accuracy | certified``."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import typer

from softgrasp.study.bench import (
    accuracy,
    bases,
    certified,
    forward,
    forward_rows,
    meshes,
    riccati,
    riccati_rows,
    switches,
)
from softgrasp.study.shell.ending import run_command
from softgrasp.study.shell.jobs import leave_result

ROWS: dict[str, Callable[..., dict[str, Any]]] = {
    "forward": forward_rows.measure_row,
    "riccati": riccati_rows.measure_row,
    "bases": bases.measure,
    "switches": switches.measure,
}

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="What runs, Riccati equations and bases cost, beside other codes. Keep the machine quiet.",
)
for _name, _module in (
    ("forward", forward),
    ("riccati", riccati),
    ("bases", bases),
    ("switches", switches),
    ("meshes", meshes),
    ("accuracy", accuracy),
    ("certified", certified),
):
    app.command(name=_name, help=_module.HELP)(_module.main)


@app.command(hidden=True)
def worker(name: str, spec: str) -> None:
    """Measure one row of a benchmark and leave it where the launcher looks, see `launch_worker`. Collective."""
    arguments = json.loads(spec)
    leave_result(arguments.pop("file"), lambda: ROWS[name](**arguments))


if __name__ == "__main__":
    run_command(app)
