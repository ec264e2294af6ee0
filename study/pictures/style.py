"""One look for all figures: sizes, fonts, colours that also work for colour-blind readers and in grey."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from cycler import cycler
from PIL import Image

from softgrasp.fem import length_unit as length_unit  # beside the other units
from softgrasp.fem import note, percent
from softgrasp.study.pictures.pdf import PDF

if "inline" not in os.environ.get("MPLBACKEND", ""):  # a notebook shows figures by its own
    mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.ticker import FuncFormatter, LogFormatterSciNotation, LogLocator, NullFormatter

# loads a notebook's backend now: in a context of settings it would lose its own
plt.draw_if_interactive()  # type: ignore[no-untyped-call]
BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"  # Okabe and Ito
SKY = "#56B4E9"  # of the same palette
UNSTABLE = "#B00020"
HAND = "#2b2b2b"
OUTLINE = "#555555"
TARGET = ORANGE
CYCLE = (BLUE, ORANGE, GREEN, PURPLE)
COLUMN, WIDTH = 3.4, 7.0  # [inch], one column and both of a two-column page
FULL: dict[str, Any] = {"color": "#888888", "lw": 0.9, "ls": (0, (4, 3)), "zorder": 0}  # a full run beside reduced ones
DPI = 150
STEPS = [1, 2, 5, 10]  # between ticks
MANY = 300  # last over first number of a logarithmic axis: beyond it powers of ten alone have numbers
MARGIN = 0.04  # around a picture [inch]
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@contextmanager
def paper_style() -> Iterator[None]:
    """Matplotlib settings for figures in print, restored afterwards."""
    settings: Any = {
        "font.family": "sans-serif", "font.size": 8, "axes.labelsize": 8, "axes.titlesize": 8,
        "legend.fontsize": 7.5, "xtick.labelsize": 7.5, "ytick.labelsize": 7.5,
        "axes.titley": 1.0,  # else every draw looks for room
        "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.7, "lines.linewidth": 1.2,
        "axes.prop_cycle": cycler(color=CYCLE), "legend.frameon": False,
        "pdf.fonttype": 42, "figure.dpi": DPI, "savefig.dpi": DPI,
    }  # fmt: skip
    with mpl.rc_context(settings):
        yield


@cache
def colour_map() -> Any:
    """Light for small values, dark for large ones, so that the dark hand stands out against the held tissue."""
    colours = mpl.colormaps["viridis_r"]([0.02 + 0.9 * i / 255 for i in range(256)])
    return mpl.colors.ListedColormap(colours, name="softgrasp")


def few_ticks(axis: Any) -> None:
    """Numbers on a logarithmic axis that do not touch: powers of ten, and 2 and 5 between few of them."""
    low, high = sorted(axis.get_view_interval())
    few = high / low < MANY
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=7))
    if few and low >= 1e-3 and high < 1e5:
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def percent_ticks(axis: Any) -> None:
    """Few numbers on a logarithmic axis of shares, as percentages; those of a horizontal one need room."""
    few_ticks(axis)
    low, high = sorted(axis.get_view_interval())
    if axis.axis_name == "x" and high / low >= MANY:
        axis.set_major_locator(LogLocator(numticks=5))
    axis.set_major_formatter(FuncFormatter(lambda x, _: percent(x)))


def log_axis(ax: Any, top: float | None) -> None:
    """A logarithmic axis of errors, a line at every power of ten."""
    ax.set_yscale("log")
    ax.set_ylim(top=top)
    ax.yaxis.set_major_locator(LogLocator(numticks=12))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.grid(axis="y", color="#e6e6e6", lw=0.5, zorder=0)
    ax.set_axisbelow(True)


def direct_labels(ax: Any, ends: Sequence[tuple[float, float, str, str]], size: float = 7.0) -> None:
    """Names of curves right of the axes, each beside the end of its own, moved apart where they would touch.

    The axes have their final limits and scales; ``ends`` are x and y of the last point, name and colour of each curve.
    """
    inverse, inch = ax.transAxes.inverted(), ax.get_position().height * ax.figure.get_figheight()
    gap = 1.25 * size / 72 / inch
    heights = [float(np.clip(inverse.transform(ax.transData.transform((x, y)))[1], 0, 1)) for x, y, _, _ in ends]
    order = sorted(range(len(ends)), key=heights.__getitem__)
    places = list(np.array(heights)[order])
    for i in range(1, len(places)):
        places[i] = max(places[i], places[i - 1] + gap)
    excess = max(0.0, places[-1] - 1.0) if places else 0.0
    for i in reversed(range(len(places))):  # back below the upper edge
        places[i] = min(places[i], 1.0 if i == len(places) - 1 else places[i + 1] - gap) if excess else places[i]
    for place, i in zip(places, order, strict=True):
        x, y, name, colour = ends[i]
        ax.annotate(
            name, (x, y), (1.04, place), xycoords="data", textcoords="axes fraction", va="center", color=colour,
            fontsize=size, annotation_clip=False,
            arrowprops={"arrowstyle": "-", "lw": 0.5, "color": colour, "alpha": 0.6, "shrinkA": 3, "shrinkB": 2,
                "relpos": (0, 0.5), "patchA": None},  # clipping at the box of a text takes a tenth of a figure's time
        )  # fmt: skip


class Powers(LogFormatterSciNotation):
    """Numbers of a logarithmic axis as plain text, 2×10⁻³: formulas cost a third of a figure."""

    def __call__(self, x: float, pos: Any = None) -> str:
        """The text beside the tick at x."""
        text = re.sub(r"\^\{(.*?)\}", lambda power: power[1].translate(RAISED), super().__call__(x, pos))
        return re.sub(r"\$|\\mathdefault|[{}]", "", text).replace(r"\times", "×")


def _plain_powers(axis: Any) -> None:
    if type(axis.get_major_formatter()) is LogFormatterSciNotation:
        axis.set_major_formatter(Powers())
    if type(axis.get_minor_formatter()) is LogFormatterSciNotation:
        axis.set_minor_formatter(Powers(labelOnlyBase=False))


def fit(figure: Any, margin: float) -> None:
    """Give a figure the size of what is in it and a margin [inch], everything where it is."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
    figure.set_layout_engine("none")
    box = figure.get_tightbbox().padded(margin)
    size = figure.get_size_inches()
    scale, corner = size / box.size, box.min / box.size
    places = [(ax, ax.get_position().get_points() * scale - corner) for ax in figure.axes]
    anchors = [
        (each, each.get_bbox_to_anchor().get_points() / figure.dpi / box.size - corner) for each in figure.legends
    ]
    for text in figure.texts:
        text.set_position(np.array(text.get_position()) * scale - corner)
    figure.set_size_inches(*box.size)
    for ax, (low, high) in places:
        ax.set_position((*low, *(high - low)))
    for legend, (low, high) in anchors:
        legend.set_bbox_to_anchor((*low, *(high - low)), transform=figure.transFigure)


def save(figure: Any, out_png: Path) -> tuple[Path, ...]:
    """Write the figure as PNG and, where :data:`PDF` is set, beside it as PDF; close it and return the names."""
    files = (out_png, out_png.with_suffix(".pdf")) if PDF.get() else (out_png,)
    note(*files)
    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            _plain_powers(axis)
    canvas: Any = FigureCanvasAgg(figure)
    with paper_style():
        fit(figure, MARGIN)  # Matplotlib's own bbox_inches="tight" lays out and draws twice
        canvas.draw()
        Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(out_png, dpi=(DPI, DPI))
        for file in files[1:]:
            figure.savefig(file)
    plt.close(figure)
    return files


def pressure_unit(largest: float) -> tuple[float, str]:
    """Factor and name of the unit in which a pressure in pascal reads well."""
    return next(
        (f, unit) for f, unit, least in ((1e-6, "MPa", 1e6), (1e-3, "kPa", 1e3), (1.0, "Pa", 0.0)) if largest >= least
    )
