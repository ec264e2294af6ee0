"""What the pictures of ``softgrasp reduce`` need, brought to rank 0: modes, full and reduced motion at the vertices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgrasp.fem import Array, Model, PictureMesh, gather_picture, vertex_displacement
from softgrasp.reduction import PAPER_METHODS, FullRun, ReducedModel, replay_linear, thinned
from softgrasp.study.reduce.linear.result import MethodSweep, Point, by_error, nearest
from softgrasp.study.report import percent

MODES = 4  # a method
FRAMES = 30
MANY_VERTICES = 200_000  # above, no pictures of the body


@dataclass(frozen=True)
class View:
    """One reduced model for the eye."""

    title: str  # method, N and error of the deformation
    states: Array  # vertex displacements of its run at the frames, (k, n, d) [m]


@dataclass(frozen=True)
class Views:
    """What the pictures need, on rank 0."""

    picture: PictureMesh  # the body
    times: Array  # of the frames, (k,) [s]
    table: Array  # the hand, columns time and q_s, (steps + 1, 1 + n_s) [s, m, rad]
    full: Array  # vertex displacements of the full run at the frames, (k, n, d) [m]
    reduced: tuple[View, ...]  # models to compare
    # title and vertex displacements (k, n, d) of the first modes of some methods, largest entry 1; whether they are
    # absolute displacements, that take the hand along
    modes: tuple[tuple[str, Array, bool], ...]


def compared(sweeps: Sequence[MethodSweep]) -> list[tuple[MethodSweep, Point]]:
    """First of the paper's methods and best of all at the N compared."""
    first = [s for s in sweeps if s.method.key in PAPER_METHODS and s.points][:1]
    chosen = [(s, p) for s in first if (p := nearest(s.points, stable=False)) is not None]
    return chosen + [c for c in by_error(sweeps)[:1] if c[0] not in first]


def modes_of(sweeps: Sequence[MethodSweep]) -> list[tuple[MethodSweep, Point]]:
    """The best method of the paper that keeps the hand apart, and Craig-Bampton or else the best beyond the paper."""
    fixed = [c for c in by_error(sweeps) if c[0].method.fixed]
    old, new = ([c for c in fixed if (c[0].method.key in PAPER_METHODS) == paper] for paper in (True, False))
    return old[:1] + ([c for c in new if not c[0].method.snapshots] or new)[:1]


def gather_views(model: Model, run: FullRun, sweeps: Sequence[MethodSweep]) -> Views | None:
    """Bring to rank 0 what the pictures need; None on other ranks and for very large bodies. Collective."""
    if model.space.mesh.mesh.geometry.index_map().size_global > MANY_VERTICES:
        return None
    picture = gather_picture(model)
    frames = thinned(run.snapshots, FRAMES + 1)
    steps, full = frames.steps, vertex_displacement(model, frames.Z[: model.system.layout.n_local], frames.q_s)
    views = []
    for s, point in compared(sweeps):
        reduced = s.models[point.N]
        with np.errstate(all="ignore"):  # an unstable model may overflow
            motion = replay_linear(reduced, model, run, allow_unstable=True)
            z, _ = reduced.reconstruct(reduced.at(), motion.x[steps].T, motion.v_s[steps].T)
        states = vertex_displacement(model, np.nan_to_num(z), motion.q_s[steps].T)
        if states is not None:
            state = "" if point.stable else ", unstable"
            title = (
                f"{s.method.title}, N = {point.N}{state}\nerror of the deformation {percent(point.error_deformation)}"
            )
            views.append(View(title, states))
    modes = [(s.method.title, _modes(model, s.models[p.N]), s.method.frame == "absolute") for s, p in modes_of(sweeps)]
    if picture is None or full is None:
        return None
    table = np.column_stack([run.trajectory.times, run.trajectory.q_s])
    shown = tuple((title, shapes, free) for title, shapes, free in modes if shapes is not None and len(shapes))
    return Views(picture, frames.times, table, full, tuple(views), shown)


def _modes(model: Model, rom: ReducedModel) -> Array | None:
    """First displacement columns of a basis at the vertices, each with largest entry 1. Collective."""
    layout = model.system.layout
    if rom.reconstruction is None:
        return None
    Q = rom.reconstruction.L_q[:, 2 * layout.n_s :]
    largest = layout.comm.allreduce(np.abs(Q).max(axis=0, initial=0.0), np.maximum)
    kept = np.flatnonzero(largest > 1e-12 * largest.max(initial=0.0))[:MODES]
    shapes = vertex_displacement(model, Q[:, kept] / largest[kept], np.zeros((layout.n_s, len(kept))))
    return None if shapes is None else np.asarray(shapes)
