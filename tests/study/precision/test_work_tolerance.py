"""The promise of a tolerance, on three scenes: an independent run on a mesh of another kind finds no larger error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.fields.probe import make_probe
from softgrasp.fem.model.build import build
from softgrasp.fem.scene.file import load_scene_collective, shipped_scenes
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.precision import forward as wp_forward
from softgrasp.study.precision import full as wp_full
from softgrasp.study.precision import reduced as wp_reduced
from softgrasp.study.precision import reference as wp_reference
from softgrasp.study.precision import settings as wp_meshes
from softgrasp.study.precision.full import find_places, run_probed
from softgrasp.study.precision.points import Request
from softgrasp.study.precision.run import study_scene
from softgrasp.study.precision.settings import Setting, own_setting, variant
from tests.helpers.models import Array, graded_model

FORWARD = ("forward", "reduced")
EVEN = ("tissue.refine=false", "tissue.order=1")  # the scene's own mesh is a bad one
QUICK = ["study.repeats=1", "reduction.methods=['craig_bampton']", "reduction.N=[18, 24]"]


@dataclass(frozen=True)
class Case:
    """A scene with changes, the tolerance asked for, and the independent run.

    Attributes:
        scene: name.
        changes: arguments of ``--set``.
        tolerance: of the deformation.
        cells: of the independent run, P2, whose lines crowd where the contact zone ends.
        off: what that run may be off itself, from two finer ones.
    """

    scene: str
    changes: tuple[str, ...]
    tolerance: float
    cells: tuple[int, ...]
    off: float

    def load(self, comm: MPI.Intracomm) -> Scene:
        return load_scene_collective(comm, shipped_scenes()[self.scene], list(self.changes))


SMALL = [
    Case("paper_forward", ("tissue.cells=[4, 8]", "time.steps=60", *QUICK), 0.08, (16, 32), 0.004),
    Case("franka_muscle", (*EVEN, "tissue.cells=[4, 8]", "time.steps=60", *QUICK), 0.05, (16, 32), 0.004),
    Case("block_3d", (*EVEN, "tissue.cells=[2, 2, 4]", "time.steps=16", *QUICK), 0.2, (6, 6, 12), 0.05),
]
WHOLE = [
    Case("paper_forward", (), 2e-2, (32, 64), 0.001),
    Case("franka_muscle", (), 1e-2, (32, 64), 0.001),
    Case("block_3d", (*EVEN, "tissue.cells=[4, 4, 8]", "time.steps=100"), 0.1, (8, 8, 16), 0.03),
]


@pytest.fixture
def _few_samples() -> Iterator[None]:
    """The quick versions look at no time and at few solvers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp_forward, "CG_TOLERANCES", ())
        for d, work, finest in ((2, 5e5, 1e-3), (3, 1e5, 1e-1)):
            patch.setitem(wp_meshes.POINT_WORK, d, work)  # no large run, whatever the times say
            patch.setitem(wp_reference.FINEST, d, finest)
        patch.setitem(wp_meshes.GOALS, 3, {1: (), 2: (0.3, 0.1), 3: ()})
        patch.setattr(wp_forward, "SHARES", (2.0, 1.0, 0.5, 0.25))
        patch.setattr(wp_full, "BUILD_SECONDS", 0.0)
        patch.setattr(wp_reduced, "CALLS", 5)
        yield


def outputs(comm: MPI.Intracomm, scene: Scene, setting: Setting, graded: bool = False) -> Array:
    """Outputs against the hand at the places of the scene's own mesh, (steps + 1, p)."""
    own = build(variant(scene, own_setting(scene)), comm=comm)
    # the hand turns about one point on every mesh
    reference = own.system.layout.reference.tolist() if scene.effects.rotation else None
    changed = variant(scene, setting, reference=reference)
    model = graded_model(changed, comm) if graded else build(changed, comm=comm)
    return run_probed(model, make_probe(model.space, find_places(scene, own).points, scene.effects.rotation)).own


def check(comm: MPI.Intracomm, case: Case, folder: Path) -> dict[str, float]:
    """Ask, then measure the answer against a graded mesh with more steps than any run of the study."""
    scene = case.load(comm)
    study = study_scene(scene, comm, folder, Request(case.tolerance, names=FORWARD))
    answer, truth = study.answers[0], study.truth
    assert answer.met
    assert truth is not None
    assert answer.full is not None
    used, point = answer.full.point.setting, answer.full.point
    multiple = max(s.steps for s in truth.settings) // used.steps + 1
    values = outputs(comm, scene, used)
    exact = outputs(comm, scene, Setting(case.cells, 2, multiple * used.steps), graded=True)[::multiple]
    d = truth.series.dimension

    def length(y: Array) -> float:
        return float(np.linalg.norm(y.reshape(len(y), -1, d), axis=2).max())

    error = length(values - exact) / length(exact)
    assert error <= case.tolerance
    low, high = point.error_range
    assert low - case.off <= error <= high + case.off
    return {"asked": case.tolerance, "told": point.error, "true": error, "reference": truth.error}


def slow(case: Case) -> Any:
    return pytest.param(case, marks=pytest.mark.slow)


@pytest.mark.usefixtures("_few_samples")
@pytest.mark.parametrize("case", [slow(SMALL[0]), SMALL[1], slow(SMALL[2])], ids=lambda c: c.scene)
def test_tolerance_holds_on_small_scenes(comm: MPI.Intracomm, mpi_tmp_path: Path, case: Case) -> None:
    check(comm, case, mpi_tmp_path)


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("case", WHOLE, ids=lambda c: c.scene)
def test_tolerance_holds_on_whole_scenes(
    comm: MPI.Intracomm, mpi_tmp_path: Path, case: Case, record_property: pytest.RecordPropertyFixture
) -> None:
    for key, value in check(comm, case, mpi_tmp_path).items():
        record_property(key, value)
