"""A scene by its keys, the mesh that was read and its csv files: one hash of all of it, or key by key."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any

from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.obstacles import replace_paths
from softgrasp.fem.scene.scene import Scene

LATER = (("control", "constraints", "body", "boundary"),)
"""Keys that tables got later, with their defaults: at these they do not count, so that scenes keep their hashes."""


def scene_hash(scene: Scene, without: Iterable[str] = ("name", "description")) -> str:
    """SHA-256 of the resolved scene, of the contents of its mesh file and of the bytes of its csv files, 64 hex digits.

    Top-level keys in `without` do not count; nor do folder, name and format of the files. The mesh is the one that the
    model of this scene was built with; without a model it is read. Raises SceneError, MeshError: a file that the scene
    names cannot be read.
    """
    return hashlib.sha256(json.dumps(_resolved(scene, without), sort_keys=True).encode()).hexdigest()


def scene_keys(scene: Scene) -> dict[str, Any]:
    """Value of every key of the resolved scene by its whole name, a file by the hash of its contents; None left out.

    Raises SceneError, MeshError: as :func:`scene_hash`.
    """
    flat: dict[str, Any] = {}
    todo = list(reversed(_resolved(scene, ()).items()))
    while todo:
        key, value = todo.pop()
        if isinstance(value, dict):
            todo += [(f"{key}.{part}", each) for part, each in reversed(value.items())]
        elif value is not None:
            flat[key] = value
    return flat


def _resolved(scene: Scene, without: Iterable[str]) -> dict[str, Any]:
    data = scene.model_dump(mode="json", by_alias=True, exclude=set(without))
    tissue, motion = data.get("tissue", {}), data.get("motion", {})
    if tissue.get("mesh") is not None:
        given = scene._given
        tissue["mesh"] = scene._mesh_digest or (_mesh_digest(scene) if given is None else given.tissue.digest)
    if tissue.get("energy") is not None:
        tissue["energy"] = _energy_digest(scene)
    else:  # scenes of the built-in laws keep the hashes that they had before there were others
        for table in (tissue, *tissue.get("layers", {}).values()):
            table.pop("energy", None)
            table.pop("parameters", None)
    if scene._terms:
        data["terms"] = {term.name: {"value": term.value, "form": term.digest} for term in scene._terms}
    if motion.get("csv") is not None:
        motion["csv"] = _digest(scene, motion["csv"], "motion.csv")
    replace_paths(data, lambda name: _digest(scene, name, "csv of an obstacle's path"))
    for *tables, key, default in LATER:
        inner = data
        for table in tables:
            inner = inner.get(table) or {}
        if inner.get(key) == default:
            del inner[key]
    return data


def _mesh_digest(scene: Scene) -> str:
    from softgrasp.fem.mesh.file import load_arrays  # meshio is needed for mesh files only

    tissue = scene.tissue
    path = scene.path(str(tissue.mesh))
    return str(load_arrays(path, tissue.scale, tissue.repair, tissue.seam, tissue.read_limit).known["digest"])


def _energy_digest(scene: Scene) -> str:
    from softgrasp.fem.energy.own import energy_of  # only scenes with an energy of their own pay for it

    energy, d = energy_of(scene), scene.dimension
    if d is None and scene._given is not None:
        d = scene._given.tissue.dimension
    elif d is None:
        from softgrasp.fem.mesh.file import load_arrays

        tissue = scene.tissue
        path = scene.path(str(tissue.mesh))
        d = load_arrays(path, tissue.scale, tissue.repair, tissue.seam, tissue.read_limit).points.shape[1]
    assert energy is not None
    return str(energy.law(scene, d).signature)


def _digest(scene: Scene, name: str, key: str) -> str:
    try:
        return hashlib.sha256(scene.path(name).read_bytes()).hexdigest()
    except OSError as error:
        raise SceneError(f"scene '{scene.name}': {key} = '{name}' cannot be read ({error.strerror})") from None
