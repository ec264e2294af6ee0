"""The folder in which this process runs: a lock that keeps other runs out, and the list of the files of its runs.

Both lie in the folder. The list names every file before it is written, so that it is true of a run that was stopped,
too; a file that it does not name is not the program's. One folder at a time; its subfolders belong to it.
"""

from __future__ import annotations

import atexit
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil

from softgrasp.fem.errors import SceneError, no_pipe, raise_on_all_ranks

if TYPE_CHECKING:  # pages are written without MPI
    from mpi4py import MPI

LOCK, LIST = "softgrasp.lock", "softgrasp.files"
SAME_START = 1.0  # tolerance of the start of a process [s]: the system may correct the clock that it is read from


@dataclass(frozen=True)
class Process:
    """Process that has locked a folder."""

    host: str  # name of the machine and, in a container, of its process table
    pid: int  # process number on that machine
    started: float  # start of the process since 1970 [s]; process numbers are used again after some time

    @classmethod
    def own(cls) -> Process:
        """This process."""
        host = socket.gethostname()
        with suppress(OSError):
            host += f" {os.readlink('/proc/self/ns/pid')}"
        return cls(host, os.getpid(), psutil.Process().create_time())

    def ended(self) -> bool:
        """Whether the process has ended for certain, which is known of processes of this machine only."""
        if self.host != Process.own().host:
            return False
        try:
            found = psutil.Process(self.pid)
            return found.status() == psutil.STATUS_ZOMBIE or abs(found.create_time() - self.started) > SAME_START
        except psutil.NoSuchProcess:
            return True


@dataclass
class _Held:
    """The folder of this process."""

    folder: Path  # absolute path without links
    pid: int  # number of the process that locked it; a forked one inherits this object, but not the lock
    locked: bool  # whether this rank has the lock
    made: bool  # whether locking made the folder, so that an empty one is removed
    noted: set[str]  # names in the list, relative to the folder


_held: _Held | None = None
_outer: list[_Held] = []  # folders of the commands inside which the running one was called


