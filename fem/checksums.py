"""Files that are read back only as they were written: a manifest, and arrays whose SHA-256 it contains."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import CheckpointError, no_pipe
from softgrasp.fem.owned import note
from softgrasp.fem.petsc import Array

AGAIN = "run again without --resume"
BLOCK = 2**20  # bytes that are hashed at a time


class _Hashed(io.RawIOBase):
    """File that hashes all bytes as they are written."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.sha = file, hashlib.sha256()

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        self.sha.update(data)
        return self.file.write(data)


def digest(*parts: NDArray[Any] | None) -> str:
    """SHA-256 of kind, shape and numbers of arrays, 64 hex digits; None counts too."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(repr(None if part is None else (part.dtype.str, part.shape)).encode())
        sha.update(b"" if part is None else np.ascontiguousarray(part))
    return sha.hexdigest()


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> str:
    """Write arrays and return the SHA-256 of the file, of what was meant to be in it.

    Raises OSError: the file cannot be written in full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    note(path)
    with path.open("wb") as file:
        hashed = _Hashed(file)
        np.savez(hashed, allow_pickle=False, **arrays)
        file.flush()
        os.fsync(file.fileno())  # some disks report only now that they are full
    return hashed.sha.hexdigest()


def read_arrays(path: Path, sha256: str | None, advice: str = AGAIN) -> dict[str, Array]:
    """Read arrays back.

    Args:
        sha256: that of its manifest; None where the manifest has none.
        advice: what to do about a damaged file.

    Raises CheckpointError: the file is missing or not as it was written.
    """
    try:
        with no_pipe(path).open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != sha256:
                raise CheckpointError(f"{path} is damaged: its SHA-256 is not that of its manifest; {advice}")
            file.seek(0)
            with np.load(file, allow_pickle=False) as data:
                return dict(data)
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error.strerror or error}); {advice}") from error


def write_manifest(path: Path, entry: Mapping[str, Any]) -> None:
    """Put a manifest in place of the old one, with its own SHA-256.

    Raises OSError: it cannot be written; the old one stays.
    """
    fresh = path.with_suffix(".new")
    note(fresh, path)
    with fresh.open("w") as file:
        file.write(json.dumps({**entry, "sha256": _checksum(entry)}, indent=2) + "\n")
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)


def read_manifest(path: Path, format: int, advice: str = AGAIN) -> dict[str, Any]:
    """Read a manifest back. Raises CheckpointError: it is missing, of another format, or not as it was written."""
    try:
        entry = json.loads(no_pipe(path).read_bytes())
    except FileNotFoundError:
        raise CheckpointError(f"{path} does not exist; run once without --resume") from None
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); {advice}") from error
    if not isinstance(entry, dict):
        raise CheckpointError(f"{path} is damaged: it has no table; {advice}")
    if isinstance(entry.get("format"), int) and entry["format"] != format:
        raise CheckpointError(
            f"{path} was written by another version of softgrasp (format {entry['format']}, this one reads {format}); "
            f"{advice}"
        )
    if entry.pop("sha256", None) != _checksum(entry):
        raise CheckpointError(f"{path} is damaged: its SHA-256 is not that of its contents; {advice}")
    return entry


def remove_others(folder: Path, patterns: Iterable[str], kept: Iterable[str]) -> None:
    """Remove the files of some patterns that a manifest does not name."""
    names = set(kept)
    for pattern in patterns:
        for old in folder.glob(pattern):
            if old.name not in names:
                old.unlink(missing_ok=True)


def _checksum(entry: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(entry, sort_keys=True).encode()).hexdigest()
