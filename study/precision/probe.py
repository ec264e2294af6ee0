"""The outputs of a scene at fixed places of the body, so that runs on different meshes can be compared.

A node output is the displacement of the node nearest to a point, which differs from mesh to mesh. Here the point itself
counts: y(p) = R(p) q_s + sum_i phi_i(p) z_i with the shape functions phi_i of the cell that holds p.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.contact import rigid_modes
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.petsc import Array, total
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.scene.scene import Scene

REGION_POINTS = 4  # along each axis of the box of a region output


@dataclass(frozen=True)
class Places:
    """Where the outputs of a scene are, the same on every mesh.

    Attributes:
        names: of the outputs.
        points: places [m] whose mean each output is, one array (k, d) an output; empty for the hand.
    """

    names: tuple[str, ...]
    points: tuple[Array, ...]


@dataclass(frozen=True)
class Probe:
    """Outputs on one mesh, y = weights z[dofs] + C_s q_s, d components an output.

    Attributes:
        dofs: local tissue dofs that enter, (k,).
        weights: (p, k), p = outputs times d.
        C_s: rigid part, (p, n_s), on every rank.
        dimension: d.
    """

    dofs: np.ndarray
    weights: Array
    C_s: Array
    dimension: int

    def of_rows(self, comm: MPI.Intracomm, L: Array) -> Array:
        """Weights on the columns of a distributed block of displacements (n_local, N): (p, N). Collective."""
        return total(comm, self.weights @ L[self.dofs])


@dataclass(frozen=True)
class Probed:
    """One run of the full model at fixed places.

    Attributes:
        times: (steps + 1,) [s].
        y: displacements, (steps + 1, p) [m], on every rank.
        rigid: the part that moves with the hand, same shape.
        stamps: seconds of every step on the slowest rank, (steps,).
        factor: seconds of the factorisation.
    """

    times: Array
    y: Array
    rigid: Array
    stamps: Array
    factor: float


def find_places(scene: Scene, model: Model) -> Places:
    """Places of the scene's outputs: points as the scene names them, regions by a grid, else the farthest node.

    Collective.

    Raises:
        SceneError: an output lies outside the body.
    """
    found = make_outputs(scene, model.system)
    wanted = scene.control.outputs if scene.control is not None else []
    low, high = model.system.layout.bounds()
    points = []
    for i, output in enumerate(found):
        kind = wanted[i].kind if wanted else "farthest"
        if kind == "hand":
            points.append(np.zeros((0, model.system.layout.dimension)))
        elif kind == "region":
            box = np.clip(np.asarray(wanted[i].box, dtype=float), low, high)
            share = (np.arange(REGION_POINTS) + 0.5) / REGION_POINTS
            axes = [a + (b - a) * share for a, b in box.T]
            points.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, box.shape[1]))
        else:
            named = wanted[i].point if wanted else None
            points.append(np.array([output.point if named is None else named], dtype=float))
    return Places(tuple(o.name for o in found), tuple(points))


def make_probe(model: Model, places: Places) -> Probe:
    """Weights of all places on the mesh of a model. Collective."""
    layout, space = model.system.layout, model.space
    d, n_s, comm = layout.dimension, layout.n_s, layout.comm
    index_map = space.V.dofmap.index_map
    first = index_map.local_range[0]
    position = np.full(index_map.size_local, -1)
    position[space.free] = np.arange(len(space.free))
    corners = _corners(model)
    rows: list[dict[int, float]] = []
    C_s = np.zeros((len(places.points) * d, n_s))
    for i, points in enumerate(places.points):
        entries: dict[int, float] = {}
        if not len(points):
            C_s[i * d : (i + 1) * d, :d] = np.eye(d)  # the hand's own displacement
        for point in points:
            nodes, values, where = _locate(model, corners, point)
            rigid = rigid_modes(where[None, :], d, model.scene.effects.rotation, layout.reference)
            C_s[i * d : (i + 1) * d] += rigid / len(points)
            for node, value in zip(nodes - first, values, strict=True):
                if 0 <= node < len(position) and position[node] >= 0:
                    entries[int(position[node])] = entries.get(int(position[node]), 0.0) + value / len(points)
        rows.append(entries)
    free = sorted({node for entries in rows for node in entries})
    column = {node: k for k, node in enumerate(free)}
    weights = np.zeros((len(rows) * d, len(free) * d))
    for i, entries in enumerate(rows):
        for node, value in entries.items():
            for c in range(d):
                weights[i * d + c, column[node] * d + c] = value
    dofs = (np.array(free, dtype=int)[:, None] * d + np.arange(d)).ravel()
    comm.Barrier()
    return Probe(dofs, weights, C_s, d)


def _corners(model: Model) -> Array:
    """Corners of the owned cells, (cells, d + 1, d). Not collective."""
    mesh, d = model.space.mesh.mesh, model.space.mesh.dimension
    owned = mesh.topology.index_map(d).size_local
    return np.asarray(mesh.geometry.x[mesh.geometry.dofmaps[0][:owned]][:, :, :d])


def barycentric(corners: Array, point: Array) -> Array:
    """Barycentric coordinates of a point in simplices (cells, d + 1, d): (cells, d + 1). Not collective."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    rest = np.linalg.solve(edges, (point - corners[:, 0])[:, :, None])[:, :, 0]
    return np.column_stack([1 - rest.sum(axis=1), rest])


