"""Motions of the hand as poses: places and quaternions in a CSV file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial.transform import Rotation

import softgrasp as sg
from softgrasp.fem.errors import SceneError

KEYS: dict[str, Any] = {
    "tissue": {"cells": [2, 2, 2]},
    "effects": {"rotation": True},
    "hand": {"inertia": [0.01, 0.01, 0.01]},
    "motion": {"profile": "csv", "target": False, "duration": 1.0},
    "time": {"steps": 20, "end": 1.0, "start": "rest"},
}


def build(path: Path, comm: MPI.Intracomm, **motion: Any) -> sg.Model:
    keys = KEYS | {"motion": KEYS["motion"] | {"csv": str(path)} | motion}
    return sg.build("block_3d", comm=comm, **keys)


def save(path: Path, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", fmt="%.17g")
    return path


@pytest.mark.serial
def test_poses_are_the_motion_from_the_first(tmp_path: Path, comm: MPI.Intracomm) -> None:
    """Against a file of displacements and angles; the first pose is any, and a quaternion may have either sign."""
    t = np.linspace(0, 1, 9)
    s = t[:, None] ** 2 * (3 - 2 * t[:, None])
    q = s * [0.02, -0.01, 0.03, 0.04, -0.02, 0.05]
    first = Rotation.from_rotvec([0.3, -1.2, 0.7])
    quaternions = (Rotation.from_rotvec(q[:, 3:]) * first).as_quat(scalar_first=True)
    quaternions[3] *= -1
    angles = build(save(tmp_path / "angles.csv", t, q), comm)
    poses = build(save(tmp_path / "poses.csv", t, q[:, :3] + [0.5, 0.2, -0.1], quaternions), comm)
    one, other = sg.simulate(angles), sg.simulate(poses)
    assert np.abs(one.q_s).max() > 0.04
    assert np.abs(one.q_s - other.q_s).max() < 1e-13  # rounding of rotations of size one
    assert np.abs(one.outputs - other.outputs).max() < 1e-12


@pytest.mark.serial
@pytest.mark.parametrize(
    ("row", "words"),
    [
        ([0.0] * 7, "has a quaternion of norm 0 in data row 1; it must be 1, in the order w, x, y, z"),
        ([0.0, 0, 0, 5, 0, 0, 0], "has a quaternion of norm 5 in data row 1"),
        ([0.0] * 5, r"has 6 entries in data row 1; it must have 7 or 8 columns .time, then one per hand degree of "
                    r"freedom, or x, y, z and a quaternion w, x, y, z"),
    ],
)  # fmt: skip
def test_build_refuses_a_file_of_poses_that_does_not_fit(
    tmp_path: Path, comm: MPI.Intracomm, row: list[float], words: str
) -> None:
    with pytest.raises(SceneError, match=words):
        build(save(tmp_path / "poses.csv", np.array([0.0, 1.0]), np.tile(row, (2, 1))), comm)


@pytest.mark.serial
def test_forces_and_plane_hands_have_no_poses(tmp_path: Path, comm: MPI.Intracomm) -> None:
    path = save(tmp_path / "poses.csv", np.array([0.0, 1.0]), np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, 1)))
    with pytest.raises(SceneError, match="has 8 entries in data row 1; it must have 7 columns"):
        build(path, comm, drive="force")
    keys = {**KEYS, "effects": {"rotation": False}, "motion": KEYS["motion"] | {"csv": str(path)}}
    with pytest.raises(SceneError, match=r"4 columns .*; poses need effects.rotation = true"):
        sg.build("block_3d", comm=comm, **keys)
