"""Bases and errors on graded meshes, whose nodes crowd where nothing moves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import times_columns, total
from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction.errors import row_weights
from softgrasp.reduction.reduce import errors, reduce, replay
from tests.helpers.models import make_scene

GRADED = {"order": 2, "refine": {"tolerance": 0.02, "passes": 0}}


@pytest.mark.parametrize("method", ["psd_fixed", "psd_svd_like", "craig_bampton"])
def test_errors_do_not_see_where_nodes_crowd(comm: MPI.Intracomm, method: str) -> None:
    """The same errors in the energy product, which is what a graded mesh takes."""
    found: dict[str, list[float]] = {}
    inner: dict[str, Any] = {"even": None if method == "craig_bampton" else "energy", "graded": None}
    tissues: dict[str, dict[str, Any]] = {"even": {"order": 2, "cells": [8, 16]}, "graded": GRADED}
    for name, tissue in tissues.items():
        model = build(make_scene({"tissue": tissue}), comm=comm)
        run = simulate(model)
        rom = reduce(model, run, method, 14, inner=inner[name])
        e = errors(rom, replay(rom, model, run), model, run)
        found[name] = [e.error, e.error_canonical, e.error_deformation, e.error_energy]
    # the modes are those of another mesh; Euclidean products gave 0.17 and 5.4 of the deformation on the paper's scene
    assert found["graded"] == pytest.approx(found["even"], rel=0.5)


def test_weights_make_a_mass_norm(comm: MPI.Intracomm) -> None:
    """v'Mv lies between bounds times v'dv that hold for every mesh of these elements [W87]; Euclidean ones do not."""
    system = build(make_scene({"tissue": GRADED}), comm=comm).system
    assert system.graded
    weights = row_weights(system)[0]
    rng = np.random.default_rng(comm.rank)
    V = rng.standard_normal((system.layout.n_local, 20)) / rng.uniform(0.01, 1.0, (system.layout.n_local, 1))
    mass = total(comm, np.einsum("ij,ij->j", V, times_columns(system.M_ee, V)))
    found = mass / total(comm, ((weights * V) ** 2).sum(axis=0))
    assert found.min() > 0.3  # eigenvalues of the scaled mass of a quadratic triangle: 0.39 to 2.06
    assert found.max() < 2.1
    even = build(make_scene(), comm=comm).system
    assert not even.graded
    assert row_weights(even)[0].tolist() == [[1.0]]
