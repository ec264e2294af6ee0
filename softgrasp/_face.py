"""The face of a package: names that load when they are used first, listed once, as imports for types."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any


def names_of(file: str | Path) -> dict[str, str]:
    """Name -> module of all imports in the ``if TYPE_CHECKING`` of an ``__init__.py``."""
    blocks = (node.body for node in ast.parse(Path(file).read_text()).body if isinstance(node, ast.If))
    imports = (node for block in blocks for node in block if isinstance(node, ast.ImportFrom))
    return {alias.name: node.module or "" for node in imports for alias in node.names}


def face(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package. Raises AttributeError: its face has no such name."""

    @cache
    def modules() -> dict[str, str]:
        return names_of(str(sys.modules[package].__file__))

    def load(name: str) -> Any:
        if name.startswith("__") or name not in modules():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(__import__(modules()[name], fromlist=[name]), name)  # which may be a module itself
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: sorted({*vars(sys.modules[package]), *modules()})
