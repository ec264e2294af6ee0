"""Tables of a motion over time, read from a CSV file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.text import read_table

FIXED, TURNING, POSE = 3, 6, 7  # values in a row in 3D: displacement; and angles; place and quaternion
NORM = 1e-3  # deviation of a quaternion's norm from one that digits of a file explain; a wrong column is further off


def read_motion(scene: Scene, n_s: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Times (m,) [s] and motion of the hand or force on it, (m, n_s) [m, rad; N, N m], from ``motion.csv``.

    In 3D with ``effects.rotation`` a row may be a pose: place x, y, z of the hand's reference point and quaternion
    w, x, y, z. The motion is that from the pose of the first row.

    Raises SceneError: the file does not fit.
    """
    name = scene.motion.csv or ""
    moved = scene.motion.drive == "motion"
    posed = n_s == TURNING and moved
    poses = ", or x, y, z and a quaternion w, x, y, z" if posed else "; poses need effects.rotation = true"
    times, values = read_csv(
        scene.directory / name, n_s, scene.time_end, also=POSE if posed else None,
        meaning="one per hand degree of freedom" + poses * (posed or (moved and n_s == FIXED)),
    )  # fmt: skip
    if values.shape[1] == n_s:
        return times, values
    return times, _from_poses(values, f"motion.csv: {scene.directory / name}", scene.effects.frame is not None)


def _from_poses(poses: NDArray[Any], name: str, onward: bool) -> NDArray[Any]:
    """Displacement and rotation vector (m, 6) [m, rad] from the first of the poses (m, 7).

    ``onward``: a rotation vector is the one nearest to the row before, of more than half a turn too.
    """
    from scipy.spatial.transform import Rotation  # poses alone pay for it

    norms = np.linalg.norm(poses[:, 3:], axis=1)
    worst = int(np.argmax(np.abs(norms - 1)))
    if abs(norms[worst] - 1) > NORM:
        raise SceneError(
            f"{name} has a quaternion of norm {norms[worst]:.4g} in data row {worst + 1}; it must be 1, in the order "
            "w, x, y, z"
        )
    turns = Rotation.from_quat(poses[:, [4, 5, 6, 3]])
    angles = (turns * turns[0].inv()).as_rotvec()
    if onward:
        from softgrasp.fem.frame.rotation import rotation_matrix, rotation_vector  # such scenes alone pay for it

        for i in range(1, len(angles)):
            angles[i] = rotation_vector(rotation_matrix(angles[i]), angles[i - 1])
            if np.linalg.norm(angles[i] - angles[i - 1]) > np.pi:
                raise SceneError(
                    f"{name} turns the hand too far from data row {i} to {i + 1}, or past a whole turn about another "
                    "axis; give more rows, or displacements and rotation vectors"
                )
    return np.hstack([poses[:, :3] - poses[0, :3], angles])


def read_csv(
    path: Path,
    columns: int,
    end: float | None = None,
    key: str = "motion.csv",
    meaning: str = "one per hand degree of freedom",
    also: int | None = None,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read times (steps,) and values (steps, columns or also) of a trajectory.

    Args:
        columns: values in a row beside the time.
        end: of the run [s]; None: the time of the last row.
        key: who names the file, for the messages.
        meaning: what the columns are, for the messages.
        also: another number of values in a row that is accepted.

    Raises SceneError: the file is missing, not numeric, not increasing in time or does not cover [0, end].
    """
    try:
        table = np.array(read_table(path, *(1 + count for count in (columns, also) if count is not None)))
    except OSError as error:
        raise SceneError(f"{key}: {path} cannot be read ({error.strerror}); name an existing CSV file") from error
    except ValueError as error:
        raise SceneError(f"{key}: {path} {error} (time, then {meaning})") from error
    if len(table) < 2:
        raise SceneError(f"{key}: {path} has {len(table)} rows of numbers; it must have at least two")
    if (np.diff(table[:, 0]) <= 0).any():
        raise SceneError(f"{key}: the times in {path} must increase from row to row")
    if end is None and table[0, 0] != 0:
        raise SceneError(f"{key}: the times in {path} must begin at 0, not at {table[0, 0]:g} s")
    if end is not None and (table[0, 0] > 0 or table[-1, 0] < end * (1 - 1e-12)):
        raise SceneError(f"{key}: {path} covers {table[0, 0]:g} to {table[-1, 0]:g} s, the run needs 0 to {end:g} s")
    return table[:, 0], table[:, 1:]
