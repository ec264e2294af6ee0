"""A page in which a move is turned, zoomed and played: one file, drawn by the browser, without a network."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from softgrasp.fem import Array
from softgrasp.study.pictures import shapes

TEMPLATE = Path(__file__).with_name("turning.html")
MOST_BYTES = 12_000_000  # of all coordinates in the page; above, instants are left out
LEVELS = 65535  # steps of a coordinate over the largest side of the scene
# of style.colour_map, at equal distances: pages do without Matplotlib
COLOURS = (
    "f1e51dd5e21ab2dd2d93d74175d0545ac86440bd722eb37c23a9831e9d89"
    "20928c24868e297b8e2d708e32648e38588c3e4989443b84472d7b481d6f"
)


@dataclass(frozen=True)
class Scene3D:
    """A surface in motion, coloured by a field, with obstacles at rest or as they move."""

    triangles: npt.NDArray[Any]  # vertices of the triangles, (m, 3)
    points: Array  # places of the vertices, (k, n, 3) [m]
    values: Array  # the field at the vertices, (k, n), or in the triangles, (k, m)
    times: Sequence[float]  # of the instants, (k,) [s]
    labels: Sequence[str]  # a line for each instant
    title: str  # of the field, with unit
    ends: tuple[float, float]  # values at both ends of the colours
    obstacles: Sequence[Array] = ()  # corners of triangles (j, 3, 3) [m]: none, one for all instants, or one each
    flat: bool = False  # whether it is seen from above

    def html(self) -> str:
        """The page; every place is right to 1.6e-5 of the largest side of the scene."""
        count = len(self.times)
        most = max(1, min(count, MOST_BYTES // (6 * self.points.shape[1])))
        kept = np.unique(np.linspace(0, count - 1, most).round().astype(int))
        points, values = self.points[kept], self.values[kept]
        low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
        step = float((high - low).max()) / LEVELS or 1.0
        sizes = (values - self.ends[0]) / ((self.ends[1] - self.ends[0]) or 1.0)
        around = [self.obstacles[i] for i in kept] if len(self.obstacles) > 1 else self.obstacles
        times = [float(self.times[i]) for i in kept]
        data = {
            "triangles": as_text(self.triangles.astype("<u4")),
            "points": as_text(np.round((points - low) / step).astype("<u2")),
            "values": as_text(np.round(255 * np.clip(sizes, 0.0, 1.0)).astype(np.uint8)),
            "colours": as_text(colours()),
            "obstacles": [as_text(x.astype("<f4")) for x in around],
            "stride": values.shape[1], "by_cell": values.shape[1] == len(self.triangles) != points.shape[1],
            "low": low.tolist(), "step": step, "middle": ((low + high) / 2).tolist(),
            "radius": 0.55 * float(np.linalg.norm(high - low)),
            "near": 0.6 * float(np.linalg.norm(np.ptp(points, axis=1), axis=1).max()),
            "yaw": -np.pi / 2 if self.flat else np.radians(shapes.AZIMUTH),
            "pitch": np.pi / 2 if self.flat else np.radians(shapes.ELEVATION),
            "times": times, "labels": [self.labels[i].replace("\n", " ") for i in kept],
            "slower": 1 / shapes.speed_up(np.array(times)) if times[-1] > times[0] else 1.0,
        }  # fmt: skip
        low_end, high_end = (f"{x:.3g}" for x in self.ends)
        return rendered(TEMPLATE, data, title=self.title, low=low_end, high=high_end)


def rendered(template: Path, data: dict[str, Any], **words: Any) -> str:
    """A page with its data, by :data:`TEMPLATE` or by a template that extends it."""
    pages = Environment(
        loader=FileSystemLoader([template.parent, TEMPLATE.parent]),
        autoescape=True, trim_blocks=True, undefined=StrictUndefined,
    )  # fmt: skip
    text = json.dumps(data).replace("<", "\\u003c")  # no tag within the script
    return pages.get_template(template.name).render(data=Markup(text), **words)


def colours() -> npt.NDArray[np.uint8]:
    """The 256 colours of a field, those of pictures to 1 %, (256, 3)."""
    given = np.frombuffer(bytes.fromhex(COLOURS), np.uint8).reshape(-1, 3)
    x, at = np.linspace(0.0, 1.0, 256), np.linspace(0.0, 1.0, len(given))
    return np.stack([np.interp(x, at, part).round().astype(np.uint8) for part in given.T], axis=1)


def as_text(array: npt.NDArray[Any]) -> str:
    """Its bytes in base64."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
