"""The promise of a tolerance, on three scenes: an independent finer run finds no larger error than was asked for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from fem.build import build
from fem.scene import Scene
from fem.scene_file import load_scene_collective, shipped_scenes
from study import wp_forward, wp_full, wp_reduced
from study.work_precision import WorkStudy, study_scene
from study.wp_points import Asked, Setting, variant
from study.wp_probe import find_places, make_probe, run_probed
from study.wp_reduced import own_setting
from tests.helpers import Array

FORWARD = ("forward", "reduced")
QUICK = ["study.repeats=1", "reduction.methods=['craig_bampton']", "reduction.N=[18, 24]"]


@dataclass(frozen=True)
class Case:
    """A scene with changes, the tolerance asked for, and how much finer the independent run is.

    Attributes:
        scene: name.
        changes: arguments of ``--set``.
        tolerance: relative.
        cells: of the independent run, P2.
    """

    scene: str
    changes: tuple[str, ...]
    tolerance: float
    cells: tuple[int, ...]

    def load(self, comm: MPI.Intracomm) -> Scene:
        return load_scene_collective(comm, shipped_scenes()[self.scene], list(self.changes))


SMALL = [
    Case("paper_forward", ("tissue.cells=[4, 8]", "time.steps=60", *QUICK), 0.05, (12, 40)),
    Case("franka_muscle", ("tissue.cells=[4, 8]", "time.steps=60", *QUICK), 0.003, (12, 40)),
    Case("block_3d", ("tissue.cells=[2, 2, 4]", "time.steps=16", *QUICK), 0.005, (5, 5, 20)),
]
WHOLE = [
    Case("paper_forward", (), 1e-2, (80, 160)),
    Case("franka_muscle", (), 1e-3, (36, 80)),
    Case("block_3d", ("tissue.cells=[4, 4, 8]", "time.steps=100"), 2e-3, (6, 6, 20)),
]


@pytest.fixture
def _few_samples() -> Iterator[None]:
    """The quick versions look at no time and at few solvers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wp_forward, "CG_TOLERANCES", ())
        patch.setattr(wp_forward, "POINT_WORK", {2: 5e5, 3: 2e5})  # no large run, whatever the times say
        patch.setattr(wp_forward, "SHARES", (2.0, 1.0, 0.5, 0.25))
        patch.setattr(wp_full, "BUILD_SECONDS", 0.0)
        patch.setattr(wp_reduced, "CALLS", 5)
        yield


def outputs(comm: MPI.Intracomm, scene: Scene, setting: Setting, reference: list[float] | None) -> Array:
    """Displacements at the places of the scene's outputs, (steps + 1, p)."""
    own = build(variant(scene, own_setting(scene)), comm)
    model = build(variant(scene, setting, reference=reference), comm)
    return run_probed(model, make_probe(model, find_places(scene, own))).y


def finest(study: WorkStudy) -> tuple[tuple[int, ...], int]:
    """Most cells along each edge, and most steps, of any run of a study."""
    if study.reference is None:
        raise AssertionError("the study has no reference")
    runs = [*study.reference.settings, *(_setting(p.details) for p in study.points["forward"])]
    cells = np.array([s.cells for s in runs if s.cells])
    return tuple(cells.max(axis=0).tolist()), max(s.steps for s in runs)


def _setting(d: dict[str, object]) -> Setting:
    cells = d["cells"]
    if not isinstance(cells, list) or not isinstance(d["order"], int) or not isinstance(d["steps"], int):
        raise TypeError(f"no setting in {sorted(d)}")
    return Setting(tuple(cells), d["order"], d["steps"])


def check(comm: MPI.Intracomm, case: Case, folder: Path) -> dict[str, float]:
    """Ask, then measure the answer against a run with a finer mesh and more steps than any that the study made."""
    scene = case.load(comm)
    study = study_scene(scene, comm, folder, Asked(case.tolerance, names=FORWARD))
    answer = study.answers[0]
    assert answer.met
    used = _setting(answer.found["full"]["setting"])
    widest, most = finest(study)
    assert all(a > b for a, b in zip(case.cells, widest, strict=True)), widest
    multiple = most // used.steps + 1
    # the hand turns about one point on every mesh
    own = build(variant(scene, own_setting(scene)), comm).system.layout.reference.tolist()
    reference = own if scene.effects.rotation else None
    found = outputs(comm, scene, used, reference)
    truth = outputs(comm, scene, Setting(case.cells, 2, multiple * used.steps), reference)[::multiple]
    d = study.reference.series.dimension if study.reference is not None else 2

    def length(y: Array) -> float:
        return float(np.linalg.norm(y.reshape(len(y), -1, d), axis=2).max())

    error = length(found - truth) / length(truth)
    assert error <= case.tolerance
    told = answer.found["full"]["measured"]["error"]
    own_error = study.reference.error if study.reference is not None else 0.0
    # the corners of the contact zone leave order one in space, also to the independent run
    rest = told * max(a / b for a, b in zip(used.cells or (), case.cells, strict=True))
    # what was told differs by the errors of both references; an estimate may be half of the true one
    assert abs(error - told) <= 2 * own_error + rest
    return {"asked": case.tolerance, "told": told, "true": error, "reference": own_error, "steps": used.steps}


@pytest.mark.usefixtures("_few_samples")
@pytest.mark.parametrize("case", SMALL, ids=lambda c: c.scene)
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
