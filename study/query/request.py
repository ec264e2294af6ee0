"""What a query asks: materials from ``--set`` or a table, the motion of the hand from the model or a CSV file."""

from __future__ import annotations

import csv
import difflib
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from softgrasp.fem import Profile, SceneError, free_memory, out_of_range, read_csv, read_text, shortened, size_text
from softgrasp.reduction import CertifiedModel, Drive, Materials
from softgrasp.reduction.certified.motion import FINER

KEYS = ("lambda", "mu", "rho")
ROUNDING = 1e-9  # of the time of a move
STEP_BYTES = 80  # of memory a step and mode while a run and the finer one are made: measured 60 to 70


def parse_settings(settings: Sequence[str]) -> dict[str, float]:
    """Numbers of ``--set lambda=77``. Raises SceneError: an unknown key, a key twice, or a value that is no number."""
    numbers: dict[str, float] = {}
    for text in settings:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals or key not in KEYS:
            near = difflib.get_close_matches(key, KEYS, n=1)
            hint = f"did you mean {near[0]}?" if near else "a query sets lambda, mu or rho, for example --set lambda=77"
            raise SceneError(f"--set {shortened(text)}: {hint}")
        if key in numbers:
            raise SceneError(
                f"--set {shortened(text)}: {key} is set twice; give one value, or many in a table with --batch"
            )
        numbers[key] = _number(value, f"--set {shortened(text)}")
    return numbers


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise SceneError(f"{where}: '{shortened(text)}' is not a number") from None
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
        names = shortened(", ".join(header)) or "nothing"
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


def drive_of(model: CertifiedModel, motion: Path | None = None, dt: float | None = None, runs: int = 1) -> Drive:
    """The motion that the model holds, or that of a CSV file, at any step: the tables that a full run would have.

    Args:
        model: its drive says whether a file holds positions, joined by a cubic spline at rest at both ends, or forces,
            joined by straight lines.
        motion: time, then one column a degree of freedom of the hand; None takes the model's own.
        dt: step [s], adjusted so that steps fill the time of the motion; None takes the model's own.
        runs: that are to be made with it.

    Raises SceneError: the file does not fit; dt is not positive, too long, or so short that the memory does not hold
        the runs; or the model contains no motion, or one without its time law.
    """
    own = model.drive
    if dt is not None and not (math.isfinite(dt) and dt > 0):
        raise SceneError(f"--dt {dt:g}: the time step must be a positive number of seconds")
    if own is None:
        raise SceneError("the model contains no motion; reduce its scene again")
    profile, M_hand = own.profile, model.fine.parts["M_hand"]
    if motion is not None:
        table = read_csv(motion, len(M_hand), key="--motion")
        kind: Literal["motion", "force"] = "motion" if own.force is None else "force"
        profile = Profile(kind, float(table[0][-1]), np.zeros(len(M_hand)), 1.0, table)
    if profile is None and dt is not None:
        raise SceneError(
            "--dt: the file of the model is of an earlier version and contains its motion at one step alone; "
            "reduce its scene again, or give the motion with --motion"
        )
    step, end = own.dt if dt is None else dt, own.dt * own.steps if profile is None else profile.end
    what = f"--dt {dt:g}" if dt is not None else "--batch" if motion is None else f"--motion {motion}"
    if dt is not None and dt > end * (1 + ROUNDING):
        raise SceneError(f"{what}: the step is longer than the whole move of {end:g} s; give less")
    if profile is not None and dt is not None and round(end / dt) < profile.fewest:
        raise SceneError(f"{what}: the step is too long for the move; give {end / profile.fewest:.3g} s or less")
    _check_memory(model, end / step, runs, f"{what}: {'a run' if runs == 1 else f'{runs} runs'} of {end:g} s")
    if profile is None or (motion is None and dt is None):
        return own
    return Drive.along(profile, max(1, round(end / step)), M_hand, own.start)


def _check_memory(model: CertifiedModel, steps: float, runs: int, what: str) -> None:
    """Refuse runs that the memory does not hold: one while it is made, all as they are kept."""
    need = STEP_BYTES * (FINER * model.k + model.k2) + runs * 8 * (2 * model.coarse.N)
    most = free_memory() / need
    if steps > most:
        raise SceneError(
            f"{what} in {steps:.3g} steps would need about {size_text(steps * need)} of memory, and "
            f"{size_text(most * need)} is free; use {most:.2g} steps or fewer, by a larger --dt"
        )
