"""The nodes of a body that keep gaps: its whole boundary, or those that ``control.constraints.body`` gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.petsc import Array
from softgrasp.lqr.constrained.tissue import Surface, make_surface
from softgrasp.lqr.design.scene import control_of
from softgrasp.lqr.plant.checks import ControlError

SAME = 1e-6  # of the longest side, between a node and its place in an output
KEY = "control.constraints.body"


def body_surface(model: Model) -> Surface:
    """The boundary of the body, and which of its nodes keep gaps. Collective.

    Raises ControlError: a point lies outside the body, a name is that of no node on the boundary, or two take one node.
    """
    layout, given = model.system.layout, control_of(model).constraints
    surface, d = make_surface(layout, *model.space.surface()), layout.dimension
    if layout.n_s > d:
        rigid = rigid_modes(surface.nodes, d, True, layout.reference)
        surface = replace(surface, rigid=rigid.reshape(-1, d, layout.n_s))
    if given is None or given.body == "boundary":
        return surface
    nodes = layout.rounded(surface.nodes)
    kept: list[int] = []
    for i, entry in enumerate(given.body):
        key = f"{KEY}[{i}] = {entry!r}"
        point = _point(model, entry, key)
        if not layout.near_body(point):
            raise ControlError(f"{key} lies outside the body; move it there")
        distance = layout.rounded(np.linalg.norm(surface.nodes - point, axis=1))
        at = np.flatnonzero(distance == distance.min())
        number = int(at[np.lexsort(nodes[at].T[::-1])[0]])  # the same on any number of ranks
        if isinstance(entry, str) and distance[number] > SAME * layout.extent:
            raise ControlError(f"{key} is a node inside the body; give an output on its boundary, or a point in metres")
        if number in kept:
            raise ControlError(f"{key} names the node {(nodes[number] + 0.0).tolist()} a second time; leave it out")
        kept.append(number)
    return replace(surface, kept=np.sort(np.array(kept, dtype=np.int64)))


def _point(model: Model, entry: str | list[float], key: str) -> Array:
    """Of the node of an output, or as it is given [m]. Collective."""
    layout = model.system.layout
    if isinstance(entry, str):
        control = control_of(model)
        named = zip(control.output_names, control.outputs, strict=True)
        outputs = {name: output.point for name, output in named if output.kind == "node"}
        if entry not in outputs:
            raise ControlError(f"{key} is no output of kind node; these are {', '.join(outputs) or 'none'}")
        return np.asarray(layout.nearest_node(np.asarray(outputs[entry], dtype=float))[2])
    if len(entry) != layout.dimension:
        raise ControlError(f"{key} must have {layout.dimension} entries")
    return np.asarray(entry, dtype=float)
