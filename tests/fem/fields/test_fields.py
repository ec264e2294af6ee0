"""Fields on the whole body, their files, and the copies on rank 0."""

from __future__ import annotations

import softgrasp.fem  # noqa: F401

# isort: split
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.fields.picture import gather_picture, vertex_displacement
from softgrasp.fem.fields.series import SeriesWriter
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.scene.scene import Scene

EXACT = 1e-14  # coordinates of order 1 times rounding


def make_model(
    comm: MPI.Intracomm, d: int, order: int, rotation: bool = True, finite_strain: Any = None, **extra: Any
) -> Model:
    size, cells = ([1.0, 2.0], [3, 6]) if d == 2 else ([1.0, 0.5, 2.0], [2, 2, 4])
    top = 1.4
    tissue = {"size": size, "cells": cells, "order": order, "material": {"young": 10.0, "poisson": 0.3, "rho": 1.0}}
    tissue.update(extra)
    scene = Scene.model_validate(
        {
            "name": "test",
            "tissue": tissue,
            "contact": {"sides": ["left", "right"], "box": [[0.0] * (d - 1) + [top], size]},
            "hand": {"mass": 1.0, "inertia": 1.0, "reference": [0.2] * d},
            "effects": {"rotation": rotation} | ({"finite_strain": finite_strain} if finite_strain else {}),
            "time": {"steps": 2, "end": 1.0},
        }
    )
    return build(scene, comm=comm)


def hand_of(d: int) -> np.ndarray:
    return np.array([0.3, -0.2, 0.1] if d == 2 else [0.3, -0.2, 0.5, 0.02, -0.03, 0.1])


def turned(points: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Translation and small rotation about (0.2, ...), written down without the code under test."""
    d = points.shape[1]
    r = points - 0.2
    if d == 2:
        return q[:2] + q[2] * np.stack([-r[:, 1], r[:, 0]], axis=1)
    return q[:3] + np.cross(q[3:], r)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("d", [2, 3])
def test_rigid_move_is_exact_at_every_vertex(comm: MPI.Intracomm, d: int, order: int) -> None:
    model, q = make_model(comm, d, order), hand_of(d)
    z = np.zeros(model.system.layout.n_local)
    picture, u = gather_picture(model), vertex_displacement(model, z, q)
    assert (picture is None) == (u is None) == (comm.rank > 0)
    if picture is not None:
        np.testing.assert_allclose(u, turned(picture.points, q), atol=EXACT)
        np.testing.assert_allclose(picture.rigid(q), turned(picture.points, q), atol=EXACT)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("d", [2, 3])
def test_relative_field_lands_on_its_nodes(comm: MPI.Intracomm, d: int, order: int) -> None:
    """z is a function of the coordinates, so each vertex shows whether it got its own value."""
    model, q = make_model(comm, d, order), np.zeros(len(hand_of(d)))
    nodes = model.system.layout.nodes
    z = np.stack([(1 + nodes.sum(axis=1)) * (i + 1) for i in range(d)], axis=1).ravel()
    two = vertex_displacement(model, np.stack([z, -3 * z], axis=1), np.stack([q, q], axis=1))
    picture = gather_picture(model)
    if picture is not None and two is not None:
        expected = (1 + picture.points.sum(axis=1))[:, None] * np.arange(1, d + 1)
        expected[np.unique(picture.contact)] = 0.0
        np.testing.assert_allclose(two[0], expected, atol=EXACT)
        np.testing.assert_allclose(two[1], -3 * expected, atol=3 * EXACT)


@pytest.mark.ranks
@pytest.mark.parametrize("d", [2, 3])
def test_picture_has_the_whole_body_once(comm: MPI.Intracomm, d: int) -> None:
    picture = gather_picture(make_model(comm, d, 1))
    if picture is None:
        return
    corners = picture.points[picture.cells]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / (2 if d == 2 else 6)
    size = np.array([1.0, 2.0] if d == 2 else [1.0, 0.5, 2.0])
    assert volume.sum() == pytest.approx(np.prod(size), abs=1e-13)  # rounding of a hundred sums
    assert len(np.unique(picture.points.round(9), axis=0)) == len(picture.points)
    # Outward facets: the divergence theorem gives the volume with its sign.
    x = picture.points[picture.facets]
    if d == 2:
        area = x[:, 1] - x[:, 0]
        normals = np.stack([area[:, 1], -area[:, 0]], axis=1)
    else:
        normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) / 2
    assert (x.mean(axis=1) * normals).sum() / d == pytest.approx(np.prod(size), abs=1e-13)  # as above
    held = picture.points[picture.contact]
    assert np.isin(held[..., 0], [0.0, 1.0]).all()
    assert held[..., -1].min() >= 1.3  # facets whose midpoint is above 1.4, of side 1/3 or 1/2
    assert len(held) == (2 * 2 if d == 2 else 2 * 2 * 2 * 1)


def test_picture_knows_the_layers(comm: MPI.Intracomm) -> None:
    skin = {"box": [[0.0, 0.0], [1.0, 1.0]], "material": {"young": 20.0, "poisson": 0.3, "rho": 1.0}}
    picture = gather_picture(make_model(comm, 2, 1, layers={"skin": skin}))
    if picture is not None:
        height = picture.points[picture.cells][..., 1].mean(axis=1)
        assert picture.names == ("skin", "tissue")
        np.testing.assert_array_equal(picture.layers, (height > 1.0).astype(int))


@pytest.mark.ranks
def test_full_field_updates_ghosts(comm: MPI.Intracomm) -> None:
    model, q = make_model(comm, 2, 2), hand_of(2)
    u = model.displacement(np.zeros(model.system.layout.n_local), q)
    everywhere = model.space.V.tabulate_dof_coordinates()[:, :2]
    np.testing.assert_allclose(u.x.array.reshape(-1, 2), turned(everywhere, q), atol=EXACT)


def test_nothing_written_names_no_file(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    assert SeriesWriter(make_model(comm, 2, 1), mpi_tmp_path).close() == ()
