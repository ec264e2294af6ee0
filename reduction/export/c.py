"""Texts of C: arrays without any rounding, and whole folders of files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from softgrasp.fem.errors import ResourceError
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array

CODE = Path(__file__).parent / "code"
"""Folder of the code that is the same for all models."""
SHARED = ("vector.h", "golden.h", "timing.h")
LINE = 4  # numbers in a line


def comment(text: str) -> str:
    """One line."""
    return f"/* {text} */"


def array(name: str, values: Array) -> str:
    """A constant array, its numbers in hexadecimal and independent of the locale; whole numbers stay whole."""
    if not values.size:  # which C does not know
        values = np.zeros([max(n, 1) for n in values.shape], values.dtype)
    sizes = "".join(f"[{n}]" for n in values.shape)
    kind = "int" if values.dtype.kind == "i" else "double"
    return f"static const {kind} {name}{sizes} = {_braces(values)};"


def _braces(values: Array) -> str:
    if values.ndim > 1:
        return "{\n" + ",\n".join(_braces(part) for part in values) + "}"
    words = [str(value) if values.dtype.kind == "i" else float(value).hex() for value in values]
    return "{" + ",\n ".join(", ".join(words[i : i + LINE]) for i in range(0, len(words), LINE)) + "}"


def hexadecimal(values: Array) -> str:
    """Numbers of a line of a log."""
    return " ".join(float(value).hex() for value in values.ravel())


def code_of(folder: Path, name: str) -> dict[str, str]:
    """The texts of a program that are the same for all models: its own, those that all share, its Makefile."""
    texts = {path.name: path.read_text() for path in [*folder.glob(f"*{name}.[ch]"), *CODE.glob("*.h")]}
    shared = {key: text for key, text in texts.items() if name in key or key in SHARED}
    return shared | {"Makefile": (CODE / "Makefile").read_text().replace("NAME", name)}


def write_files(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts by name into a folder, all of them or none. Not collective.

    Raises ResourceError: the folder cannot be written; what was there stays.
    """
    paths = [folder / name for name in sorted(texts)]
    fresh = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        note(*paths)
        fresh = Path(tempfile.mkdtemp(prefix="new-", dir=folder))
        for path in paths:
            (fresh / path.name).write_text(texts[path.name])
        for path in paths:
            (fresh / path.name).replace(path)
    except OSError as error:
        raise ResourceError(f"{folder} cannot be written ({error.strerror or error}); name another folder") from error
    finally:
        if fresh is not None:
            shutil.rmtree(fresh, ignore_errors=True)
    return paths
