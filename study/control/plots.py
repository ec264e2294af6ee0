"""Figures of ``softgrasp control``: errors of the reduced gains against N, re-tuning, histories, the move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullFormatter

from softgrasp.fem import Array
from softgrasp.lqr import A_PRIORI, BasisGains, LoopMargins
from softgrasp.study.control.result import TITLES, ControlStudy, LoopRuns, Retuned
from softgrasp.study.pictures import Frames, Poles, figure_decay, figure_move, histories, style

LOOKS = {
    "pod": (style.BLUE, "-", "o"),
    "weighted_pod": (style.SKY, "--", "s"),
    "pod_fixed_solid": (style.ORANGE, "-", "^"),
    "componentwise_pod": (style.PURPLE, "--", "D"),
    "pod_decomposed": (style.GREEN, "-", "v"),
    "structured": (style.HAND, "-", "P"),
}
QUANTITIES = (
    ("error_P", "error of P"),
    ("error_K", "error of the gain K"),
    ("cost_excess", "excess cost, over the optimal one"),
)
TOP = 1.0  # errors above 100 % are not drawn
LOWEST = 1e-12  # smaller excess cost is rounding
LEAST_GAIN = 1e-4  # of the loop: smaller ones are not drawn
DASHES = ("-", "--", ":", "-.")  # of the inputs
CROSS: dict[str, Any] = {"ls": "", "marker": "x", "ms": 6.0, "mew": 1.2, "color": style.UNSTABLE}


def drawn(basis: BasisGains, key: str) -> tuple[list[int], list[float]]:
    """Orders and values of the line of a method; nan, which breaks the line, for errors above 100 %."""
    values = [getattr(r, key) for r in basis.reports]
    return [r.N for r in basis.reports], [max(v, LOWEST) if v <= TOP else float("nan") for v in values]


def unstable(basis: BasisGains, key: str) -> tuple[list[int], list[float]]:
    """Orders and values of gains that do not stabilise; nan for errors above 100 %."""
    bad = [r for r in basis.reports if r.ruled_out and not r.reason]
    return [r.N for r in bad], [getattr(r, key) if getattr(r, key) <= TOP else float("nan") for r in bad]


def figure_gains(bases: Sequence[BasisGains], out_png: Path) -> tuple[Path, ...]:
    """Relative error of P, of K, and excess cost against N for all methods; unstable gains marked; PNG and PDF."""
    ran = [s for s in bases if s.reports]
    bad = False
    with style.paper_style():
        figure, axes = plt.subplots(3, 1, figsize=(style.COLUMN + 1.8, 6.6), sharex=True, layout="constrained")
        for ax, (key, label) in zip(axes, QUANTITIES, strict=True):
            ends = []
            for j, s in enumerate(ran):
                line = drawn(s, key)
                ax.plot(*line, **_look(s))
                if shown := [point for point in zip(*line, strict=True) if point[1] > 0]:
                    ends.append((*shown[-1], TITLES[s.name], LOOKS[s.name][0]))
                N, values = unstable(s, key)
                bad |= bool(N)
                ax.plot(N, values, zorder=4, **CROSS)
                edge = [n + 0.6 * (j - 2) for n, v in zip(N, values, strict=True) if np.isnan(v)]  # methods may meet
                place = {"transform": ax.get_xaxis_transform(), "clip_on": False, "in_layout": False}
                for look in (_look(s) | {"ls": ""}, CROSS) if edge else ():
                    ax.plot(edge, [1.0] * len(edge), **place, **look)
            style.log_axis(ax, 2.5 * TOP)
            ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
            ax.set_ylabel(label)
            style.direct_labels(ax, ends)
        axes[-1].set_xlabel("N, order of the reduced equation")
        if bad:
            text = "unstable loop; on the edge: error above 100 %"
            figure.legend(handles=[Line2D([], [], label=text, **CROSS)], loc="outside upper left")
        return style.save(figure, out_png)


def _look(basis: BasisGains) -> dict[str, Any]:
    colour, dashes, marker = LOOKS[basis.name]
    return {"color": colour, "ls": dashes, "marker": marker, "ms": 3.4, "mfc": "none", "mew": 0.9, "lw": 1.1}


def figure_retune(retuned: Sequence[Retuned], out_png: Path) -> tuple[Path, ...]:
    """Excess cost of the re-tuned gains over the box of lambda and mu, one panel a basis; PNG and PDF."""
    values = [p.cost_excess for r in retuned for p in r.points if p.stable]
    low, high = min(values, default=LOWEST), max(values, default=TOP)
    norm = LogNorm(max(low, LOWEST) / 1.5, max(high, 10 * LOWEST) * 1.5)
    with style.paper_style():
        count = len(retuned)
        figure, axes = plt.subplots(
            count, 1, figsize=(style.COLUMN + 0.8, 0.4 + 2.3 * count), squeeze=False, sharex=True, layout="constrained"
        )
        picture: Any = None
        for ax, r in zip(axes[:, 0], retuned, strict=True):
            places = np.array([(p.materials[0].lam, p.materials[0].mu) for p in r.points])
            stable = np.array([p.stable for p in r.points])
            excess = np.maximum([p.cost_excess for p in r.points], LOWEST)
            look: dict[str, Any] = {"s": 900, "marker": "s", "norm": norm, "cmap": "viridis_r"}
            picture = ax.scatter(*places[stable].T, c=excess[stable], **look)
            for place, value in zip(places[stable], excess[stable], strict=True):  # on its colour, white on dark
                ink = "white" if norm(value) > 0.45 else "black"
                ax.text(*place, f"{value:.0e}", ha="center", va="center", fontsize=6.5, color=ink)
            ax.plot(*places[~stable].T, "x", color=style.UNSTABLE, ms=8, mew=1.6)
            ax.set(xscale="log", yscale="log", ylabel="μ [Pa]", title=f"{TITLES[r.name]}, N = {r.N}")
            ax.margins(0.25)
            for axis, settings in zip((ax.xaxis, ax.yaxis), places.T, strict=True):  # ticks at the settings themselves
                axis.set_ticks(np.unique(settings), [f"{v:.3g}" for v in np.unique(settings)])
                axis.set_minor_formatter(NullFormatter())
                axis.set_ticks([], minor=True)
        axes[-1, 0].set_xlabel("λ [Pa]")
        if picture is not None:
            figure.colorbar(picture, ax=axes[:, 0].tolist(), label=QUANTITIES[2][1])
        return style.save(figure, out_png)


def bode(margins: LoopMargins) -> Any:
    """Gain and phase of the loop at each input, with the crossover of its phase margin; a Matplotlib figure."""
    with style.paper_style():
        figure, (gain, phase) = plt.subplots(
            2, 1, figsize=(style.WIDTH, 0.6 * style.WIDTH), sharex=True, layout="constrained"
        )
        for i, axis in enumerate(margins.axes):
            loop = margins.response[:, i]
            colour, dashes = style.CYCLE[i % len(style.CYCLE)], DASHES[i % len(DASHES)]
            size, shown = np.abs(loop), np.abs(loop) > LEAST_GAIN
            gain.loglog(margins.omega[shown], size[shown], color=colour, ls=dashes, label=axis.name)
            angle = np.degrees(np.unwrap(np.angle(-loop))) - 180
            angle -= 360 * np.round((angle[0] + 180) / 360)
            phase.semilogx(margins.omega[shown], angle[shown], color=colour, ls=dashes)
            if np.isfinite(axis.crossover):
                gain.plot(axis.crossover, 1.0, "o", color=colour, ms=4)
                at = float(np.interp(np.log(axis.crossover), np.log(margins.omega), angle))
                phase.plot([axis.crossover] * 2, [-180, at], "o-", color=colour, ms=3, lw=0.8)
        gain.axhline(1.0, color=style.OUTLINE, lw=0.7)
        phase.axhline(-180.0, color=style.OUTLINE, lw=0.7)
        phase.yaxis.set_major_locator(MultipleLocator(45))
        gain.set_ylabel("gain of the loop [1]")
        phase.set(xlabel="frequency [rad/s]", ylabel="phase [deg]")
        gain.legend()
        return figure


def draw_move(out: Path, study: ControlStudy, frames: Frames) -> list[Path]:
    """The move as picture and animation, and its histories. Rank 0 only."""
    design, loops, full = study.design, study.loops, study.loops.full
    files = _move(out, study, frames) if frames.picture is not None and frames.states else []
    figure = histories(
        full.times, full.outputs, full.inputs, full.columns, target=design.target.y, limits=loops.limits,
        others=compared(loops), settle=loops.plan.settle, dimension=design.problem.layout.dimension,
    )  # fmt: skip
    return [*files, *style.save(figure, out / "histories.png")]


def draw_loop(out: Path, study: ControlStudy, poles: dict[str, Poles], frames: Frames) -> list[Path]:
    """Figures of gains, margins, contact, plan and poles; not that of the re-tuning. Rank 0 only."""
    files: list[Path] = []
    loops, full = study.loops, study.loops.full
    if any(b.reports for b in study.bases):
        files += figure_gains(study.bases, out / "errors.png")
    if study.margins is not None:
        files += style.save(bode(study.margins), out / "bode.png")
    if loops.touching is not None and loops.touching.run is not None and loops.touching.run.contact is not None:
        from softgrasp.study.pictures.contact import figure_contact  # few scenes have any

        files += figure_contact(full.times, loops.touching.run.contact, out / "contact.png")
    if study.planned is not None:
        from softgrasp.study.control.obstacle.plots import draw_plan

        files += draw_plan(study.planned, frames.picture, out)
    # rounding of the eigenvalues of the lowest modes
    noise = 1e-13 * max(float(np.abs(p).max(initial=0.0)) for p in poles.values())
    files += figure_decay(poles, out / "decay.png", noise=noise)
    return files


def compared(loops: LoopRuns) -> dict[str, tuple[Array, Array]]:
    """Outputs and inputs at the obstacles, else under the a-priori gain and under the paper's gain of largest cost."""
    if loops.touching is not None:
        run = loops.touching.run
        return {} if run is None else {"with obstacles": (run.outputs, run.inputs)}
    ran = [(r, r.run) for r in loops.reduced if r.run is not None]
    own = [x for x in ran if x[0].method == A_PRIORI]
    paper = sorted((x for x in ran if x[0].method != A_PRIORI), key=lambda x: (float(x[1].cost[-1]), x[0].method))
    return {f"{TITLES[r.method]}, N = {r.N}": (run.outputs, run.inputs) for r, run in (*own, *paper[-1:])}


def _move(out: Path, study: ControlStudy, frames: Frames) -> list[Path]:
    from softgrasp.study.pictures.animation import gif_move

    states, times, touching = np.stack(frames.states), np.array(frames.times), study.loops.touching
    full = study.loops.full if touching is None or touching.run is None else touching.run
    tractions = np.stack(frames.tractions) if frames.tractions else None
    table = np.column_stack([full.times, full.q_s])
    target = study.design.target.state.q_s
    files = [*figure_move(frames.picture, states, times, table, target, out / "move.png", tractions)]  # type: ignore[arg-type]
    if not frames.few:
        # nothing moves between the settling time and the end of the run
        keep = slice(None) if len(times) < 3 or times[-1] <= 1.5 * times[-2] else slice(-1)
        part = table[table[:, 0] <= times[keep][-1] + study.loops.plan.dt / 2]
        pressed = None if tractions is None else tractions[keep]
        files.append(gif_move(frames.picture, states[keep], times[keep], part, target, out / "move.gif", pressed))  # type: ignore[arg-type]
    return files
