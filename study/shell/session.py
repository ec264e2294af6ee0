"""What the commands do alike: the scene and its size at the start, progress, result.json, the files at the end."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.scene.file import load_scene_collective, resolved_toml, scene_hash
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.forward.cautions import show_warnings
from softgrasp.study.forward.result import package_version


def open_scene(path: Path, overrides: list[str], console: Console) -> Scene:
    """Load a scene file and print its name and description. Collective.

    Raises:
        SceneError: the file or a key is wrong.
    """
    scene = load_scene_collective(MPI.COMM_WORLD, path, overrides)
    described = f": {escape(scene.description)}" if scene.description else ""
    console.print(f"[bold]{escape(scene.name)}[/bold]{described}", soft_wrap=True)
    return scene


def open_model(scene: Scene, console: Console) -> Model:
    """Build a scene and print its size and what its mesh warns of. Collective.

    Raises:
        SoftgraspError: the scene cannot be built.
    """
    model = build(scene, MPI.COMM_WORLD)
    layout = model.system.layout
    console.print(f"n_s = {layout.n_s}, n_e = {layout.n_e}, 2n = {layout.states}, {layout.comm.size} rank(s)")
    show_warnings(console, model.space.mesh.notes)
    return model


def progress_bar(console: Console, count: ProgressColumn, *, quiet: bool = False) -> Progress:
    """Bars with the time left, in a terminal only. Not collective.

    Args:
        console: where they go; a rank that prints nothing has none.
        count: how far a task is, a share or m of n.
        quiet: no bars.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), count, TextColumn("left"), TimeRemainingColumn())
    return Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True)


def list_files(console: Console, files: Sequence[Path]) -> None:
    """Print what was written, one a line. Not collective."""
    console.print("files:")
    for file in files:
        console.print(f"  {file}", soft_wrap=True, markup=False)


def machine() -> str:
    """Processor, system and Python, as results name them. Not collective."""
    return f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"


def origin(scene: Scene, ranks: int) -> dict[str, Any]:
    """Where the numbers of a result come from: the first keys of its ``result.json``. Not collective."""
    return {
        "scene": scene.name,
        "scene_hash": scene_hash(scene),
        "version": package_version(),
        "ranks": ranks,
        "machine": machine(),
    }


def plain(value: Any) -> Any:
    """A value that JSON can hold: what is not finite becomes None. Not collective."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def write_scene(out: Path, scene: Scene) -> Path:
    """Write the resolved scene beside a result. Not collective: call on one rank."""
    path = out / "scene.toml"
    path.write_text(resolved_toml(scene))
    return path


def write_json(path: Path, result: dict[str, Any]) -> Path:
    """Write a result; what is not finite becomes null. Not collective: call on one rank."""
    path.write_text(json.dumps(plain(result), indent=2, allow_nan=False) + "\n")
    return path
