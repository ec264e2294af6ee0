"""Measured points as JSON files, so that an interrupted study resumes where it stopped; and how it is stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from mpi4py import MPI

from softgrasp import __version__
from softgrasp.fem import Array, Scene, read_manifest, scene_hash, write_manifest
from softgrasp.fem.errors import CheckpointError, Interrupted, raise_on_all_ranks
from softgrasp.study.report import to_json

FORMAT = 4  # of the cached files


class Cache:
    """Frozen dataclasses by hash in a folder, each file one list of a class.

    The hash is of the scene (without name, description and what the point does not depend on), the setting, the number
    of ranks and the version. ``progress`` is called with the label of the point that comes and the share of points
    done. Collective.
    """

    def __init__(
        self, folder: Path, comm: MPI.Intracomm, scene: Scene, progress: Callable[[str, float], None] | None = None
    ) -> None:
        self.folder, self.comm, self.progress = folder, comm, progress
        self.stop: list[bool] = []  # filled by the first Ctrl-C
        self.count, self.done = 1, 0  # points in all, as far as they are known, and those begun
        self.scene = ""  # rank 0 looks for the files
        with raise_on_all_ranks(comm):
            if comm.rank == 0:
                self.scene = scene_hash(scene, ("name", "description", "reduction", "output"))
        self.hits = self.misses = 0

    def path(self, kind: str, key: dict[str, Any]) -> Path:
        """File of the values of a key."""
        whole = {"scene": self.scene, "ranks": self.comm.size, "version": __version__, "format": FORMAT} | key
        digest = hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()
        return self.folder / f"{kind}-{digest[:20]}.json"

    def point[T](
        self, label: str, kind: str, key: dict[str, Any], of: type[T], measure: Callable[[], Sequence[T]]
    ) -> list[T]:
        """:meth:`get` of a point with a label. Raises Interrupted: Ctrl-C has stopped the study before it."""
        share = min(self.done / self.count, 1.0)
        if self.comm.allreduce(bool(self.stop), MPI.LOR):
            raise Interrupted(
                f"stopped before '{label}' with {100 * share:.0f} % done; the same command goes on from there"
            )
        if self.progress is not None:
            self.progress(label, share)
        self.done += 1
        return self.get(kind, key, of, measure)

    def get[T](self, kind: str, key: dict[str, Any], of: type[T], measure: Callable[[], Sequence[T]]) -> list[T]:
        """The cached values of a class, or the measured ones, which are then kept; both as they come out of JSON."""
        rows = None
        if self.comm.rank == 0:
            with suppress(CheckpointError):  # missing or damaged: it is measured again
                rows = read_manifest(self.path(kind, key), FORMAT)["value"]
        rows = self.comm.bcast(rows)
        if rows is not None:
            self.hits += 1
            return [_revived(of, row) for row in rows]
        self.misses += 1
        rows = json.loads(json.dumps(to_json(list(measure()))))
        with raise_on_all_ranks(self.comm):
            if self.comm.rank == 0:
                self.folder.mkdir(parents=True, exist_ok=True)
                write_manifest(self.path(kind, key), {"format": FORMAT, "kind": kind, "key": key, "value": rows})
        return [_revived(of, row) for row in self.comm.bcast(rows)]


def _revived[T](of: type[T], row: dict[str, Any]) -> T:
    """A dataclass out of JSON, where null stands for a float that is not finite."""
    hints = get_type_hints(of)
    return of(**{name: _value(hints[name], value) for name, value in row.items()})


def _value(kind: Any, value: Any) -> Any:
    if kind is float:
        return float("inf") if value is None else float(value)
    if get_origin(kind) is UnionType and value is not None:
        kind = get_args(kind)[0]
    if get_origin(kind) is tuple and value is not None:
        return tuple(value)
    return np.array(value, dtype=float) if kind == Array else value
