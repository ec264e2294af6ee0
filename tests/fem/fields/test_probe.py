"""Displacements at points of the body: exact for the fields that the elements hold, on every mesh and rank count."""

from __future__ import annotations

from typing import Any

import dolfinx.mesh
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.fields.probe import locate, make_probe
from softgrasp.fem.model.build import Model, build
from tests.helpers.models import Array, make_scene


def model_of(comm: MPI.Intracomm, order: int, cells: tuple[int, ...] = (3, 7)) -> Model:
    tissue: dict[str, Any] = {"cells": list(cells), "order": order}
    return build(make_scene({"tissue": tissue}), comm=comm)


def field(order: int, X: Array) -> Array:
    """A polynomial of the order of the elements, (k, 2)."""
    x, y = X.T
    value = 0.3 + 1.7 * x - 0.6 * y
    if order == 2:
        value = value + 2.1 * x * y - 0.9 * y**2 + x**2
    return np.column_stack([value, -value])


@pytest.mark.ranks
@pytest.mark.parametrize("order", [1, 2])
def test_probe_is_exact_for_polynomials_of_its_order(comm: MPI.Intracomm, order: int) -> None:
    model = model_of(comm, order)
    points = np.array([[0.437, 0.519], [1 / 3, 2 / 7], [0.2, 0.1]])  # inside a cell, a node, anywhere
    probe = make_probe(model.space, (points[:1], points), False)
    value = probe.of_rows(comm, field(order, model.system.layout.nodes).ravel()[:, None])[:, 0]
    expected = np.concatenate([field(order, points[:1])[0], field(order, points).mean(axis=0)])
    # rounding of a dozen terms
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(probe.C_s, np.tile(np.eye(2), (2, 1)), rtol=0, atol=1e-14)


def test_points_outside_move_to_the_nearest_point_of_the_body(comm: MPI.Intracomm) -> None:
    model = model_of(comm, 2)
    points = np.array([[0.4, -0.1], [1.2, 0.7], [-0.3, -0.2], [0.5, 1.0]])
    _, values, where = locate(model.space, points)
    np.testing.assert_allclose(where, np.clip(points, [0, 0], [1, 2]), rtol=0, atol=1e-12)  # rounding
    np.testing.assert_allclose(values.sum(axis=1), 1.0, rtol=0, atol=1e-12)  # shape functions add up to one


def test_probe_reads_the_mesh_of_either_version_of_dolfinx(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """0.10 has one dofmap of the geometry, 0.11 a list of them."""
    model, point = model_of(comm, 1), np.array([[0.437, 0.519]])
    now = locate(model.space, point)
    one = model.space.mesh.mesh.geometry.dofmaps[0]
    monkeypatch.delattr(dolfinx.mesh.Geometry, "dofmaps")
    monkeypatch.setattr(dolfinx.mesh.Geometry, "dofmap", property(lambda _: one))
    for a, b in zip(now, locate(model.space, point), strict=True):
        np.testing.assert_array_equal(a, b)
