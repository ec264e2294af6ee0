"""Tables of a motion over time, read from a CSV file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgrasp.fem.errors import SceneError
from softgrasp.fem.scene.text import read_table


def read_csv(
    path: Path,
    columns: int,
    end: float | None = None,
    key: str = "motion.csv",
    meaning: str = "one per hand degree of freedom",
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Read times (steps,) and values (steps, columns) of a trajectory.

    Args:
        columns: values in a row beside the time.
        end: of the run [s]; None: the time of the last row.
        key: who names the file, for the messages.
        meaning: what the columns are, for the messages.

    Raises SceneError: the file is missing, not numeric, not increasing in time or does not cover [0, end].
    """
    try:
        table = np.array(read_table(path, columns + 1))
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
