"""What a query asks: materials from ``--set`` or a table, the motion of the hand from the model or a CSV file."""

from __future__ import annotations

import csv
import difflib
import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from softgrasp.fem.errors import SceneError
from softgrasp.fem.petsc import Array
from softgrasp.fem.run.motion import read_csv
from softgrasp.fem.scene.text import out_of_range, read_text
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import Drive, Materials

KEYS = ("lambda", "mu", "rho")
FINER = 8  # steps for one, of the runs that tell the error of the step
ROUNDING = 1e-9  # of the time of a move
MOST = 1_000_000  # steps of a run, which stands in memory as a whole


def parse_settings(settings: Sequence[str]) -> dict[str, float]:
    """Numbers of ``--set lambda=77``. Raises SceneError: an unknown key, a key twice, or a value that is no number."""
    numbers: dict[str, float] = {}
    for text in settings:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or key not in KEYS:
            near = difflib.get_close_matches(key, KEYS, n=1)
            hint = f"did you mean {near[0]}?" if near else "a query sets lambda, mu or rho, for example --set lambda=77"
            raise SceneError(f"--set {text}: {hint}")
        if key in numbers:
            raise SceneError(f"--set {text}: {key} is set twice; give one value, or many in a table with --batch")
        numbers[key] = _number(value, f"--set {text}")
    return numbers


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise SceneError(f"{where}: '{text}' is not a number") from None
    if not math.isfinite(value) or out_of_range(value):
        raise SceneError(f"{where}: give a finite number between 1e-50 and 1e50")
    return value


def read_batch(path: Path) -> list[dict[str, float]]:
    """Rows of a CSV table whose first line names lambda, mu, rho or some of them. Raises SceneError: no such table."""
    try:
        lines = [row for row in csv.reader(io.StringIO(read_text(path))) if row]
    except OSError as error:
        raise SceneError(f"--batch {path}: cannot be read ({error.strerror}); name an existing CSV file") from error
    except (ValueError, csv.Error) as error:
        raise SceneError(f"--batch {path}: {error}") from error
    header = [name.split("[")[0].strip() for name in lines[0]] if lines else []
    if not header or set(header) - set(KEYS) or len(set(header)) < len(header):
        names = ", ".join(header) or "nothing"
        raise SceneError(f"--batch {path}: the first line must name columns (lambda, mu, rho or some); it has {names}")
    rows = []
    for i, line in enumerate(lines[1:], 1):
        if len(line) != len(header):
            raise SceneError(f"--batch {path}: row {i} has {len(line)} entries; it must have {len(header)}")
        rows.append({key: _number(x.strip(), f"--batch {path}: row {i}") for key, x in zip(header, line, strict=True)})
    if not rows:
        raise SceneError(f"--batch {path}: it has no row of numbers below its first line")
    return rows


def materials_of(model: CertifiedModel, setting: dict[str, float]) -> Materials:
    """Materials with these numbers in the first layer; what is not set is as in the model.

    Raises SceneError: mu, rho or the bulk stiffness is not positive.
    """
    own = model.fine.materials[0]
    lam, mu, rho = (setting.get(key, value) for key, value in zip(KEYS, (own.lam, own.mu, own.rho), strict=True))
    for key, value in (("mu", mu), ("rho", rho)):
        if value <= 0:
            raise SceneError(f"{key} = {value:g} must be positive")
    least = -2 * mu / model.norms.dimension
    if lam <= least:
        raise SceneError(
            f"lambda = {lam:g} Pa must be above {least:g} Pa, else a material with mu = {mu:g} Pa collapses"
        )
    return model.materials(lam, mu, rho)


def drive_of(model: CertifiedModel, motion: Path | None = None, dt: float | None = None) -> Drive:
    """The motion that the model holds, or that of a CSV file, at any step.

    Args:
        model: its drive says whether a file holds positions, joined by a cubic spline at rest at both ends, or forces,
            joined by straight lines.
        motion: time, then one column a degree of freedom of the hand; None takes the model's own.
        dt: step [s], adjusted so that steps fill the time of the motion; None takes the model's own.

    Raises SceneError: the file does not fit, dt is not positive or too small, or the model holds no motion.
    """
    own = model.drive
    if dt is not None and not (math.isfinite(dt) and dt > 0):
        raise SceneError(f"--dt {dt:g}: the time step must be a positive number of seconds")
    if own is None:
        raise SceneError("the model holds no motion; reduce its scene again")
    if motion is None and dt is None:
        return own
    times, columns, rates, end = _table(model, own, motion)
    if dt is not None and dt > end * (1 + ROUNDING):
        raise SceneError(f"--dt {dt:g}: the step is longer than the whole move of {end:g} s; give less")
    if dt is not None and end > MOST * dt:
        raise SceneError(f"--dt {dt:g}: a run of {end:g} s takes at most {MOST} steps; give {end / MOST:.3g} s or more")
    steps = max(1, round(end / (dt or own.dt)))

    def at(count: int) -> Drive:
        step = end / count
        if own.force is not None:
            middles = step * (np.arange(count) + 0.5)
            force = np.stack([np.interp(middles, times, column) for column in columns.T], axis=1)
            return replace(own, dt=step, force=force, finer=None)
        grid = step * np.arange(count + 1)
        spline: Any = CubicSpline(times, columns, bc_type="clamped")
        if rates is not None:
            spline = CubicHermiteSpline(times, columns, rates)
        return replace(own, dt=step, hand=(spline(grid), spline(grid, 1)), finer=None)

    return replace(at(steps), finer=at(FINER * steps))


def _table(model: CertifiedModel, own: Drive, motion: Path | None) -> tuple[Array, Array, Array | None, float]:
    """Times, positions or forces, velocities where they are known, and the end [s]."""
    if motion is not None:
        times, columns = read_csv(motion, len(model.fine.parts["M_hand"]), key="--motion")
        return times, columns, None, float(times[-1])
    finest = own.finer or own
    end = finest.dt * finest.steps
    if finest.force is not None:
        return np.asarray(finest.dt * (np.arange(finest.steps) + 0.5), dtype=float), finest.force, None, end
    assert finest.hand is not None
    q, v = finest.hand
    return np.asarray(finest.dt * np.arange(len(q)), dtype=float), q, v, end
