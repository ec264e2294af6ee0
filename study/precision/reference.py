"""The solution that all settings are compared with, and its own error.

    y* = y(m, 4 S) + (y(m, 4 S) - y(m, 2 S)) / 3 + y(M, s) - y(m, s)

with the scene's steps S, few steps s, a-priori graded meshes of falling tolerances down to M, and one of them, m, on
which time is refined by the order 2 of the midpoint rule: both at once would cost the product. With changes d1, d2 of
the solution to the last two meshes and q = d2 / d1 the error estimate adds up

    space: d2 q / (1 - q), what is left of errors that fall like q^k; q = 1 / growth of n_e where d1 is not there
    time:  the second term of y* itself
    mixed: the change of y through the steps on m, times that through the mesh, both relative.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from softgrasp.fem import Scene, SceneError
from softgrasp.study.precision.full import FullRuns, Series, TimedRun, largest, relative
from softgrasp.study.precision.result import ReferenceSolution
from softgrasp.study.precision.settings import Setting, contraction, edges, few_steps, fits
from softgrasp.study.report import percent

ORDER = 3  # of the elements
LADDER = tuple(round(a * 10.0**-k, 12) for k in range(1, 7) for a in (3.0, 1.0))  # tolerances of the meshes
FINEST = {2: 1e-4, 3: 3e-3}  # of them, without a tolerance to answer for
ROOM = 0.1  # of that tolerance
WORK = {2: 1e7, 3: 6e6}  # unknowns times steps of the finest run: some seconds on a quiet core
LARGEST = {2: 60_000, 3: 60_000}  # unknowns
TIME_WORK = {2: 8e6, 3: 2e6}  # unknowns times steps of the run behind the time part
GROWTH = 1.6  # of unknowns from mesh to mesh, expected at least
LEAST = 1.4  # and below this a mesh brings no more than the one before
ROUGH = 0.05  # error of a reference that is worth a warning
STILL = 1e-12  # of the displacement: an output that moves less against the hand moves with it


def make_reference(runs: FullRuns, tolerance: float | None = None) -> ReferenceSolution:
    """Run graded meshes until the finest is good enough or too large for the next, then more steps. Collective.

    Raises:
        SolverError: a run failed.
        SceneError: the outputs move with the hand, so that there is no deformation to measure.
    """
    scene, d = runs.scene, runs.dimension
    few, base = few_steps(scene), scene.time.steps
    aim = FINEST[d] if tolerance is None else min(FINEST[d], ROOM * tolerance)
    meshes: dict[Setting, TimedRun] = {}
    for goal in LADDER:
        setting = Setting(None, ORDER, few, refine=goal)
        sizes = [r.n_e for r in meshes.values()]
        growth = max(GROWTH, sizes[-1] / sizes[-2]) if d == 2 and len(sizes) > 1 else GROWTH  # in 3D some change little
        if sizes and (growth * sizes[-1] > LARGEST[d] or growth * sizes[-1] * few > WORK[d]):
            break
        run = runs.run(setting, 1)
        if not sizes or run.n_e > LEAST * sizes[-1]:
            meshes[setting] = run
        if goal <= aim and setting in meshes:
            break
    fit = [s for s, r in meshes.items() if r.n_e * 4 * base <= TIME_WORK[d]]
    middle = (fit or list(meshes))[-1 if fit else 0]
    late = [runs.run(replace(middle, steps=k * base), 1) for k in (2, 4)]
    return combine(scene, meshes, middle, *late)


def combine(
    scene: Scene, meshes: dict[Setting, TimedRun], middle: Setting, half: TimedRun, fine: TimedRun
) -> ReferenceSolution:
    """y* and its error estimate: runs with few steps on meshes, coarse to fine, and two with more on the middle one.

    Raises:
        SceneError: the outputs move with the hand.
    """
    d, t, few = fine.dimension, fine.times, meshes[middle].times
    *_, last = values = [r.values for r in meshes.values()]
    coarse = meshes[middle].values
    time_part = (fine.values - half.series.at(t)) / 3
    total = fine.values + time_part + Series(few, last - coarse, d).at(t)
    scale = largest(total, d)
    if not scale[0] > STILL * max(scale[1], 1e-300):
        raise SceneError(
            "control.outputs: no output moves against the hand, so that no error of a deformation can be "
            "measured; name a point of the tissue, in a scene that moves"
        )

    changes = [relative(b - a, scale, d) for a, b in pairwise(values)] or [(1.0, 1.0)]
    sizes = [r.n_e for r in meshes.values()]
    q = contraction([change[0] for change in changes], sizes[-1] / sizes[-2] if len(sizes) > 1 else 1.0)
    steps, mesh = (relative(v - coarse, scale, d) for v in (fine.series.at(few), last))
    truth = ReferenceSolution(
        Series(t, total, d),
        space=tuple(c * q / (1 - q) for c in changes[-1]),  # type: ignore[arg-type]
        time=relative(time_part, scale, d),
        mixed=tuple(float(np.prod(pair)) for pair in zip(steps, mesh, strict=True)),  # type: ignore[arg-type]
        settings=(*meshes, replace(middle, steps=half.steps), replace(middle, steps=fine.steps)),
        note="",
    )
    return replace(truth, note=_note(scene, list(meshes.items()), middle, fine.steps, truth))


def _note(
    scene: Scene, meshes: list[tuple[Setting, TimedRun]], middle: Setting, steps: int, truth: ReferenceSolution
) -> str:
    """What the reference is built from, how good it is, and what is wrong with it."""
    setting, run = meshes[-1]
    words = (
        f"Reference: {len(meshes)} graded meshes down to {setting.mesh} with {run.n_e} unknowns; in time {steps} steps "
        f"on {middle.mesh}. Its own relative error of the deformation is estimated as {percent(truth.error)} "
        f"(displacement {percent(truth.error_displacement)}); the measured errors may be wrong by as much either way."
    )
    if truth.error > ROUGH:
        words += f" That is too much to judge by: most of it is the {truth.largest_part} part, and would need "
        words += f"{truth.need}."
    even = scene.tissue.refine is None
    if even and not all(fits(n, shares) for n, shares in zip(scene.tissue.cells or (), edges(scene), strict=False)):
        words += " The scene's own mesh has no lines at the ends of its contact zone or layers, which adds error."
    return words
