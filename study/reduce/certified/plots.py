"""Figures of a certified model: its error over the box, the greedy, effectivities, and error against query time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.ticker import MaxNLocator

from softgrasp.reduction import CertifiedModel
from softgrasp.study.pictures import BLUE, COLUMN, GREEN, HAND, ORANGE, UNSTABLE, few_ticks, paper_style, save
from softgrasp.study.pictures.style import percent_ticks
from softgrasp.study.reduce.certified.measure import BoxCheck, Size
from softgrasp.study.report import percent

KINDS = (
    ("bound", "bound (proved)", BLUE, "o"),
    ("estimate", "estimate", ORANGE, "s"),
    ("truth", "true error", HAND, "^"),
)
LEAST = 1e-12  # of an error that is drawn


def draw(out: Path, certified: CertifiedModel, check: BoxCheck | None, tolerance: float) -> list[Path]:
    """All figures. Rank 0 only."""
    files = [*figure_greedy(certified, tolerance, out / "certified_greedy.png")]
    if check is not None:
        files = [*figure_box(check.own, out / "certified_box.png"), *files]
        files += figure_sizes(check, tolerance, out / "certified_sizes.png")
    return files


def figure_box(own: Size, out_png: Path) -> tuple[Path, ...]:
    """Bound, estimate and truth at every test, one panel each, in one scale."""
    shown = [kind for kind in KINDS if np.isfinite([getattr(t, kind[0]) for t in own.tested]).any()]
    lam, mu = ([getattr(t, key) for t in own.tested] for key in ("lam", "mu"))
    values = {key: np.array([getattr(t, key) for t in own.tested]) for key, *_ in shown}
    whole = np.concatenate([v[np.isfinite(v)] for v in values.values()])
    norm = LogNorm(max(float(whole.min()), LEAST) / 1.1, max(float(whole.max()), 10 * LEAST) * 1.1)
    with paper_style():
        size = (COLUMN + 0.4, 0.3 + 2.2 * len(shown))
        figure, axes = plt.subplots(len(shown), 1, figsize=size, squeeze=False, sharex=True, layout="constrained")
        picture: Any = None
        for ax, (key, title, *_) in zip(axes[:, 0], shown, strict=True):
            colours = np.maximum(values[key], LEAST)
            picture = ax.scatter(lam, mu, s=190, marker="s", norm=norm, cmap="viridis_r", c=colours)
            span = f"{percent(np.nanmin(values[key]))} to {percent(np.nanmax(values[key]))}"
            ax.set(xscale="log", yscale="log", ylabel="μ [Pa]", title=f"{title}: {span}")
            ax.margins(0.14)
            for axis, places in ((ax.xaxis, lam), (ax.yaxis, mu)):
                axis.set_ticks(sorted(set(places)), [f"{x:.3g}" for x in sorted(set(places))])
                axis.set_ticks([], minor=True)
        axes[-1, 0].set_xlabel("λ [Pa]")
        bar = figure.colorbar(picture, ax=axes[:, 0].tolist(), label="relative error")
        percent_ticks(bar.ax.yaxis)
        return save(figure, out_png)


def figure_greedy(certified: CertifiedModel, tolerance: float, out_png: Path) -> tuple[Path, ...]:
    """Largest bound against k, and the chosen parameters."""
    rounds, box = certified.training["rounds"], certified.box
    k, bound = [r["k"] for r in rounds], np.array([r["bound"] for r in rounds], dtype=float)
    with paper_style():
        figure, (left, right) = plt.subplots(2, 1, figsize=(COLUMN + 0.9, 5.4), layout="constrained")
        known = np.isfinite(bound)
        shown = np.maximum([*bound[known], tolerance], LEAST)  # a bound of 0, where nothing moves, has no logarithm
        # limits first: there may be nothing to scale by
        left.set(yscale="log", ylim=(shown.min() / 2, max(1.3, 1.3 * float(shown.max()))))
        left.plot(np.array(k)[known], bound[known], "o-", color=BLUE, ms=3.5, label="largest bound on the grid")
        if not known.all():
            top = {"transform": left.get_xaxis_transform(), "clip_on": False}
            label = "larger than the deformation"
            left.plot(np.array(k)[~known], np.ones((~known).sum()), "^", color=BLUE, mfc="none", label=label, **top)
        left.axhline(tolerance, color=UNSTABLE, lw=0.9, ls="--", label=f"tolerance {percent(tolerance)}")
        left.set(xlabel="modes k", ylabel="relative bound")
        left.grid(axis="y", color="#e6e6e6", lw=0.5)
        percent_ticks(left.yaxis)
        left.legend()
        places: dict[tuple[float, float], list[int]] = {}
        for i, (lam, mu) in enumerate(certified.training["chosen"], 1):
            places.setdefault((float(lam), float(mu)), []).append(i)
        right.plot(*zip(*places, strict=True), "o", color=BLUE, ms=4)
        for place, numbers in places.items():
            text = ", ".join(map(str, numbers[:3])) + ("..." if len(numbers) > 3 else "")
            right.annotate(text, place, xytext=(3, 3), textcoords="offset points", fontsize=6.5)
        right.set(xscale="log", yscale="log", xlabel="λ [Pa]", ylabel="μ [Pa]", title="trained at")
        if box is not None:
            right.set(xlim=(box.lam[0] / 1.25, box.lam[1] * 1.5), ylim=(box.mu[0] / 1.4, box.mu[1] * 1.5))
            (a, b), (c, d) = box.lam, box.mu
            right.plot([a, b, b, a, a], [c, c, d, d, c], color="#999999", lw=0.7)
        for axis in (right.xaxis, right.yaxis):
            few_ticks(axis)
        return save(figure, out_png)


def figure_sizes(check: BoxCheck, tolerance: float, out_png: Path) -> tuple[Path, ...]:
    """Effectivities of every size, and errors against the time of an answer."""
    with paper_style():
        figure, (left, right) = plt.subplots(2, 1, figsize=(COLUMN + 0.9, 5.6), layout="constrained")
        for size in check.sizes:
            values = np.array([t.effectivity for t in size.tested])
            values = values[np.isfinite(values)]
            if len(values):
                colour, span = GREEN if size is check.own else BLUE, [values.min(), values.max()]
                left.plot([size.k] * 2, span, color=colour, lw=3, alpha=0.45, solid_capstyle="butt")
                left.plot(size.k, np.median(values), "_", color=colour, ms=11, mew=1.8)
        title = f"green: the model as built, k = {check.own.k}, k₂ = {check.own.k2}"
        left.set(yscale="log", xlabel="modes k of the answer", ylabel="bound / true error", title=title)
        left.set_ylim(bottom=0.9)
        left.xaxis.set_major_locator(MaxNLocator(integer=True))
        left.axhline(1.0, color="#888888", lw=0.9)
        left.grid(axis="y", color="#e6e6e6", lw=0.5)
        few_ticks(left.yaxis)
        times = [1e3 * s.query for s in check.sizes]
        for key, label, colour, marker in KINDS:
            values = np.array([s.largest(key) for s in check.sizes])  # nan, which is not drawn, with one basis
            right.plot(times, values, ls="", marker=marker, color=colour, ms=4.5, mfc="none", label=label)
        right.axvline(1e3 * check.full, color="#888888", lw=1.0, ls="-.", label="full run")
        right.axhline(tolerance, color=UNSTABLE, lw=0.9, ls="--", label=f"tolerance {percent(tolerance)}")
        for i, (time, size) in enumerate(zip(times, check.sizes, strict=True)):
            place, beside = (time, size.largest("bound")), (5, -8 if i % 2 else 2)  # neighbours may stand close
            right.annotate(f"k = {size.k}", place, xytext=beside, textcoords="offset points", fontsize=6.5)
        right.set(xscale="log", yscale="log", xlabel="time of an answer [ms]", ylabel="largest relative error")
        right.grid(axis="y", color="#e6e6e6", lw=0.5)
        few_ticks(right.xaxis)
        percent_ticks(right.yaxis)
        right.legend()
        return save(figure, out_png)
