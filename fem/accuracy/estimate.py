"""Error of the outputs of a whole run from static solves on its mesh and on a finer space.

    delta y(t) = y'(t) - y_h(t)

is the difference of two small models (:mod:`softgrasp.fem.accuracy.small`) under the scene's own motion, start,
damping and coupling: one of the mesh itself, one of elements of the next order on the same cells, or of a graded mesh
where the mesh has no grading of its own. Both share the time step, whose error cancels. The graded mesh of a mesh file
has its cells, some bisected, and the next order, or it would be no finer away from the ends; that of a box has cells of
its own, and what it cannot tell from its tolerance is left to the next order.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import dolfinx.mesh
import numpy as np
from mpi4py import MPI

from softgrasp.fem.accuracy.small import Small, reduced, run_small
from softgrasp.fem.errors import SceneError
from softgrasp.fem.layout import bounding_box
from softgrasp.fem.model.build import MeshEstimate, Model, build
from softgrasp.fem.model.contact import contact_facets
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.tissue import Refine

if TYPE_CHECKING:
    from softgrasp.fem.scene.scene import Scene

# Error over estimate is at most 1 / (1 - q) when the finer space leaves the share q of the error: 0.28 from P1 to P2
# and 0.51 from P2 to P3 on uniform meshes with exponents of 1/2, where both converge with order 1.
BOUNDS = {1: 1.5, 2: 2.2, 3: 3.0}
GRADED_BOUND = 1.5
SHARE = 0.2  # of the estimate that a graded mesh may leave by its own tolerance
COMPARED = {2: (1e-2, 1e-3), 3: (3e-2,)}  # tolerances of graded meshes to compare with, by dimension
MOST_COMPARED = 60_000  # unknowns of such a mesh


def estimate(model: Model, coarse: Small | None = None, finer: Small | None = None) -> MeshEstimate:
    """Estimate the error that the mesh leaves in the outputs of the scene's run. Collective.

    Args:
        coarse: its small model, if there is one.
        finer: that of :func:`next_order`, likewise, for scenes with ``tissue.refine``.

    Raises:
        SolverError: a static solve fails.
        SceneError, MeshError: the graded mesh to compare with cannot be made, or is too large.
    """
    begin = time.perf_counter()
    small = coarse or reduced(model)
    run = small.run
    if model.scene.tissue.refine is not None:
        other = finer or reduced(next_order(model))
        by, bound, offer = "order", BOUNDS[min(model.scene.tissue.order, 3)], None
        relative, delta = difference(small, other)
        bound *= relative
    else:
        other, relative, delta, bound, by, offer = _compared(model, small)
    halved = run_small(small, 2 * model.scene.time.steps).deformation[::2]
    late, _ = difference(small, small, halved)
    delta = delta + other.run.rigid - run.rigid
    omega = small.modes[0][:2] / other.modes[0][:2] - 1
    return MeshEstimate(
        estimate=relative,
        bound=bound,
        delta=delta,
        omega=tuple(float(x) for x in omega),
        time_error=late * 4 / 3,
        shift=zone_shift(model),
        n_e=model.system.layout.n_e,
        finer=other.model.system.layout.n_e,
        by=by,
        offer=offer,
        seconds=model.system.layout.comm.allreduce(time.perf_counter() - begin, MPI.MAX),
    )


def _compared(model: Model, small: Small) -> tuple[Small, float, Array, float, str, tuple[float, int] | None]:
    """Finer model, estimate, delta y, bound, by and offer of :class:`MeshEstimate` for an ungraded mesh. Collective."""
    by, offer, box, order = "graded", None, model.scene.tissue.size is not None, model.scene.tissue.order
    count = next_unknowns(model)
    if not box and count > MOST_COMPARED:
        raise SceneError(
            f"elements of the next order to compare with would have about {count} unknowns, more than the "
            f"{MOST_COMPARED} of an estimate; run the scene with another tissue.order and compare the outputs."
        )
    for goal in COMPARED[model.system.layout.dimension]:
        other = reduced(build(comparison(model.scene, goal), comm=model.system.layout.comm))
        relative, delta = difference(small, other)
        if other.model.scene.tissue.order == 2:
            offer = (goal, other.model.system.layout.n_e)
        if relative > goal / SHARE or relative == 0:
            return other, relative, delta, GRADED_BOUND * relative, by, offer
    bound = GRADED_BOUND * relative + goal
    if box and count <= MOST_COMPARED:
        up = reduced(next_order(model))
        more, change = difference(small, up)
        if more > relative:
            return up, more, change, max(bound, BOUNDS[min(order, 3)] * more), "order", offer
    return other, relative, delta, bound, by, offer


def difference(small: Small, other: Small, finer: Array | None = None) -> tuple[float, Array]:
    """Largest difference of two runs over the largest deformation [1], and the difference (steps + 1, p).

    Outputs that are the hand's count only where there are no others.

    Args:
        finer: deformation (steps + 1, p) instead of that of the other's run.
    """
    finer = other.run.deformation if finer is None else finer
    tissue = np.abs(small.C).max(axis=1) + np.abs(other.C).max(axis=1) > 0
    if not tissue.any():
        tissue[:] = True
    delta = finer - small.run.deformation
    scale = np.linalg.norm(finer[:, tissue], axis=1).max()
    largest = np.linalg.norm(delta[:, tissue], axis=1).max()
    return float(largest / scale) if scale > 0 else 0.0, delta


def next_order(model: Model) -> Model:
    """The same cells with elements of the next order. Collective."""
    tissue = model.scene.tissue.model_copy(update={"order": model.scene.tissue.order + 1})
    return build(
        model.scene.model_copy(update={"tissue": tissue}), comm=model.system.layout.comm, mesh=model.space.mesh
    )


def next_unknowns(model: Model) -> int:
    """About how many unknowns the next order has."""
    order, layout = model.scene.tissue.order, model.system.layout
    return int(layout.n_e * ((order + 1) / order) ** layout.dimension)


def comparison(scene: Scene, tolerance: float) -> Scene:
    """The scene on a graded mesh of quadratic elements or better, on that of a mesh file of the next order."""
    tissue = scene.tissue
    refine = Refine(tolerance=tolerance, most=MOST_COMPARED)
    order = tissue.order + 1 if tissue.size is None else max(2, tissue.order)
    tissue = tissue.model_copy(update={"order": order, "refine": refine})
    return scene.model_copy(update={"tissue": tissue})


def zone_shift(model: Model) -> float:
    """Largest distance of the ends of the zone held from the faces of ``contact.box`` inside the body [m]. Collective.

    Facets count by their midpoints, so that a zone may end half a cell beyond or short of the box.
    """
    mesh, box, comm = model.space.mesh, model.scene.contact.box, model.system.layout.comm
    if box is None:
        return 0.0
    facets = contact_facets(mesh, model.scene.contact)
    mesh.mesh.topology.create_connectivity(mesh.dimension - 1, mesh.dimension)
    nodes = dolfinx.mesh.entities_to_geometry(mesh.mesh, mesh.dimension - 1, facets).ravel()
    x = mesh.mesh.geometry.x[:, : mesh.dimension]
    held, body = bounding_box(comm, x[nodes]), bounding_box(comm, x)
    slack = 1e-9 * (body[1] - body[0])
    low, high = (np.asarray(corner) for corner in box)
    below = np.where(low > body[0] + slack, np.abs(held[0] - low), 0.0)
    above = np.where(high < body[1] - slack, np.abs(held[1] - high), 0.0)
    ends = np.maximum(below, above)
    return float(ends[ends > slack].max(initial=0.0))
