"""``softgrasp new`` and ``softgrasp materials``: a scene to begin with, and the library with its sources."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softgrasp.fem import LIBRARY, SceneError, load_scene, scene_schema
from softgrasp.fem.errors import MeshError
from softgrasp.study.forward.cautions import STIFF
from softgrasp.study.report import Table

if TYPE_CHECKING:
    from softgrasp.fem.mesh.tissue_mesh import MeshArrays, Sets

LARGEST = 2.0  # of a body in a robot's hand [m]; a larger one counts as given in millimetres
SCHEMA = "scene.schema.json"
SCENE = """\
#:schema ./{schema}
# `softgrasp explain {file}` says what this scene simulates; `softgrasp schema` lists every key with its unit.
name = "{name}"
description = "{description}"

[tissue]
{tissue}
material = "muscle" # `softgrasp materials`, or {{ young = 2.0e4, poisson = 0.45, rho = 1060.0 }} in Pa and kg/m3
{layers}
[contact] # the part of the boundary that the hand grips
{contact}

[hand]
mass = 0.73 # [kg]; with effects.rotation also inertia [kg m2]

[effects] # what is not named is off and costs nothing: gravity, damping, reaction, rotation, finite_strain
gravity = {{ g = {g} }} # [m/s2]
damping = {{ kind = "kelvin-voigt", beta = 0.01 }} # D = beta K, beta [s]

[motion]
target = {target} # [m]
duration = 1.0 # [s]

[time]
steps = 400
end = 1.5 # [s]
start = "equilibrium"

[control]
outputs = [{{ kind = "node", point = {point}, name = "tip" }}] # [m]
"""


def new_scene(file: Path, *, solid: bool = False, mesh: Path | None = None) -> list[Path]:
    """Write a scene that runs, with the schema beside it for editors. Not collective.

    A mesh file gives the box of the body: the hand grips its uppermost group of facets, or its upper tenth without
    groups, the output is its lowest node, and each group of cells is a layer.

    Raises:
        SceneError, MeshError: the file exists, or the mesh cannot be read; nothing is written.
    """
    if file.suffix != ".toml":
        raise SceneError(f"{file}: a scene is a TOML file; name it {file.with_suffix('.toml').name}")
    if file.exists():
        raise SceneError(f"{file}: this file exists; name another one")
    layers = ""
    lower, upper = np.zeros(3 if solid else 2), np.array([0.06, 0.04, 0.12] if solid else [0.06, 0.12])
    tip = np.where(np.arange(len(upper)) < len(upper) - 1, upper / 2, 0.0)
    if mesh is None:
        cells = [6, 4, 12] if solid else [12, 24]
        tissue = f"size = {_list(upper)} # [m]\ncells = {cells}" + ("" if solid else "\nthickness = 0.04 # [m]")
        sides = 'sides = ["left", "right"]\n'
    else:
        from softgrasp.fem import _stack  # noqa: F401  MPI before DOLFINx
        from softgrasp.fem.mesh.file import load_arrays

        try:
            arrays, repair = load_arrays(mesh, 1.0, repair=False), ""
        except MeshError:  # another fault than inverted cells is raised again
            arrays, repair = load_arrays(mesh, 1.0, repair=True), "\nrepair = true # turns the inverted cells round"
        scale = 1e-3 if np.ptp(arrays.points, axis=0).max() > LARGEST else 1.0
        points = scale * arrays.points
        lower, upper, tip = points.min(axis=0), points.max(axis=0), points[points[:, -1].argmin()]
        tissue = _mesh_lines(mesh, file, scale, float(np.ptp(arrays.points, axis=0).max())) + repair
        sides, layers = _facet_line(arrays), _layer_tables(arrays)
        nu = max((LIBRARY[name].poisson for name in _layer_materials(arrays).values()), default=0.0)
        tissue += f"\norder = 2 # linear elements lock at a Poisson's ratio of {nu:g}" if nu > STIFF else ""
    d, body = len(upper), f"The body of {mesh.name}" if mesh else f"A {'block' if solid else 'strip'} of muscle"
    top = np.append(lower[:-1], upper[-1] - (0.1 if mesh else 0.25) * (upper[-1] - lower[-1]))
    text = SCENE.format(
        schema=SCHEMA, file=file.name, name=file.stem, tissue=tissue,
        description=f"{body} in a hand.",
        layers=layers, contact=sides if "facet_tag" in sides else f"{sides}box = [{_list(top)}, {_list(upper)}] # [m]",
        g=_list([0.0] * (d - 1) + [-9.81]), target=_list([0.1] + [0.0] * (d - 2) + [0.05]), point=_list(tip),
    )  # fmt: skip
    file.parent.mkdir(parents=True, exist_ok=True)
    schema = file.with_name(SCHEMA)
    fresh = [path.with_name(f"new-{path.name}") for path in (file, schema)]
    try:
        fresh[0].write_text(text)
        load_scene(fresh[0])
        fresh[1].write_text(json.dumps(scene_schema(), indent=1) + "\n")
        for written, place in zip(fresh, (file, schema), strict=True):
            written.replace(place)
    finally:  # of what was not written whole
        for written in fresh:
            written.unlink(missing_ok=True)
    return [file, schema]


def _mesh_lines(mesh: Path, file: Path, scale: float, extent: float) -> str:
    """Path from the scene's folder and the unit, guessed from the size of the body."""
    path = Path(os.path.relpath(mesh.resolve(), file.parent.resolve())).as_posix()
    if scale == 1.0:
        return f"mesh = {json.dumps(path)} # in metres; scale = 1.0e-3 for a file in millimetres"
    guess = f"the body would be {extent:.4g} m long, so its numbers count as millimetres; 1.0 for metres"
    return f"mesh = {json.dumps(path)}\nscale = {scale!r} # {guess}"


