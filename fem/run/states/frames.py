"""What is kept of a run: the steps of its pictures, and the rows of its outputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softgrasp.fem.model.outputs import Output
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.scene import Scene

FRAMES, LIGHT, FEWEST = 60, 100_000, 10  # frames up to LIGHT unknowns, these unknowns, fewest frames beyond [1]


def frame_count(scene: Scene, n_e: int) -> int:
    """Number of intervals between frames: ``output.frames``, or `FRAMES` to `LIGHT` unknowns, beyond like 1 / n_e."""
    frames = scene.output.frames
    return int(np.clip(FRAMES * LIGHT / n_e, FEWEST, FRAMES)) if frames == "auto" else frames


def frame_steps(scene: Scene, n_e: int) -> list[int]:
    """Steps at which ``RunOptions.frame`` is called, from start to end, with n_e unknowns of the tissue."""
    steps = scene.time.steps
    return np.linspace(0, steps, min(frame_count(scene, n_e), steps) + 1).round().astype(int).tolist()


def boundaries(
    scene: Scene, n_e: int, milestones: set[int], framed: bool, until: int | None
) -> tuple[list[int], set[int], set[int]]:
    """Steps at which a segment must end, and those of them with a frame or a checkpoint.

    Ten of them, ``milestones``, do not depend on the options: there the energy is sampled, the same in every run.
    """
    steps, every = scene.time.steps, scene.output.checkpoint_every
    frames = set(frame_steps(scene, n_e)) if framed else set[int]()
    checkpoints = set(range(every, steps, every)) if every else set()
    last = steps if until is None else min(until, steps)
    return sorted({s for s in frames | checkpoints | milestones if s < last} | {last}), frames, checkpoints


def output_recorders(
    outputs: Sequence[Output], local: Array
) -> tuple[list[tuple[slice, Array]], list[tuple[np.ndarray, Array]]]:
    """Local dofs and column block of ``local`` for every output that this rank has a share in."""
    points, regions, at = [], [], 0
    for output in outputs:
        share = local[:, at : at + output.size]
        if len(output.dofs) == 1 and (np.diff(output.dofs[0]) == 1).all():  # a slice, cheaper than indices
            points.append((slice(output.dofs[0][0], output.dofs[0][-1] + 1), share))
        elif len(output.dofs):
            regions.append((output.dofs, share))
        at += output.size
    return points, regions
