"""A DOLFINx mesh of the user's own against the same mesh as the program makes it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import basix.ufl
import dolfinx.fem
import dolfinx.mesh
import numpy as np
import pytest
import ufl
from mpi4py import MPI

from softgrasp.fem.accuracy.adapt import build
from softgrasp.fem.errors import MeshError
from softgrasp.fem.run.simulate import simulate

GIVEN = {"mesh": "given", "size": False, "cells": False}
SHORT = ["time.steps=40"]
SOFT = {"material": {"lambda": 50.0, "mu": 9.0, "rho": 2.0}}


def rectangle(comm: MPI.Intracomm, **kind: Any) -> dolfinx.mesh.Mesh:
    return dolfinx.mesh.create_rectangle(comm, [[0.0, 0.0], [1.0, 2.0]], [4, 8], **kind)


def tagged(comm: MPI.Intracomm) -> Any:
    """A mesh as Gmsh's reader returns it: the lower half is "low", tag 3, and the upper half of the sides 7."""
    mesh = rectangle(comm)
    for pair in ((1, 2), (2, 1), (2, 2)):
        mesh.topology.create_connectivity(*pair)
    low = dolfinx.mesh.locate_entities(mesh, 2, lambda x: x[1] < 1 + 1e-9)
    sides = dolfinx.mesh.locate_entities_boundary(
        mesh, 1, lambda x: (np.isclose(x[0], 0) | np.isclose(x[0], 1)) & (x[1] > 1.5 - 1e-9)
    )
    tags = [
        dolfinx.mesh.meshtags(mesh, d, np.sort(found), np.full(len(found), value, dtype=np.int32))
        for d, found, value in ((2, low, 3), (1, sides, 7))
    ]
    return SimpleNamespace(mesh=mesh, cell_tags=tags[0], facet_tags=tags[1], physical_groups={"low": (2, 3)})


@pytest.mark.ranks
def test_a_given_mesh_gives_the_run_of_the_same_box(comm: MPI.Intracomm) -> None:
    mesh = rectangle(comm)
    box = build("paper_forward", SHORT, comm, tissue={"cells": [4, 8]})
    model = build("paper_forward", SHORT, comm, mesh=mesh)
    one, other = simulate(box), simulate(model)
    assert np.abs(one.outputs - other.outputs).max() < 1e-12  # the same matrices, perhaps in another order of rows
    z, _ = np.split(other.final, 2)
    u = model.displacement(z, other.q_s[-1])
    assert u.function_space.mesh is mesh
    area = dolfinx.fem.assemble_scalar(dolfinx.fem.form(ufl.div(u) * ufl.dx))
    assert np.isfinite(comm.allreduce(area))
    alone = build("paper_forward", SHORT, MPI.COMM_SELF, mesh=rectangle(MPI.COMM_SELF))
    assert model.scene_hash == alone.scene_hash != box.scene_hash


@pytest.mark.ranks
@pytest.mark.parametrize("name", [3, "low"])
def test_tags_name_layers_and_contact_zone(comm: MPI.Intracomm, name: int | str) -> None:
    layer = {"low": {"box": [[0.0, 0.0], [1.0, 1.0]], **SOFT}}
    box = build("paper_forward", SHORT, comm, tissue={"cells": [4, 8], "layers": layer})
    keys = {"tissue": {**GIVEN, "layers": {"low": {"tag": name, **SOFT}}}}
    keys["contact"] = {"facet_tag": 7, "sides": []}
    model = build("paper_forward", SHORT, comm, mesh=tagged(comm), **keys)
    one, other = simulate(box), simulate(model)
    assert np.abs(one.outputs - other.outputs).max() < 1e-12  # as above


@pytest.mark.ranks(2)
def test_a_given_mesh_is_refined_and_estimated(comm: MPI.Intracomm) -> None:
    keys = {"tissue": {**GIVEN, "refine": {"tolerance": 0.05}}, "contact": {"facet_tag": 7, "sides": []}}
    model = build("paper_forward", SHORT, comm, steps=False, mesh=tagged(comm), **keys)
    assert model.accuracy is not None
    assert model.accuracy.estimate <= 0.05
    coarse = build("paper_forward", SHORT, comm, tissue={"cells": [4, 8]})
    assert model.states > 2 * coarse.states


def broken(comm: MPI.Intracomm) -> Any:
    mesh = rectangle(comm)
    mesh.geometry.x[0, 0] = np.nan
    return mesh


def quadratic(comm: MPI.Intracomm) -> Any:
    points = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0.5], [0, 0.5], [0.5, 0]])
    element = basix.ufl.element("Lagrange", "triangle", 2, shape=(2,))
    return dolfinx.mesh.create_mesh(comm, np.arange(6).reshape(1, 6), ufl.Mesh(element), points)


def surface(comm: MPI.Intracomm) -> Any:
    points = np.array([[0, 0, 0.0], [1, 0, 0], [0, 1, 0]])
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    return dolfinx.mesh.create_mesh(comm, np.array([[0, 1, 2]]), ufl.Mesh(element), points)


REFUSED: list[tuple[Callable[[MPI.Intracomm], Any], str]] = [
    (
        lambda comm: rectangle(comm, cell_type=dolfinx.mesh.CellType.quadrilateral),
        "quadrilateral and order 1; give lin",
    ),
    (quadratic, "triangle and order 2; give linear triangles or tetrahedra"),
    (surface, "surface in space .gdim 3.; make a plane mesh with gdim = 2"),
    (broken, "The given mesh has 1 point with NaN or infinite coordinates"),
    (lambda comm: "mesh.msh", "mesh is a str; give a dolfinx.mesh.Mesh or"),
]


@pytest.mark.serial
@pytest.mark.parametrize(("make", "words"), REFUSED)
def test_other_meshes_are_refused(comm: MPI.Intracomm, make: Callable[[MPI.Intracomm], Any], words: str) -> None:
    with pytest.raises(MeshError, match=words):
        build("paper_forward", comm=comm, mesh=make(comm))


@pytest.mark.ranks(2)
def test_what_does_not_fit_the_mesh_is_refused_on_every_rank(comm: MPI.Intracomm) -> None:
    other = dolfinx.mesh.create_rectangle(comm, [[0.0, 0.0], [1.0, 2.0]], [2, 2])
    tags = dolfinx.mesh.meshtags(other, 2, np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32))
    with pytest.raises(MeshError, match="cell_tags are not of the cells of the given mesh"):
        build("paper_forward", comm=comm, mesh=rectangle(comm), cell_tags=tags)
    with pytest.raises(MeshError, match=r"tissue.scale = 0.1 and tissue.repair are for mesh files"):
        build("paper_forward", comm=comm, mesh=rectangle(comm), tissue=GIVEN | {"scale": 0.1})
    if comm.size > 1:
        with pytest.raises(MeshError, match="lies on other ranks than the model"):
            build("paper_forward", comm=comm, mesh=rectangle(MPI.COMM_SELF))


@pytest.mark.serial
def test_a_scene_of_a_given_mesh_alone_says_what_is_missing(comm: MPI.Intracomm) -> None:
    with pytest.raises(MeshError, match=r"'given' is a mesh that a program passes to softgrasp.build"):
        build("paper_forward", comm=comm, tissue=GIVEN)
