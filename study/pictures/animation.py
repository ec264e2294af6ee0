"""The move as an animated GIF, at the speed at which it happens unless the eye cannot follow."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_rgb
from PIL import Image

from softgrasp.fem import Array, PictureMesh, note
from softgrasp.fem.run.states.snapshots import FILMED, spread
from softgrasp.study.pictures import body
from softgrasp.study.pictures.plate import around_bodies
from softgrasp.study.pictures.shapes import speed_up
from softgrasp.study.pictures.style import TARGET, colour_map, fit, paper_style

TICKS = 2  # shortest time of a frame [1/100 s]; viewers slow down what is shorter
MOST_BYTES = 3_000_000
DPI = 110
SMALL = 0.6  # least size of a body in 3D over that in a picture of the body alone; else the picture goes with it
ROOM = (5.4, 4.2)  # width and largest height of a picture [in]
REST = 1.0  # [s] the last frame stays longer


def gif_move(
    picture: PictureMesh,
    frames: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    out_gif: Path,
    tractions: Array | None = None,
) -> Path:
    """:func:`move_bytes` as a file, whose name is returned."""
    return write_gif(move_bytes(picture, frames, times, table, target, tractions), out_gif)


def move_bytes(
    picture: PictureMesh,
    frames: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    tractions: Array | None = None,
) -> bytes:
    """A GIF of body, hand, path and target in motion, in real time from 0.3 to 30 s; at most 60 frames and 3 MB.

    Too many frames are thinned out; for the arguments see :func:`softgrasp.study.pictures.body.figure_move`.
    """
    kept, durations = timing(times)
    frames, times = frames[kept].astype(np.float64), times[kept]
    move = body.make_view(picture, frames, times, table, target, None if tractions is None else tractions[kept])
    return gif_bytes(render(move, frames, times), durations)


def timing(times: Array) -> tuple[list[int], list[int]]:
    """Frames to show, at most 60, and how long each [ms]; rounding errors do not add up, and the last stays longer."""
    chosen = spread(len(times), FILMED).tolist()
    at = np.round(100 * (times - times[0]) / speed_up(times)).astype(int)  # GIF counts in hundredths of a second
    kept = chosen[:1]
    for i in chosen[1:]:
        if at[i] - at[kept[-1]] >= TICKS:
            kept.append(i)
    if len(chosen) > 1 and kept[-1] != chosen[-1]:
        kept = [*(kept[:-1] if len(kept) > 1 else kept), chosen[-1]]
    return kept, [*(10 * max(int(at[j] - at[i]), TICKS) for i, j in pairwise(kept)), int(1000 * REST)]


def render(move: body.MoveView, frames: Array, times: Array) -> list[Any]:
    """One picture per frame, all of one size."""
    frame = followed(move, frames)
    if frame:
        move = replace(move, low=frame[0][0], high=frame[0][1])
    fast = speed_up(times)
    digits = int(np.clip(2 - np.floor(np.log10(times[-1] or 1.0)), 0, 6))
    note = f" ({fast:g}×)" if fast != 1 else ""
    with paper_style():
        figure, axes = body.make_axes(move, 1, captions=False, width=ROOM[0], tallest=ROOM[1])

        # The longest text first, so that all frames have the size of the first.
        def caption(k: int) -> str:
            return f"t = {times[k]:.{digits}f} s{note}" + (body.place(move.hands[k]) if frame else "")

        stamp = axes[0].set_title(max(map(caption, range(len(times))), key=len), pad=3)
        body.colour_bar(figure, axes, move)
        body.legend(figure, move)
        body.settle(figure)
        window = np.array([axes[0].get_xlim(), axes[0].get_ylim()]).T

        def draw(k: int) -> None:
            if frame:
                low, high = window + frame[k][0] - frame[0][0]
                axes[0].set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            body.draw_surroundings(axes[0], move, [k])
            body.draw_scene(axes[0], move, frames[k : k + 1], None, move.hands[k : k + 1])
            body.name_layers(axes[0], move, frames[k], inside=True)  # beside the body they would change sides
            stamp.set_text(caption(k))

        return film(figure, axes, draw, range(len(times)), [stamp])


def followed(move: body.MoveView, frames: Array) -> list[tuple[Array, Array]]:
    """Corners of a frame that goes with the body in 3D, where the whole way would make it small; else none."""
    if move.picture.dimension == 2:
        return []
    around = around_bodies(move.picture, frames, move.hands)
    alone, whole = (float(np.min(ROOM / (high - low))) for low, high in (around[0], (move.low, move.high)))
    return around if whole < SMALL * alone else []


def film(
    figure: Any, axes: list[Any], draw: Callable[[int], None], frames: Iterable[int], others: Sequence[Any] = ()
) -> list[Any]:
    """Pictures of one figure: axes, colour bar and legend are drawn once, what moves over them in every frame.

    The figure comes without what moves, which are the collections and texts that ``draw`` adds to ``axes`` in a frame,
    and with ``others``, artists that it changes; it is closed.
    """
    canvas, images = figure.canvas, []
    figure.set_dpi(DPI)
    fit(figure, 0.08)
    for artist in (*others, *(line for ax in axes for line in ax.lines)):
        artist.set_animated(True)  # no part of the background
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for k in frames:
        for artist in [artist for ax in axes for artist in (*ax.collections, *ax.texts)]:
            artist.remove()
        draw(k)
        canvas.restore_region(background)
        for ax in axes:
            for artist in sorted([*ax.collections, *ax.lines, *ax.texts], key=lambda a: float(a.get_zorder())):
                ax.draw_artist(artist)
        for artist in others:
            artist.draw(canvas.get_renderer())
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    plt.close(figure)
    return images


def write_gif(gif: bytes, out_gif: Path) -> Path:
    """Write an animated picture and return its path."""
    note(out_gif)
    out_gif.write_bytes(gif)
    return out_gif


def gif_bytes(images: list[Any], durations: list[int]) -> bytes:
    """A GIF of frames of one size, each with its duration [ms], smaller if they would take more than 3 MB."""
    palette = _palette()
    for scale in (1.0, 0.8, 0.6, 0.45):
        size = tuple(round(scale * n) for n in images[0].size)
        scaled = images if scale == 1.0 else [image.resize(size, Image.Resampling.LANCZOS) for image in images]
        first, *rest = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in scaled]
        buffer = io.BytesIO()
        first.save(buffer, format="GIF", save_all=True, append_images=rest, duration=durations, loop=0, optimize=False)
        if buffer.tell() <= MOST_BYTES:
            break
    return buffer.getvalue()


def _palette() -> Any:
    """The 256 colours that occur: colour map in four shades, greys to pure white, and the target fading out."""
    shades = np.linspace(0.75, 1.0, 4)[:, None, None] * colour_map()(np.linspace(0.0, 1.0, 48))[:, :3]
    greys = np.append(np.linspace(0.0, 0.92, 47), 1.0)[:, None].repeat(3, axis=1)  # Pillow rounds: nothing near white
    fade = np.linspace(0.0, 0.8, 16)[:, None]
    target = (1 - fade) * np.array(to_rgb(TARGET)) + fade
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.round(255 * np.vstack([shades.reshape(-1, 3), greys, target])).astype(np.uint8).tobytes())
    return palette
