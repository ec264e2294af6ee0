"""Options that several commands share: folder, overrides, pictures, and the scene file with its completion."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from softgrasp.fem.errors import SceneError

Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", "-s", help="override a scene key, e.g. --set tissue.cells=[40,80]; may be repeated"),
]


def check_folder(out: Path | None) -> Path | None:
    """Refuse a folder that cannot be one before anything is computed."""
    if out is not None:
        there = next(path for path in (out, *out.absolute().parents) if path.exists())
        if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
            why = "cannot be written to" if there.is_dir() else "is a file"
            raise SceneError(f"--out {out}: {there} {why}; name a folder, which is made if it is missing")
    return out


Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="folder for result.json, tables, pictures and report.html; out/SCENE-COMMAND if it is not given",
        callback=check_folder,
    ),
]
Empty = Annotated[
    bool, typer.Option("--empty", help="first remove the results that an earlier run has left in the folder")
]


def _pdf(pdf: bool) -> bool:
    from softgrasp.study.pictures import PDF

    PDF.set(pdf)
    return pdf


Pdf = Annotated[bool, typer.Option("--pdf", help="write figures as PDF too", callback=_pdf)]
Quiet = Annotated[bool, typer.Option("--quiet", help="no progress bar")]
Pictures = Annotated[bool, typer.Option(" /--no-pictures", show_default=False, help="numbers and fields only")]


def _scenes(start: str) -> list[str]:
    """Scenes that ship and TOML files and folders below, for the shell's completion."""
    from softgrasp.fem.scene.file import shipped_scenes

    below = Path(start if start.endswith("/") else f"{start}x").parent
    near = [f"{p}/" if p.is_dir() else str(p) for p in below.glob("*") if p.is_dir() or p.suffix == ".toml"]
    return [name for name in (*shipped_scenes(), *near) if name.startswith(start)]


SceneFile = Annotated[
    Path,
    typer.Argument(help="scene file (TOML); `softgrasp scenes` lists those that ship", autocompletion=_scenes),
]
