"""Traction of contact: an even pressure comes out even, at any order, and its integral is the force."""

from __future__ import annotations

import dolfinx.fem
import dolfinx.fem.petsc
import dolfinx.la
import numpy as np
import pytest
import ufl
from mpi4py import MPI

from softgrasp.fem.fields.traction import ContactTraction
from softgrasp.fem.model.build import build
from softgrasp.fem.model.surface import make_surface
from tests.helpers.models import make_scene

LOAD = 3.0  # [Pa], upwards on the lowest side
BOX = {"size": [1.0, 1.0, 0.5], "cells": [3, 2, 2]}


@pytest.mark.ranks(2)
@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("d", [2, 3])
def test_forces_of_an_even_pressure_give_it_back(comm: MPI.Intracomm, d: int, order: int) -> None:
    tissue = {"order": order, "thickness": 0.3} if d == 2 else {"order": order, **BOX}
    scene = make_scene({"tissue": tissue, "contact": {"sides": ["top"], "box": None}, "motion": {"target": [0.1] * d}})
    model = build(scene, comm=comm)
    space = model.space
    mesh, x = space.mesh.mesh, ufl.SpatialCoordinate(space.mesh.mesh)
    below = ufl.conditional(ufl.lt(x[d - 1], 1e-9), LOAD * scene.tissue.thickness, 0.0)
    up = dolfinx.fem.Constant(mesh, np.eye(d)[d - 1])
    form = dolfinx.fem.form(below * ufl.inner(up, ufl.TestFunction(space.V)) * ufl.ds)
    b = dolfinx.fem.assemble_vector(form)
    b.scatter_reverse(dolfinx.la.InsertMode.add)
    surface = make_surface(space, model.system)
    forces = surface.gather(b.array.reshape(-1, d)[space.free].ravel()).reshape(-1, d)
    traction = ContactTraction(model)(surface, forces)
    nodes = space.V.tabulate_dof_coordinates()[: len(traction), :d]
    expected = np.zeros((len(traction), d))
    expected[nodes[:, d - 1] < 1e-9, d - 1] = LOAD
    # rounding of sums over the facets around a vertex; on the sides only the corners of the bottom have any
    at = (nodes[:, d - 1] < 1e-9) | (nodes[:, d - 1] > (0.5 if d == 3 else 2.0) / 2 + 1e-9)
    assert np.abs(traction - expected)[at].max(initial=0.0) < 1e-12 * LOAD


@pytest.mark.serial
def test_an_edge_that_is_pressed_from_aside_takes_the_whole_area() -> None:
    model = build(make_scene({"contact": {"sides": ["top"], "box": None}}))
    surface = make_surface(model.space, model.system)
    forces = np.zeros_like(surface.X)
    corner = int(np.argmin(surface.X.sum(axis=1)))  # (0, 0): facets to the left and below
    forces[corner] = [-1.0, -1.0]  # which no facet there faces
    traction = ContactTraction(model)(surface, forces)
    dx, dy = np.array(model.scene.tissue.size) / model.scene.tissue.cells
    assert np.abs(traction).max() == pytest.approx(2 / (dx + dy), rel=1e-12)  # rounding
