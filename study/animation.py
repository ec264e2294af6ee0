"""The move as an animated GIF, at the speed at which it happens."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_rgb
from PIL import Image

from study.plots import Shot, colour_bar, draw_scene, legend, make_axes, make_shot
from study.style import TARGET, colour_map, paper_style

if TYPE_CHECKING:
    from fem.gather import PictureMesh

Array = npt.NDArray[np.float64]

MOST_FRAMES = 60
MOST_BYTES = 3_000_000
REST = 1.0  # [s] the last frame stays longer


def gif_move(
    picture: PictureMesh,
    frames: Array,
    times: Array,
    table: Array,
    target: npt.ArrayLike | None,
    out_gif: Path,
) -> Path:
    """Body, hand, path and target in motion, in real time; at most 60 frames and 3 MB.

    Args:
        picture: the body.
        frames: absolute vertex displacements, shape (k, n, d) [m]; too many are thinned out.
        times: instants of the frames, shape (k,) [s].
        table: the whole hand motion, columns time and q_s, shape (steps, 1 + n_s) [s, m, rad].
        target: hand coordinates aimed at, d or n_s entries, or None.
        out_gif: name of the file.

    Returns:
        The name of the file.
    """
    kept = np.unique(np.linspace(0, len(times) - 1, min(len(times), MOST_FRAMES)).round().astype(int))
    frames, times = np.asarray(frames, dtype=np.float64)[kept], np.asarray(times, dtype=np.float64)[kept]
    shot = make_shot(picture, frames, times, np.asarray(table, dtype=np.float64), target)
    images = _render(shot, frames, times)
    # GIF counts in hundredths of a second: round the instants, so that the errors do not add up.
    ticks = np.maximum(np.diff(np.round(100 * times)), 2.0)
    durations = [int(10 * n) for n in ticks] + [int(1000 * REST)]
    for scale in (1.0, 0.8, 0.6, 0.45):
        data = _encode(images, durations, scale)
        if len(data) <= MOST_BYTES:
            break
    out_gif.write_bytes(data)
    return out_gif


def _render(shot: Shot, frames: Array, times: Array) -> list[Any]:
    """One picture per frame, all of one size."""
    images = []
    with paper_style():
        figure, axes = make_axes(shot, 1)
        ax = axes[0]
        colour_bar(figure, axes, shot)
        legend(figure, axes, shot)
        figure.set_dpi(110)
        draw_scene(ax, shot, frames[:1], None, shot.hands[:1])
        figure.canvas.draw()
        box = figure.get_tightbbox(figure.canvas.get_renderer()).padded(0.08)
        height = 0.02 if shot.picture.dimension == 2 else 0.92
        stamp = figure.text(0.98, height, "", ha="right", va="bottom", fontsize=10, transform=ax.transAxes)
        for i in range(len(frames)):
            for artist in [*ax.collections, *ax.lines]:
                artist.remove()
            draw_scene(ax, shot, frames[i : i + 1], None, shot.hands[i : i + 1])
            stamp.set_text(f"$t$ = {times[i]:.2f} s")
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=110, bbox_inches=box)
            images.append(Image.open(buffer).convert("RGB"))
        plt.close(figure)
    return images


def _encode(images: list[Any], durations: list[int], scale: float) -> bytes:
    """GIF of the pictures with one palette."""
    size = tuple(round(scale * n) for n in images[0].size)
    small = images if scale == 1.0 else [image.resize(size, Image.Resampling.LANCZOS) for image in images]
    palette = _palette()
    flat = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in small]
    buffer = io.BytesIO()
    flat[0].save(
        buffer, format="GIF", save_all=True, append_images=flat[1:], duration=durations, loop=0, optimize=False
    )
    return buffer.getvalue()


def _palette() -> Any:
    """The 256 colours that occur: colour map in four shades, greys to pure white, and the target fading out."""
    shades = np.linspace(0.75, 1.0, 4)[:, None, None] * colour_map()(np.linspace(0.0, 1.0, 48))[:, :3]
    greys = np.repeat(
        np.append(np.linspace(0.0, 0.92, 47), 1.0)[:, None], 3, axis=1
    )  # Pillow rounds: nothing near white
    fade = np.linspace(0.0, 0.8, 16)[:, None]
    target = (1 - fade) * np.array(to_rgb(TARGET)) + fade
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.round(255 * np.vstack([shades.reshape(-1, 3), greys, target])).astype(np.uint8).tobytes())
    return palette
