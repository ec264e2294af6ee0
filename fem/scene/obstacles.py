"""Rigid obstacles of a scene, shared by contact (effects.obstacles) and by constrained control."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from softgrasp.fem.scene.tissue import Dropped, Label, NonNegative, Positive, Section, check_box

Kind = Literal["halfspace", "disc", "ball", "box", "polygon", "polyhedron"]
KEYS: dict[str, tuple[str, ...]] = {
    "halfspace": ("normal", "offset"),
    "disc": ("center", "radius"),
    "ball": ("center", "radius"),
    "box": ("lo", "hi"),
    "polygon": ("points",),
    "polyhedron": ("points",),
}
"""Keys of each kind."""
DIMENSION = {"disc": 2, "polygon": 2, "ball": 3, "polyhedron": 3}
"""Space dimension of the kinds that have only one."""


class Path(Section):
    """Known translation of an obstacle from where the scene puts it."""

    velocity: list[float] | None = Field(None, description="constant velocity, one entry per axis [m/s]; excludes csv")
    csv: str | None = Field(
        None,
        description="table, relative to the scene: t [s], then the displacement along each axis [m], joined by a cubic "
        "spline at rest at both ends, and at rest behind its end; excludes velocity",
    )

    @model_validator(mode="after")
    def _check(self) -> Path:
        if (self.velocity is None) == (self.csv is None):
            raise ValueError("velocity or csv must be given, and not both")
        return self


class Obstacle(Section):
    """A rigid convex body that the tissue must not enter."""

    name: Label = Field("", description="label [no unit]; default: kind and number")
    kind: Kind = Field(description="shape, disc and polygon in 2D, ball and polyhedron in 3D [no unit]")
    normal: list[float] | None = Field(
        None, description="outward direction, of any length [no unit]; halfspace: n.x <= offset is inside"
    )
    offset: float | None = Field(
        None, description="distance of the surface from the origin along n / |n| [m]; halfspace"
    )
    center: list[float] | None = Field(None, description="centre [m]; disc, ball")
    radius: Positive | None = Field(None, description="radius [m], > 0; disc, ball")
    lo: list[float] | None = Field(None, description="lowest corner [m]; box")
    hi: list[float] | None = Field(None, description="highest corner [m]; box")
    points: Annotated[list[list[float]], Field(min_length=3)] | None = Field(
        None, description="corners in any order, all on their convex hull [m]; polygon, polyhedron"
    )
    friction: NonNegative = Field(
        0.0, description="Coulomb coefficient of friction [1], >= 0; with effects.obstacles; 0: none"
    )
    parts: Annotated[int, Field(ge=1, le=64)] | None = Field(
        None,
        description="parts of a boundary edge between points that can touch, 1: nodes alone [1]; with "
        "effects.obstacles; the largest counts for all obstacles; default: nodes, and more where the obstacle is "
        "smaller than their distance or, in 3D, on order 2",
    )
    path: Dropped[Path] = Field(None, description="translation over time {velocity [m/s] or csv}; fixed unless given")

    @model_validator(mode="after")
    def _check(self) -> Obstacle:
        keys = KEYS[self.kind]
        for key in sorted({key for each in KEYS.values() for key in each}):
            if (getattr(self, key) is not None) != (key in keys):
                needed = " and ".join(keys)
                state = "is missing" if key in keys else f"does not go with kind = '{self.kind}'"
                raise ValueError(f"{key} {state}; a {self.kind} needs {needed}")
        if self.friction and self.parts is not None:
            raise ValueError("parts cannot go with friction, which acts on nodes alone; drop one of them")
        if self.normal is not None and not any(self.normal):
            raise ValueError(f"normal is {self.normal}; it must have a direction")
        if self.lo is not None and self.hi is not None:
            check_box([self.lo, self.hi], "lo, hi")
            if any(a == b for a, b in zip(self.lo, self.hi, strict=True)):
                raise ValueError(f"hi is {self.hi}; it must exceed lo = {self.lo} in every direction")
        if self.points is not None:
            _check_points(self.points, DIMENSION[self.kind])
        return self

    def vectors(self) -> Iterator[tuple[str, list[float]]]:
        """Every vector with an entry per axis, by its key."""
        for key in ("normal", "center", "lo", "hi"):
            if (vector := getattr(self, key)) is not None:
                yield key, vector
        if self.path is not None and self.path.velocity is not None:
            yield "path.velocity", self.path.velocity


def _check_points(points: list[list[float]], d: int) -> None:
    """ValueError unless the points are the corners of a convex body of d dimensions."""
    from scipy.spatial import ConvexHull, QhullError  # few scenes need it

    for i, point in enumerate(points):
        if len(point) != d:
            raise ValueError(f"points[{i}] has {len(point)} entries; it must have {d}")
    try:
        corners = ConvexHull(np.array(points)).vertices
    except QhullError:
        raise ValueError(f"points lie on one {'line' if d == 2 else 'plane'}; they must enclose something") from None
    if inner := sorted(set(range(len(points))) - set(corners.tolist())):
        raise ValueError(
            f"points[{inner[0]}] = {points[inner[0]]} is no corner of the convex hull of all points; drop it, or give "
            "a body that is not convex as several obstacles"
        )


def check_obstacles(obstacles: list[Obstacle] | None, used: bool) -> None:
    """ValueError unless obstacles go together with each other and with the rest of the scene, where one is ``used``."""
    if obstacles is None:
        return
    if not used:
        raise ValueError(
            "obstacle is given but nothing in this scene uses it; set effects.obstacles = true for contact, give "
            "control.constraints, or drop [[obstacle]]"
        )
    names = obstacle_names(obstacles)
    for i, name in enumerate(names):
        if name in names[:i]:
            raise ValueError(f"obstacle.{names.index(name)} and obstacle.{i} are both named {name}; name one anew")
    divided = [i for i, obstacle in enumerate(obstacles) if obstacle.parts is not None]
    if divided and any(obstacle.friction for obstacle in obstacles):
        raise ValueError(
            f"obstacle.{divided[0]}.parts cannot go with the friction of another obstacle, which lets nodes alone "
            "touch; drop one of them"
        )


def obstacle_names(obstacles: list[Obstacle]) -> list[str]:
    """Name of every obstacle, kind and number where the scene gives none."""
    return [obstacle.name or f"{obstacle.kind}{i + 1}" for i, obstacle in enumerate(obstacles)]


def check_obstacle_vectors(obstacles: list[Obstacle] | None, d: int) -> None:
    """ValueError for the first obstacle that does not fit d dimensions."""
    for i, obstacle in enumerate(obstacles or []):
        if (own := DIMENSION.get(obstacle.kind, d)) != d:
            other = next(kind for kind, each in DIMENSION.items() if each == d and KEYS[kind] == KEYS[obstacle.kind])
            raise ValueError(f"obstacle.{i}.kind is '{obstacle.kind}', of {own}D; in this {d}D scene use '{other}'")
        for key, vector in obstacle.vectors():
            if len(vector) != d:
                raise ValueError(
                    f"obstacle.{i}.{key} has a vector of {len(vector)} entries; it must have {d} in this {d}D scene"
                )


def replace_paths(data: dict[str, Any], value: Callable[[str], str]) -> None:
    """Replace in a dumped scene the name of the csv file of every obstacle by a ``value`` of it."""
    for obstacle in data.get("obstacle") or []:
        if (table := obstacle.get("path")) and table.get("csv") is not None:
            table["csv"] = value(table["csv"])
