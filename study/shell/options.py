"""Options that several commands share: folder, overrides, pictures, and the scene file with its completion."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_origin

import typer
from typer.core import TyperGroup

from softgrasp.fem import SceneError
from softgrasp.study.shell.ending import rank

# a wrong option or argument, which typer gives no public name
WRONG: type[BaseException] = typer.BadParameter.__bases__[0]


class OneReport(TyperGroup):
    """Commands of a program on ranks: rank 0 alone reports a wrong option, and all end with status 2."""

    def make_context(self, *given: Any, **extra: Any) -> Any:
        """See typer."""
        with _reported_once():
            return super().make_context(*given, **extra)

    def invoke(self, ctx: Any) -> Any:
        """See typer; the options of a command are read here."""
        with _reported_once():
            return super().invoke(ctx)


@contextmanager
def _reported_once() -> Iterator[None]:
    try:
        yield
    except WRONG:
        if rank() == 0:
            raise
        raise typer.Exit(2) from None


def parse_folder(text: str) -> Path:
    """The folder of ``--out``; refused before anything is computed if it cannot be one."""
    if not text.strip():
        raise SceneError("--out is empty; name a folder, which is made if it is missing, or . for this one")
    out = Path(text)
    there = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not (there.is_dir() and os.access(there, os.W_OK | os.X_OK)):
        why = "cannot be written to" if there.is_dir() else "is a file"
        raise SceneError(f"--out {out}: {there} {why}; name a folder, which is made if it is missing")
    return out


def parse_tolerance(text: str | float) -> float:
    """A relative tolerance such as ``1e-3``.

    Raises:
        SceneError: it is no number between 0 and 1.
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise SceneError(f"--tolerance {text}: it must be a number between 0 and 1, such as 1e-3")
    return value


def _pdf(pdf: bool) -> bool:
    from softgrasp.study.pictures.pdf import PDF

    PDF.set(pdf)
    return pdf


def _scenes(start: str) -> list[str]:
    """Scenes that ship and TOML files and folders below, for the shell's completion."""
    from softgrasp.fem.scene.file import shipped_scenes

    below = Path(start if start.endswith("/") else f"{start}x").parent
    near = [f"{p}/" if p.is_dir() else str(p) for p in below.glob("*") if p.is_dir() or p.suffix == ".toml"]
    return [name for name in (*shipped_scenes(), *near) if name.startswith(start)]


OVERRIDE = "override a scene key, e.g. --set tissue.cells=[40,80]; may be repeated"
EMPTY = "first remove the files that earlier runs have left in the folder, by its own list"
FOLDER = "folder for result.json, tables, pictures and report.html; out/SCENE-COMMAND if it is not given"
SHARED: dict[str, tuple[Any, Any]] = {  # type, and what typer shows
    "scene": (
        Path,
        typer.Argument(..., help="scene file (TOML); `softgrasp scenes` lists those that ship", autocompletion=_scenes),
    ),
    "out": (Path | None, typer.Option(None, "--out", "-o", help=FOLDER, parser=parse_folder, metavar="FOLDER")),
    "set_": (list[str] | None, typer.Option(None, "--set", "-s", help=OVERRIDE)),
    "quiet": (bool, typer.Option(False, "--quiet", help="no progress bar")),
    "pictures": (bool, typer.Option(True, " /--no-pictures", show_default=False, help="numbers and fields only")),
    "empty": (bool, typer.Option(False, "--empty", help=EMPTY)),
    "pdf": (bool, typer.Option(False, "--pdf", help="write figures as PDF too", callback=_pdf)),
}


def takes(order: str, out: str = "") -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command options of `SHARED` beside its own, which are `Annotated`; it gets all but ``pdf`` by keyword.

    Args:
        order: names of all its arguments and options as ``--help`` lists them.
        out: what ``--out`` is for, if not for the folder of a run.
    """

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters

        def parameter(name: str) -> inspect.Parameter:
            if name in own and get_origin(own[name].annotation) is Annotated:
                return own[name].replace(kind=inspect.Parameter.KEYWORD_ONLY)
            kind, info = SHARED[name]
            if name == "out" and out:
                info = copy(info)
                info.help = out
            return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=info, annotation=kind)

        @wraps(command)
        def call(**given: Any) -> None:
            given.pop("pdf", None)  # its callback has seen it
            command(**given)

        call.__signature__ = inspect.Signature(list(map(parameter, order.split())))  # type: ignore[attr-defined]
        return call

    return decorated
