"""Feedback and restarts on graded meshes, whose stiffness spans more decades than that of even ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import Interrupted, MeshError, SceneError
from softgrasp.fem.mesh.grading import bisect
from softgrasp.fem.mesh.tissue_mesh import structured_mesh
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.refined import marked
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.feedback import check
from softgrasp.lqr.riccati import solve
from tests.helpers.models import make_scene

GRADED = ["tissue.order=2", "tissue.refine={tolerance=0.03,passes=0}"]


def test_riccati_equation_takes_no_more_solves(comm: MPI.Intracomm) -> None:
    plant = check(build(load_scene("paper_lqr", GRADED), comm=comm))[0]
    solution = solve(plant, "newton_adi", 1e-10)
    assert solution.counts["solves"] <= 60
    assert solution.residual <= 1e-10


def test_restart_on_a_graded_mesh_is_bitwise(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    def model() -> Model:
        return build(load_scene("paper_forward", [*GRADED, "time.steps=20"]), comm=comm)

    whole = simulate(model())
    with pytest.raises(Interrupted):
        simulate(model(), RunOptions(directory=mpi_tmp_path, until=7))
    rest = simulate(model(), RunOptions(directory=mpi_tmp_path, resume=True))
    assert np.array_equal(whole.final, rest.final)


@pytest.mark.serial
def test_cells_that_would_be_flat_are_named() -> None:
    """A needle of 1e-13 of its length: its children are flat to rounding."""
    scene = make_scene({"tissue": {"size": [1.0, 1e-13], "cells": [1, 1]}, "contact": {"sides": ["left"], "box": None}})
    whole = marked(structured_mesh(MPI.COMM_SELF, [1.0, 1e-13], [1, 1]), scene)
    with pytest.raises(MeshError, match=r"cannot be bisected further: .* would be flat, the worst around"):
        bisect(whole, np.arange(2, dtype=np.int32))


@pytest.mark.serial
def test_tolerance_below_rounding_is_refused() -> None:
    with pytest.raises(SceneError, match=r"below 1e-09 rounding decides"):
        load_scene("paper_forward", ["tissue.refine={tolerance=1e-12}"])
