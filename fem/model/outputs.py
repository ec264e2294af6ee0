"""Outputs y of a scene: displacement of a node, mean over a region, or the hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem.columns import Columns, hand_columns, labels
from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.system import BlockSystem


@dataclass(frozen=True)
class Output:
    """One named output y = C_e z + C_s q_s of tissue z and hand q_s, d components (n_s if of the hand) [m; rad]."""

    name: str  # label in tables and files
    columns: Columns  # label and unit of each component
    dofs: np.ndarray  # local tissue dofs that enter, shape (k, size); empty on ranks that own none
    weight: float  # factor of every listed dof, 1 / number of nodes [1]
    C_s: Array  # rigid part, (size, n_s), on every rank
    point: tuple[float, ...] = ()  # coordinates [m] of the node, or of the centre of the region
    place: str = ""  # the chosen node, or the nodes of the mean, in words; empty for the hand

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.columns)

    @property
    def names(self) -> tuple[str, ...]:
        """One per component: the label and its axis."""
        return labels(self.columns)


def make_outputs(scene: Scene, system: BlockSystem) -> tuple[Output, ...]:
    """Outputs of the scene; without any, the free node farthest from the hand. Collective.

    Raises SceneError: a node lies outside the body or a region has no node.
    """
    control = scene.control
    if control is None or not control.outputs:
        _, far = system.layout.nearest_nodes(system.layout.nodes, system.layout.reference, farthest=True)
        which = "the free one" if len(far) == 1 else f"one of the {len(far)} free ones"
        tip = _node(system, "tip", np.asarray(far[0][0]))
        return (replace(tip, place=f"node {_coordinates(tip.point)}, {which} farthest from the hand"),)
    result = []
    for i, (name, output) in enumerate(zip(control.output_names, control.outputs, strict=True)):
        if output.kind == "hand":
            n_s, d = system.layout.n_s, system.layout.dimension
            result.append(Output(name, hand_columns(n_s, d, name), np.zeros((0, n_s), int), 0.0, np.eye(n_s)))
        elif output.kind == "region":
            result.append(_region(system, name, np.asarray(output.box, dtype=float), i))
        else:
            _inside(system, output.point or [], i)
            result.append(_node(system, name, np.asarray(output.point, dtype=float)))
    return tuple(result)


def output_columns(outputs: Sequence[Output], n_local: int) -> Array:
    """C' of all outputs, y = C z + C_s q_s: local rows (n_local, p), Fortran order."""
    C = np.zeros((n_local, sum(o.size for o in outputs)), order="F")
    for j, (output, c) in enumerate((o, c) for o in outputs for c in range(o.size)):
        C[output.dofs[:, c], j] = output.weight
    return C


def _node(system: BlockSystem, name: str, point: Array) -> Output:
    layout = system.layout
    d = layout.dimension
    rank, first, where = layout.nearest_node(point)
    owns = layout.comm.rank == rank
    dofs = np.arange(first, first + d)[None, :] if owns else np.zeros((0, d), int)
    C_s = layout.comm.bcast(system.T[first : first + d].copy() if owns else None, root=rank)
    return Output(name, hand_columns(d, d, name), dofs, 1.0, C_s, tuple(where.tolist()), _place(system, point, where))


def _place(system: BlockSystem, point: Array, where: Array) -> str:
    """The node nearest to a point, and the number of others as near, in words. Collective."""
    layout = system.layout
    (least, equal), (nearer, _) = (layout.nearest_nodes(nodes, point) for nodes in (layout.nodes, layout.held))
    text = f"node {_coordinates(where)}"
    if len(equal) > 1:
        text += f", one of {len(equal)} equally near to {_coordinates(point)}"
    elif least > 0:
        text += f", nearest to {_coordinates(point)}"
    return text + ("; a nearer one is bonded to the hand" if nearer < least else "")


def _coordinates(point: Sequence[float] | Array) -> str:
    return "(" + ", ".join(f"{x + 0.0:.6g}" for x in point) + ")"  # + 0: no -0


def _region(system: BlockSystem, name: str, box: Array, i: int) -> Output:
    layout = system.layout
    d = layout.dimension
    # a node on the edge of the box is inside, rounded or not
    slack = 1e-9 * max(layout.extent, float(np.abs(box).max()))

    def within(nodes: Array) -> Any:
        return np.flatnonzero(((nodes >= box[0] - slack) & (nodes <= box[1] + slack)).all(axis=1))

    inside = within(layout.nodes)
    held = layout.held[within(layout.held)] if len(layout.held) else np.zeros((0, d))
    dofs = inside[:, None] * d + np.arange(d)
    free, carried = (int(n) for n in total(layout.comm, np.array([float(len(inside)), float(len(held))])))
    if free == 0:
        raise SceneError(f"control.outputs[{i}].box = {box.tolist()} has no free node of the body; move or enlarge it")
    count = free + carried  # nodes in the contact zone move with the hand
    R = rigid_modes(held, d, layout.n_s > d, layout.reference).reshape(-1, d, layout.n_s)
    C_s = total(layout.comm, system.T[dofs].sum(axis=0) + R.sum(axis=0)) / count
    place = f"mean of {count} nodes" + (f", {carried} of them bonded to the hand" if carried else "")
    return Output(name, hand_columns(d, d, name), dofs, 1.0 / count, C_s, tuple(box.mean(axis=0).tolist()), place)


def _inside(system: BlockSystem, point: list[float], i: int) -> None:
    if not system.layout.near_body(np.asarray(point, dtype=float)):
        low, high = system.layout.body_bounds()
        raise SceneError(
            f"control.outputs[{i}].point = {list(point)} lies outside the body, which spans "
            f"{(np.round(low, 6) + 0.0).tolist()} to {(np.round(high, 6) + 0.0).tolist()} m"  # + 0: no -0.0
        )
