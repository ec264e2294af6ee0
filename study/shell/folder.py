"""The folder of a run: its default name, whose results it holds, and how it is emptied."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from softgrasp.fem.errors import SceneError


def default_folder(command: str, scene: Path) -> Path:
    """``out/<scene>-<command>``, the scene by the name of its file."""
    return Path("out") / f"{scene.stem}-{command}"


def read_result(folder: Path) -> dict[str, Any]:
    """The ``result.json`` of a folder; empty where there is none of a command."""
    try:
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return {}
    return result if isinstance(result, dict) and "command" in result else {}


def remove_files(folder: Path, names: Iterable[str]) -> None:
    """Remove files of a run before, which its result.json names, where they lie in its folder."""
    for name in names:
        file = folder / name
        if file.is_file() and file.resolve().is_relative_to(folder.resolve()):
            file.unlink()


def claim(out: Path, command: str, scene: str, *, path: Path = Path(), empty: bool = False) -> None:
    """Refuse a folder that holds the run of another scene or command, or empty it. Not collective: call on one rank.

    ``path``, the scene file, must not be removed. Raises SceneError: the folder is of another run, or of several.
    """
    result = read_result(out)
    if not empty:
        if result and (result["command"], result.get("scene", "")) != (command, scene):
            owner = f" on {result['scene']}" if result.get("scene") else ""
            raise SceneError(
                f"--out {out}: it holds the results of {result['command']}{owner}; name another folder, or remove "
                "them with --empty"
            )
        return
    if not out.exists() or not any(out.iterdir()):
        return
    if not result:
        raise SceneError(f"--out {out}: --empty removes the results of a run, but there is no result.json of one")
    home = out.resolve()
    keep = [Path.cwd(), path.resolve(), *(p.parent for p in home.rglob("result.json") if p.parent != home)]
    if inside := next((p for p in keep if p.is_relative_to(home)), None):
        raise SceneError(f"--out {out}: --empty would also remove {inside}; name another folder")
    for item in home.iterdir():
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item)
        else:
            item.unlink()
