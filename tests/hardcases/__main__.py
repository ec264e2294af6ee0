"""``python -m tests.hardcases``: the suite of hard cases, in a checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from softgrasp.study.shell.ending import console, run_command
from softgrasp.study.shell.options import takes

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
@takes("out quick family quiet empty pdf")
def hardcases(
    out: Path | None,
    quick: Annotated[bool, typer.Option("--quick", help="the quick half only")] = False,
    family: Annotated[str | None, typer.Option(help="one family of cases only")] = None,
    **shared: bool,
) -> None:
    """Run the suite of hard cases: each keeps its stated bound, or is refused with a reason."""
    from tests.hardcases.run import run_hardcases

    result = run_hardcases(out or Path("out/hardcases"), console(), quick=quick, family=family, **shared)
    raise typer.Exit(0 if result["ok"] else 1)


if __name__ == "__main__":
    run_command(app)