def hold(folder: Path) -> None:
    """Make and lock a folder until :func:`release` or the end of this process, and release the one before.

    Not collective: call on rank 0, and :func:`follow` on the others. Raises SceneError: another process has locked it.
    """
    global _held
    home = folder.resolve()
    if _held is not None and _held.folder == home and _held.locked:
        return
    release()
    if (shared := next((outer for outer in _outer if outer.folder == home and outer.locked), None)) is not None:
        _held = shared
        return
    made = not home.exists()
    home.mkdir(parents=True, exist_ok=True)
    lock, me = home / LOCK, Process.own()
    with _serial(home):  # two that see the same lock of an ended process do not both replace it
        if lock.exists():
            _check_ended(folder, lock)
            lock.unlink()
        try:
            file = os.open(lock, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:  # of another machine, just now
            _check_ended(folder, lock)
            raise SceneError(f"--out {folder}: another run has just begun there; name another folder") from None
        try:
            os.write(file, json.dumps(asdict(me)).encode())
        except OSError:
            lock.unlink()
            raise
        finally:
            os.close(file)
    _held = _Held(home, me.pid, True, made, read_list(home)[1])


def follow(folder: Path) -> None:
    """Add files of this rank to the list of a folder that rank 0 has locked."""
    global _held
    home = folder.resolve()
    if _held is None or _held.folder != home:
        _held = _Held(home, os.getpid(), False, False, set())


def _check_ended(folder: Path, lock: Path) -> None:
    """Raises SceneError: the process that a lock names runs, or may run."""
    try:
        holder = Process(**json.loads(no_pipe(lock).read_text()))
        name, ended = holder.host.split()[0], holder.ended()
    except (OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError):
        raise SceneError(f"--out {folder}: its lock {lock} is damaged; remove it if no run writes there") from None
    if ended or holder == Process.own():
        return
    if holder.host == Process.own().host:
        raise SceneError(
            f"--out {folder}: process {holder.pid} runs in this folder; name another folder, or wait for its end"
        )
    raise SceneError(
        f"--out {folder}: process {holder.pid} on {name} has locked this folder; name another folder, or remove {lock} "
        "if that process has ended, which cannot be asked from here"
    )


@contextmanager
def _serial(home: Path) -> Iterator[None]:
    """One process of this machine at a time, where the file system can do that."""
    handle = os.open(home, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def release() -> None:
    """Unlock the folder; remove the list of a run that wrote nothing, and a folder that was made for it."""
    global _held
    held, _held = _held, None
    if held is None or not held.locked or held.pid != os.getpid() or held in _outer:
        return
    with suppress(OSError):  # gone with the folder
        (held.folder / LOCK).unlink()
        if not any((held.folder / name).exists() for name in held.noted):
            (held.folder / LIST).unlink(missing_ok=True)
        if held.made and not any(held.folder.iterdir()):
            held.folder.rmdir()


atexit.register(release)


@contextmanager
def set_aside() -> Iterator[None]:
    """A block, such as a command, with a folder of its own; at its end the lock of the one before is restored."""
    global _held
    outer, _held = _held, None
    if outer is not None:
        _outer.append(outer)
    try:
        yield
    finally:
        release()
        if outer is not None:
            _outer.pop()
        _held = outer


@contextmanager
def locked(comm: MPI.Intracomm, folder: Path) -> Iterator[None]:
    """Lock a folder during a block, unless the running command has locked it or one above it. Collective.

    Raises SceneError: another process has locked it.
    """
    if _held is not None and folder.resolve().is_relative_to(_held.folder):
        yield
        return
    with set_aside():
        with raise_on_all_ranks(comm):
            if comm.rank == 0:
                hold(folder)
        yield


def begin_list(command: str, scene: str) -> None:
    """Write command and scene to the list of the locked folder, unless it names them already."""
    if _held is not None and read_list(_held.folder)[0] is None:
        _append(_held.folder / LIST, {"command": command, "scene": scene})


def forget() -> None:
    """Clear the names that this process noted, after the list was removed."""
    if _held is not None:
        _held.noted.clear()


def note(*files: Path) -> None:
    """Add files that are about to be written to the list; files in other folders are left out."""
    if _held is None:
        return
    for file in files:
        home = file.parent.resolve()
        if not home.is_relative_to(_held.folder):
            continue
        name = (home / file.name).relative_to(_held.folder).as_posix()
        if name not in _held.noted:
            _append(_held.folder / LIST, name)
            _held.noted.add(name)


def _append(path: Path, entry: Any) -> None:
    """One line by one write, so that ranks and forked processes do not mix theirs."""
    handle = os.open(path, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o644)
    try:
        os.write(handle, (json.dumps(entry) + "\n").encode())
    finally:
        os.close(handle)


def read_list(folder: Path) -> tuple[tuple[str, str] | None, set[str]]:
    """Command and scene of a folder, None without a list, and the names of its files.

    A line that was cut off is no entry, nor is a name that leads out of the folder.
    """
    owner: tuple[str, str] | None = None
    names: set[str] = set()
    try:
        lines = (folder / LIST).read_bytes().splitlines() if (folder / LIST).is_file() else []
    except OSError:
        lines = []
    for line in lines:
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(entry, str) and entry and "\0" not in entry:
            names.add(entry)
        elif isinstance(entry, dict) and owner is None:
            owner = str(entry.get("command", "")), str(entry.get("scene", ""))
    return owner, names


def own_files(folder: Path) -> list[Path]:
    """The files of the list that are there, none behind a link."""
    home = folder.resolve()
    files = []
    for name in sorted(read_list(home)[1]):
        file = home / name
        if file.is_file() and not file.is_symlink() and file.parent.resolve() == file.parent:
            files += [file] if file.is_relative_to(home) and ".." not in Path(name).parts else []
    return files


def remove_own(folder: Path, *some: Path) -> None:
    """Remove the files of the list, or ``some`` of them and those below, and the folders that this leaves empty."""
    home, tops = folder.resolve(), [path.resolve() for path in some or (folder,)]
    files = [file for file in own_files(home) if any(map(file.is_relative_to, tops))]
    for file in files:
        file.unlink(missing_ok=True)
    parents = {p for file in files for p in file.parents if p.is_relative_to(home) and p != home}
    for parent in sorted(parents, key=lambda p: -len(p.parts)):
        with suppress(OSError):  # not empty
            parent.rmdir()