def _facet_line(arrays: MeshArrays) -> str:
    """``contact.facet_tag``: the group of facets that lies highest, others in a comment; "" without groups."""
    dimension, nodes, marks = arrays.marks["facet_tags"]
    groups = _groups(arrays.known["facet_sets"])
    if marks is None or not groups:
        return ""
    height = arrays.points[nodes].mean(axis=1)[:, dimension]
    highest = max(groups, key=lambda name: height[np.isin(marks, groups[name])].mean())
    others = [json.dumps(name) for name in groups if name != highest]
    also = f"other groups: {', '.join(others)}; " if others else ""
    return f"facet_tag = {json.dumps(highest)} # {also}or sides and box"


def _layer_tables(arrays: MeshArrays) -> str:
    """A layer for each group of cells if there are two or more, with the material of its name or of the whole."""
    materials, tables = _layer_materials(arrays), []
    for name in materials:
        key = name if isinstance(name, str) else f"tag{name}"
        key = "tissue_group" if key == "tissue" else key  # that name is of the cells outside of all layers
        tables.append(
            f'\n[tissue.layers.{json.dumps(key)}]\ntag = {json.dumps(name)}\nmaterial = "{materials[name]}"\n'
        )
    return "".join(tables)


def _layer_materials(arrays: MeshArrays) -> dict[str | int, str]:
    """Material of each group of cells: that of its name, or of the whole; none where there are not two groups."""
    groups = _groups(arrays.known["cell_sets"])
    known = {name: str(name).lower() if str(name).lower() in LIBRARY else "muscle" for name in groups}
    return known if len(known) > 1 else {}


def _groups(sets: Sets) -> Sets:
    """Named groups, or tag numbers where there are no names or two share a mark."""
    named: Sets = {name: marks for name, marks in sets.items() if isinstance(name, str)}
    marks = [mark for each in named.values() for mark in each]
    if named and len(marks) == len(set(marks)):
        return named
    return {name: marks for name, marks in sets.items() if isinstance(name, int)}


def _list(values: np.ndarray | list[float]) -> str:
    return "[" + ", ".join(f"{float(f'{x:.6g}')!r}" for x in values) + "]"


def materials_table() -> Table:
    """The library: name, E, nu, rho, source."""
    rows = [(name, m.young, m.poisson, m.rho, m.source) for name, m in LIBRARY.items()]
    return Table(("material", "E [Pa]", "nu", "rho [kg/m3]", "source"), rows)