def _locate(model: Model, corners: Array, point: Array) -> tuple[np.ndarray, Array, Array]:
    """Global nodes of the cell that holds a point, their shape functions there, and the place. Collective.

    Outside the body the nearest cell's coordinates are cut to it.
    """
    comm = model.system.layout.comm
    best, answer = -np.inf, None
    if len(corners):
        lam = barycentric(corners, point)
        cell = int(np.round(lam.min(axis=1), 9).argmax())
        best = float(lam[cell].min())
        inside = np.clip(lam[cell], 0, None)
        inside /= inside.sum()
        answer = (*_shape(model, cell, inside), inside @ corners[cell])
    root = int(np.argmax(comm.allgather(best)))
    nodes, values, where = comm.bcast(answer, root=root)
    return np.asarray(nodes), np.asarray(values), np.asarray(where)


def _shape(model: Model, cell: int, lam: Array) -> tuple[np.ndarray, Array]:
    """Global nodes of a cell and their shape functions at barycentric coordinates lam. Not collective."""
    V = model.space.V
    local = V.dofmap.cell_dofs(cell)
    nodes = V.dofmap.index_map.local_to_global(np.asarray(local, dtype=np.int32))
    return nodes, np.asarray(V.element.basix_element.tabulate(0, lam[None, 1:])[0, 0, :, 0])


class ProbedRun(Run):
    """A run that records the places instead of the scene's nodes, and the seconds of every step.

    Args:
        model: the model.
        probe: places on its mesh.
    """

    def __init__(self, model: Model, probe: Probe) -> None:
        self.probe: Probe | None = None
        super().__init__(model, RunOptions())
        self.probe = probe
        self.local_outputs = np.zeros((self.steps + 1, len(probe.weights)))
        self.stamps = np.zeros(self.steps)

    def step(self, ts: Any) -> None:
        """One step, timed without the check of its solve. Collective."""
        begin, n, checked = time.perf_counter(), self.reached, self.checking
        super().step(ts)
        self.stamps[n] = time.perf_counter() - begin - (self.checking - checked)

    def record(self, n: int) -> None:
        """This rank's share of the places, and what the work of the load needs. Not collective."""
        self.pulls[n] = self.midpoint.pull()
        if self.probe is not None and len(self.probe.dofs):
            self.local_outputs[n] = self.probe.weights @ self.state.array[self.probe.dofs]


def run_probed(model: Model, probe: Probe, until: int | None = None) -> Probed:
    """Factor and run, to the end or a first part. Collective.

    Raises:
        SolverError: a solve failed, missed its tolerance, or the energy is no longer finite.
    """
    comm = model.system.layout.comm
    model.watch.seconds.pop("factor", None)
    run = ProbedRun(model, probe)
    ts = make_ts(run)
    try:
        run.start()
        last = run.steps if until is None else min(until, run.steps)
        comm.Barrier()
        run.check_step(ts, last)
        run.watch_energy()
        stamps = np.empty_like(run.stamps[:last])
        comm.Allreduce(run.stamps[:last], stamps, MPI.MAX)
        rigid = run.drive.q[: last + 1] @ probe.C_s.T
        y = total(comm, run.local_outputs[: last + 1]) + rigid
        times = run.end * np.arange(last + 1) / run.steps
        return Probed(times, y, rigid, stamps, model.watch.seconds["factor"])
    finally:
        ts.destroy()
        run.midpoint.destroy()
