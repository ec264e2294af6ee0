"""Figures of a plan: body and obstacles at some instants, gaps, forces and speed over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from scipy.spatial import ConvexHull, cKDTree

from softgrasp.fem import AXES, PictureMesh
from softgrasp.fem.obstacles.shapes import Ball, HalfSpace, Polytope, Shape
from softgrasp.fem.petsc import Array
from softgrasp.lqr import PlannedControl, Task
from softgrasp.study.control.obstacle.result import PlannedStudy, freedoms
from softgrasp.study.pictures import draw_obstacle, style

SHOWN = (0.0, 0.12, 0.28, 0.45, 0.62, 0.8, 1.0)  # shares of the way at which the body is drawn
MANY = 2000  # points of a line; in print more of them coincide
APART = 0.08  # of the picture, between two names of an obstacle that moves
HALO = [withStroke(linewidth=2.5, foreground="white")]  # keeps times readable on lines
LIMIT: dict[str, Any] = {"color": "#999999", "lw": 0.8, "ls": (0, (4, 2))}


def draw_plan(study: PlannedStudy, picture: PictureMesh | None, out: Path) -> list[Path]:
    """All figures of a plan. Rank 0 only."""
    files = list(figure_gaps(study.planned, out / "gaps.png"))
    if np.isfinite(study.seconds_cold).all():
        files += figure_times(study, out / "times.png")
    if picture is not None:
        draw = figure_bodies if picture.dimension == 2 else figure_views
        files += draw(study.planned, picture, out / "obstacle.png")
    return files


def figure_bodies(planned: PlannedControl, picture: PictureMesh, out_png: Path) -> tuple[Path, ...]:
    """The boundary of the body at some instants under the plan and under the optimal feedback; PNG and PDF."""
    runs, nodes = planned.runs, planned.surface.nodes
    edges = cKDTree(nodes).query(picture.points[picture.facets])[1]
    centre, instants = _shown(runs.planned.body)
    lines, free = runs.planned.body, runs.free.body
    low, high = lines.min(axis=(0, 1)), lines.max(axis=(0, 1))
    room = 0.06 * (high - low).max()
    box = np.array([low - room, high + room])
    with style.paper_style():
        width = style.WIDTH
        figure, ax = plt.subplots(figsize=(width, width * (box[1, 1] - box[0, 1]) / (box[1, 0] - box[0, 0])))
        for i in range(len(planned.names)):
            _draw(ax, planned, i, runs.planned.times[instants], (0, 1), box)
        worst = [int(runs.free.gaps[:, i].argmin()) for i in range(len(planned.names))]
        for n in sorted(set(worst)):
            ax.add_collection(
                LineCollection(free[n][edges], colors="#888888", lw=0.9, linestyles=(0, (4, 2)), zorder=2)
            )
        colours = style.colour_map()(np.linspace(0.15, 1.0, len(instants)))
        for colour, n in zip(colours, instants, strict=True):
            ax.add_collection(LineCollection(lines[n][edges], colors=[colour], lw=1.3, zorder=3))
            _dots(ax, planned, lines[n], colour)
            x, y = centre[n]
            ax.text(
                x,
                y,
                f"{runs.planned.times[n]:.3g} s",
                ha="center",
                va="center",
                fontsize=7,
                zorder=4,
                path_effects=HALO,
            )
        ax.plot(*centre[:: max(1, len(centre) // MANY)].T, color=style.HAND, lw=0.7, ls=(0, (1, 1.2)), zorder=2)
        ax.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal", xlabel="$x$ [m]", ylabel="$y$ [m]")
        return style.save(figure, out_png)


def figure_views(planned: PlannedControl, picture: PictureMesh, out_png: Path) -> tuple[Path, ...]:
    """Outlines of a body in space at some instants under the plan, from the front and from above; PNG and PDF."""
    run, free = planned.runs.planned, planned.runs.free
    worst = sorted({int(gaps.argmin()) for gaps in free.gaps.T if gaps.min() < 0})
    centre, instants = _shown(run.body)
    low, high = run.body.min(axis=(0, 1)), run.body.max(axis=(0, 1))
    room = 0.1 * (high - low).max()
    box = np.array([low - room, high + room])
    colours = style.colour_map()(np.linspace(0.15, 1.0, len(instants)))
    with style.paper_style():
        size = np.ptp(box, axis=0)
        height = style.WIDTH * (size[1] + size[2]) / size[0]
        figure, views = plt.subplots(
            2, 1, figsize=(style.WIDTH, 1.1 * height), sharex=True, layout="constrained",
            gridspec_kw={"height_ratios": [size[2], size[1]]},
        )  # fmt: skip
        for ax, plane in zip(views, ((0, 2), (0, 1)), strict=True):
            for i in range(len(planned.names)):
                _draw(ax, planned, i, run.times[instants], plane, box[:, plane])
            for n in worst:
                ax.plot(*_outline(free.body[n][:, plane]).T, color="#888888", lw=0.9, ls=(0, (4, 2)), zorder=2)
            for colour, n in zip(colours, instants, strict=True):
                seen = run.body[n][:, plane]
                ax.plot(*_outline(seen).T, color=colour, lw=1.3, zorder=3)
                _dots(ax, planned, seen, colour)
                x, y = centre[n][list(plane)]
                ax.text(
                    x, y, f"{run.times[n]:.3g} s", ha="center", va="center", fontsize=7, zorder=4, path_effects=HALO
                )
            ax.plot(*centre[:, plane].T, color=style.HAND, lw=0.7, ls=(0, (1, 1.2)), zorder=2)
            ax.set(xlim=box[:, plane[0]], ylim=box[:, plane[1]], aspect="equal", ylabel=f"${AXES[plane[1]]}$ [m]")
        views[-1].set_xlabel("$x$ [m]")
        return style.save(figure, out_png)


def _outline(points: Array) -> Array:
    """Corners of the hull of points in the plane, the first one again at the end."""
    around = points[ConvexHull(points).vertices]
    return np.vstack([around, around[:1]])


def _dots(ax: Any, planned: PlannedControl, body: Array, colour: Any) -> None:
    """The nodes that keep gaps, where they are not the whole boundary."""
    if planned.surface.kept is not None:
        ax.plot(*planned.surface.of(body).T, "o", ms=3, color=colour, zorder=4)


def _shown(body: Array) -> tuple[Array, list[int]]:
    """The middle of the body (times, nodes, d) over time, and the instants that are drawn."""
    centre = body.mean(axis=1)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))])
    return centre, [int(np.searchsorted(way, share * way[-1])) for share in SHOWN]


def _draw(ax: Any, planned: PlannedControl, i: int, times: Array, plane: tuple[int, int], box: Array) -> None:
    """An obstacle seen along the third axis; one that moves at some instants."""
    task, axes = planned.plan.task, list(plane)
    shape = _seen(task.shapes[i], axes)
    if shape is None:
        return
    moves = task.path(i) is not None
    shifts = task.shifts(i, times if moves else times[:1])[:, axes]
    named = -1  # where the last name is
    for k, (t, shift) in enumerate(zip(times.tolist(), shifts, strict=False)):
        far = named < 0 or np.linalg.norm(shift - shifts[named]) > APART * np.ptp(box, axis=0).max()
        name = (f"{planned.names[i]} {t:.3g} s" if np.ptp(shifts, axis=0).any() else planned.names[i]) if far else ""
        named = k if far else named
        if _inside(shape, shift, box):
            draw_obstacle(ax, shape, name, box, shift)


def _inside(shape: Shape, shift: Array, box: Array) -> bool:
    """Whether the middle of an obstacle lies in the picture; of a half-space always."""
    if isinstance(shape, HalfSpace):
        return True
    assert isinstance(shape, Ball | Polytope)
    middle = shape.center if isinstance(shape, Ball) else shape.corners.mean(axis=0)
    size = np.ptp(shape.corners, axis=0) / 2 if isinstance(shape, Polytope) else shape.radius
    return bool((np.abs(middle + shift - box.mean(axis=0)) < np.ptp(box, axis=0) / 2 + size).all())


def _seen(shape: Shape, axes: list[int]) -> Shape | None:
    """An obstacle seen along an axis; None for a half-space whose face is not parallel to it."""
    if isinstance(shape, Ball):
        return Ball(shape.center[axes], shape.radius)
    if isinstance(shape, Polytope):
        return Polytope.hull(shape.corners[:, axes])
    assert isinstance(shape, HalfSpace)
    normal = shape.normal[axes]
    return HalfSpace(normal, shape.offset) if np.linalg.norm(normal) > 1 - 1e-9 else None


def figure_times(study: PlannedStudy, out_png: Path) -> tuple[Path, ...]:
    """Histogram of the times of the quadratic program against tick and interval; PNG and PDF."""
    kinds = {"without a guess": study.seconds_cold, "from a plan nearby": study.seconds_warm}
    if study.seconds_online:
        kinds["online, with its judgement"] = study.seconds_online
    grid = study.planned.plan.horizon.plant.grid
    every = np.concatenate([*kinds.values(), [study.tick, grid]])
    edges = np.geomspace(every.min() / 2, 2 * every.max(), 60).tolist()
    with style.paper_style():
        figure, ax = plt.subplots(figsize=(style.WIDTH, 0.35 * style.WIDTH), layout="constrained")
        for i, (name, seconds) in enumerate(kinds.items()):  # the few in front of the many
            ax.hist(seconds, edges, color=style.CYCLE[i], label=f"{name}, {len(seconds)} solutions", zorder=3 - i)
        top = ax.get_ylim()[1]
        for at, name in ((study.tick, "tick"), (grid, "interval")):
            ax.axvline(at, **LIMIT)
            ax.annotate(name, (at, top), xytext=(3, -2), textcoords="offset points", va="top", color="#666666")
        ax.set(xscale="log", xlabel="time of the quadratic program [s]", ylabel="number")
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
        return style.save(figure, out_png)


def _deviation(covariance: Array, task: Task, i: int, body: Array, times: Array) -> Array:
    """Standard deviation of the gap, that of the nearest node along its normal [m], (times,)."""
    normals = np.array([task.separate(i, at, t)[0] for at, t in zip(body, times.tolist(), strict=True)])
    nearest = np.einsum("td,tjd->tj", normals, body).argmin(axis=1)
    return np.asarray(np.sqrt(np.einsum("td,tde,te->t", normals, covariance[nearest], normals)))


def figure_gaps(planned: PlannedControl, out_png: Path) -> tuple[Path, ...]:
    """Gaps, forces and speed over time with margin and limits; PNG and PDF."""
    run, task = planned.runs.planned, planned.plan.task
    thin = slice(None, None, max(1, len(run.times) // MANY))
    with style.paper_style():
        figure, (gaps, force, speed) = plt.subplots(
            3, 1, figsize=(style.WIDTH, 0.75 * style.WIDTH), sharex=True, layout="constrained"
        )
        margin = task.clearance + float(np.max(task.error + task.noise, initial=0.0))
        for i, name in enumerate(planned.names):
            gaps.plot(run.times[thin], run.gaps[thin, i], color=style.CYCLE[i % 4], label=name)
            if planned.online is not None and planned.online.covariance is not None:
                room = 3 * _deviation(
                    planned.online.covariance, task, i, planned.surface.of(run.body)[thin], run.times[thin]
                )
                low, high = run.gaps[thin, i] - room, run.gaps[thin, i] + room
                gaps.fill_between(run.times[thin], low, high, color=style.CYCLE[i % 4], alpha=0.25, lw=0)
        if run.gaps.min(initial=1.0) > 0:
            gaps.set_yscale("log")
        else:  # within a millimetre the axis is linear
            gaps.set_yscale("symlog", linthresh=1e-3)
        gaps.axhline(margin, **LIMIT, label="clearance and margins")
        gaps.set_ylabel("gap [m]")
        gaps.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5)
        for j, (axis, turning) in enumerate(freedoms(planned)):
            look: dict[str, Any] = {"color": style.CYCLE[j % 4], "ls": ":" if turning else "-", "label": axis}
            force.plot(run.times[:-1][thin], run.inputs[thin, j], drawstyle="steps-post", **look)
            speed.plot(run.times[thin], run.v_s[thin, j], **look)
        for ax, limit in ((force, task.limits.force), (speed, task.limits.speed)):
            for level in () if limit is None else np.unique(np.atleast_1d(limit)):
                ax.axhline(level, **LIMIT)
                ax.axhline(-level, **LIMIT)
        turns = task.angle is not None
        force.set_ylabel("load [N, N m]" if turns else "force on the hand [N]")
        speed.set(xlabel="$t$ [s]", ylabel="speed [m/s, rad/s]" if turns else "speed of the hand [m/s]")
        force.legend(ncols=3, loc="upper right")
        return style.save(figure, out_png)
