"""Cores, free memory, and free disk space before fields are written: their libraries end the program on a full disk."""

from __future__ import annotations

import os
import resource
import shutil
from collections.abc import Sequence
from pathlib import Path

import psutil
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError, raise_on_all_ranks

MARGIN = 2**18  # bytes: tables of contents that the libraries add, more when they close a file
CONTAINER = Path("/sys/fs/cgroup")


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory() -> int:
    """Memory that is free on this node, or that its container leaves, at least 1 [byte].

    Contents of files that the system gives back when memory is short count as free.
    """
    free = int(psutil.virtual_memory().available)
    for limit, used, table, key in (
        ("memory.max", "memory.current", "memory.stat", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat", "total_inactive_file"),
    ):
        try:
            most, taken = (int((CONTAINER / name).read_text()) for name in (limit, used))
        except (OSError, ValueError):
            continue
        free = min(free, max(most - taken + _entry(CONTAINER / table, key), 1))
    return free


def size_text(size: float) -> str:
    """A number of bytes with its unit."""
    for unit in ("byte", "KiB", "MiB", "GiB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1024
    return f"{size:.3g} TiB"


def _entry(table: Path, key: str) -> int:
    """The number behind a word in a table of lines "word number"; 0 without one."""
    try:
        return next((int(number) for word, number in map(str.split, table.read_text().splitlines()) if word == key), 0)
    except (OSError, ValueError):
        return 0


def check_room(comm: MPI.Intracomm, files: Sequence[Path], needed: int, reserve: int = 0) -> None:
    """See that the disk, and the limit of the size of a file, leave room for more. Collective.

    Args:
        files: what this rank writes to, in one folder that exists; a file may be a folder of files.
        needed: bytes that come on top, of this rank.
        reserve: bytes that must stay free besides, of all ranks.

    Raises ResourceError: the room is too small.
    """
    total = comm.allreduce(needed) + MARGIN + reserve
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    with raise_on_all_ranks(comm):
        free = shutil.disk_usage(files[0].parent).free
        if free < total:
            raise ResourceError(f"{files[0]} needs {total} bytes more and {free} are free on the disk; free the disk")
        largest = max(map(_largest, files))
        if limit != resource.RLIM_INFINITY and limit < largest + needed + MARGIN:
            raise ResourceError(
                f"{files[0]} needs {needed + MARGIN} bytes more and no file may pass {limit} bytes here; raise the "
                "limit (ulimit -f)"
            )


def reserve_room(path: Path, size: int) -> None:
    """Allocate room on the disk behind the end of a file: HDF5, which gives back the rest, ends the program without it.

    Raises OSError: there is none, or the user's quota or the limit of a file's size is reached.
    """
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), file.seek(0, os.SEEK_END), size)


def _largest(path: Path) -> int:
    """Bytes of the largest file of a path, 0 if there is none."""
    parts = path.rglob("*") if path.is_dir() else [path]
    return max((part.stat().st_size for part in parts if part.is_file()), default=0)
