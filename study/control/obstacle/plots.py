"""Figures of a plan: body and obstacles at some instants, gaps, forces and speed over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from scipy.spatial import cKDTree

from softgrasp.fem import AXES, PictureMesh
from softgrasp.fem.obstacles.shapes import Shape
from softgrasp.fem.petsc import Array
from softgrasp.lqr import PlannedControl, separate
from softgrasp.study.control.obstacle.result import PlannedStudy
from softgrasp.study.pictures import draw_obstacle, style

SHOWN = (0.0, 0.12, 0.28, 0.45, 0.62, 0.8, 1.0)  # shares of the way at which the body is drawn
MANY = 2000  # points of a line; in print more of them coincide
HALO = [withStroke(linewidth=2.5, foreground="white")]  # keeps times readable on lines
LIMIT: dict[str, Any] = {"color": "#999999", "lw": 0.8, "ls": (0, (4, 2))}


def draw_plan(study: PlannedStudy, picture: PictureMesh | None, out: Path) -> list[Path]:
    """All figures of a plan. Rank 0 only."""
    files = list(figure_gaps(study.planned, out / "gaps.png"))
    if np.isfinite(study.seconds_cold).all():
        files += figure_times(study, out / "times.png")
    if picture is not None:
        files += figure_bodies(study.planned, picture, out / "obstacle.png")
    return files


def figure_bodies(planned: PlannedControl, picture: PictureMesh, out_png: Path) -> tuple[Path, ...]:
    """The boundary of the body at some instants under the plan and under the optimal feedback; PNG and PDF."""
    runs, nodes = planned.runs, planned.surface.nodes
    edges = cKDTree(nodes).query(picture.points[picture.facets])[1]
    centre = runs.planned.body.mean(axis=1)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))])
    instants = [int(np.searchsorted(way, share * way[-1])) for share in SHOWN]
    lines, free = runs.planned.body, runs.free.body
    low, high = lines.min(axis=(0, 1)), lines.max(axis=(0, 1))
    room = 0.06 * (high - low).max()
    box = np.array([low - room, high + room])
    with style.paper_style():
        width = style.WIDTH
        figure, ax = plt.subplots(figsize=(width, width * (box[1, 1] - box[0, 1]) / (box[1, 0] - box[0, 0])))
        for shape, name in zip(planned.plan.task.shapes, planned.names, strict=True):
            draw_obstacle(ax, shape, name, box)
        worst = [int(runs.free.gaps[:, i].argmin()) for i in range(len(planned.names))]
        for n in sorted(set(worst)):
            ax.add_collection(
                LineCollection(free[n][edges], colors="#888888", lw=0.9, linestyles=(0, (4, 2)), zorder=2)
            )
        colours = style.colour_map()(np.linspace(0.15, 1.0, len(instants)))
        for colour, n in zip(colours, instants, strict=True):
            ax.add_collection(LineCollection(lines[n][edges], colors=[colour], lw=1.3, zorder=3))
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


def _deviation(covariance: Array, shape: Shape, body: Array) -> Array:
    """Standard deviation of the gap, that of the nearest node along its normal [m], (times,)."""
    normals = np.array([separate(shape, at)[0] for at in body])
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
                room = 3 * _deviation(planned.online.covariance, task.shapes[i], run.body[thin])
                low, high = run.gaps[thin, i] - room, run.gaps[thin, i] + room
                gaps.fill_between(run.times[thin], low, high, color=style.CYCLE[i % 4], alpha=0.25, lw=0)
        if run.gaps.min(initial=1.0) > 0:
            gaps.set_yscale("log")
        else:  # within a millimetre the axis is linear
            gaps.set_yscale("symlog", linthresh=1e-3)
        gaps.axhline(margin, **LIMIT, label="clearance and margins")
        gaps.set_ylabel("gap [m]")
        gaps.legend(ncols=4, loc="upper right")
        for j, axis in enumerate(AXES[: run.inputs.shape[1]]):
            force.plot(
                run.times[:-1][thin], run.inputs[thin, j], color=style.CYCLE[j], label=axis, drawstyle="steps-post"
            )
            speed.plot(run.times[thin], run.v_s[thin, j], color=style.CYCLE[j], label=axis)
        for ax, limit in ((force, task.limits.force), (speed, task.limits.speed)):
            for level in () if limit is None else np.unique(np.atleast_1d(limit)):
                ax.axhline(level, **LIMIT)
                ax.axhline(-level, **LIMIT)
        force.set_ylabel("force on the hand [N]")
        speed.set(xlabel="$t$ [s]", ylabel="speed of the hand [m/s]")
        force.legend(ncols=2, loc="upper right")
        return style.save(figure, out_png)
