"""The folder of a run: its default name, whose results it holds, and how it is emptied."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from softgrasp.fem import SceneError, read_text, remove_own
from softgrasp.fem.owned import LIST, LOCK, begin_list, forget, hold, own_files, read_list, release, set_aside


def default_folder(command: str, scene: Path) -> Path:
    """``out/<scene>-<command>``, the scene by the name of its file."""
    return Path("out") / f"{scene.stem}-{command}"


def read_result(folder: Path) -> dict[str, Any]:
    """The ``result.json`` of a folder; empty where there is none of a command."""
    file = folder / "result.json"
    try:
        result = json.loads(read_text(file)) if file.is_file() else {}
    except (OSError, ValueError, RecursionError):
        return {}
    return result if isinstance(result, dict) and isinstance(result.get("command"), str) else {}


def files_of(result: dict[str, Any]) -> list[str]:
    """The files that a result names; a result that another program wrote may hold anything there."""
    files = result.get("files")
    return [name for name in files if isinstance(name, str)] if isinstance(files, list) else []


def remove_files(folder: Path, names: Iterable[str]) -> None:
    """Remove files of a run before, which its result.json names, as far as they are in the list of the folder."""
    home, doomed = folder.resolve(), set(names)
    for file in own_files(folder):
        if file.relative_to(home).as_posix() in doomed:
            file.unlink()


@contextmanager
def folder_lock() -> Iterator[None]:
    """Decorates a command: the folder that it claims is given back at its end, however it ends.

    Where another command called it, that one goes on with its own folder.
    """
    with set_aside():
        yield


def claim(out: Path, command: str, scene: str, *, inputs: Iterable[Path] = (), empty: bool = False) -> None:
    """Lock a folder, refuse the one of another scene or command, or empty it, and begin the list of its files.

    Not collective: call on one rank; the lock ends with the command, see :func:`folder_lock`.
    ``--empty`` removes what the list of the runs before names and nothing else; ``inputs``, files and folders that the
    command reads, must not be among it.

    Raises SceneError: another process runs in the folder, it is of another run, or it has no list.
    """
    hold(out)
    try:
        _settle(out, (command, scene), [path.resolve() for path in inputs], empty)
        begin_list(command, scene)
    except BaseException:
        release()
        raise


def _settle(out: Path, wanted: tuple[str, str], inputs: list[Path], empty: bool) -> None:
    owner, result = read_list(out)[0], read_result(out)
    known = owner is not None
    if owner is None and result:  # of a version that wrote no list
        owner = result["command"], str(result.get("scene", ""))
    if not empty:
        if owner not in (None, wanted):
            of = f" on {owner[1]}" if owner and owner[1] else ""
            raise SceneError(
                f"--out {out}: it contains the results of {owner[0] if owner else ''}{of}; name another folder, or "
                "remove them with --empty"
            )
        return
    if not known:
        if any(path.name != LOCK for path in out.iterdir()):
            raise SceneError(
                f"--out {out}: --empty removes the files that the list {LIST} of a run names, but there is no such "
                "list; name another folder, or remove the files by hand"
            )
        return
    for file in own_files(out):
        if used := next((path for path in inputs if file == path or file.is_relative_to(path)), None):
            raise SceneError(f"--out {out}: --empty would also remove {used}; name another folder")
    remove_own(out)
    (out / LIST).unlink(missing_ok=True)
    forget()
