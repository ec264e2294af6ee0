"""``python -m softgrasp.study.bench forward | riccati | bases | switches | meshes``."""

from __future__ import annotations

import typer

from softgrasp.study.bench import bases, forward, meshes, riccati, switches

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
):
    app.command(name=_name, help=_module.HELP)(_module.main)

if __name__ == "__main__":
    app()
