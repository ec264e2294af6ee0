"""Parts of the scene that describe the tissue and its contact zone; see `fem.scene.scene`."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from softgrasp.fem.scene import materials

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Box = Annotated[list[list[float]], Field(min_length=2, max_length=2)]
Label = Annotated[str, Field(max_length=80, pattern=r"^[^$\\\n]*$")]  # what figures draw, where $ begins a formula
TAKEN = ("mu", "lam", "lambda", "rho", "beta", "rest", "names", "used", "x", "d")  # names of other things
ROUNDING = 1e-9  # static solves on graded meshes lose up to seven of sixteen digits
Side = Literal["x-", "x+", "y-", "y+", "z-", "z+", "left", "right", "bottom", "top", "front", "back"]


class Section(BaseModel):
    """Frozen, strict, without unknown keys or non-finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def off(value: Any) -> Any:
    """TOML has no null: `--set effects.gravity=false` switches a table off, `--set tissue.size=false` drops a key."""
    return None if value is False else value


class OrFalse:
    """In the JSON schema false replaces Python's None."""

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        schema = handler(core)
        choices = [choice for choice in schema["anyOf"] if choice != {"type": "null"}]
        return {"anyOf": [*choices, {"const": False}]}


T = TypeVar("T")
Dropped = Annotated[T | None, BeforeValidator(off), OrFalse()]


def check_box(box: list[list[float]] | None, key: str) -> None:
    """ValueError unless the corners of the box fit each other."""
    if box is None:
        return
    lo, hi = box
    if len(lo) != len(hi):
        raise ValueError(f"{key} is {box}; its two corners must have as many coordinates")
    if any(a > b for a, b in zip(lo, hi, strict=True)):
        raise ValueError(f"{key} is {box}; its first corner must not exceed its second")


class Material(Section):
    """Isotropic linear elastic material, resolved to Lame constants and density."""

    name: Label | None = Field(None, description="name in the material library, or a label [no unit]")
    lam: float = Field(alias="lambda", description="first Lame constant [Pa]; 3 lambda + 2 mu > 0")
    mu: Positive = Field(description="shear modulus [Pa], > 0")
    rho: Positive = Field(description="mass density [kg/m3], > 0")

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, data: Any) -> Any:
        if isinstance(data, str):
            entry = materials.lookup(data)
            lam, mu = materials.lame(entry.young, entry.poisson)
            return {"name": data, "lambda": lam, "mu": mu, "rho": entry.rho}
        if not isinstance(data, dict) or not {"young", "poisson"} & data.keys():
            return data
        values = dict(data)
        if {"lambda", "mu"} & values.keys():
            raise ValueError("young and poisson exclude lambda and mu; give one pair")
        for key in ("young", "poisson"):
            if key not in values:
                raise ValueError(f"{key} is missing; young and poisson go together")
            if isinstance(values[key], bool) or not isinstance(values[key], int | float):
                raise ValueError(f"{key} is {values[key]!r}; it must be a number")
            if not np.isfinite(values[key]):
                raise ValueError(f"{key} is {values[key]}; it must be finite")
        young, nu = values.pop("young"), values.pop("poisson")
        if young <= 0:
            raise ValueError(f"young is {young}; it must be > 0")
        if not -1 < nu < 0.5:
            raise ValueError(f"poisson is {nu}; it must lie between -1 and 0.5, both excluded")
        values["lambda"], values["mu"] = materials.lame(young, nu)
        return values

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Forms of a material in a file: a name of the library, or one of the two pairs of moduli."""
        reference = handler(core)
        schema = handler.resolve_ref_schema(reference)
        lame = dict(schema)
        name, rho = (lame["properties"][key] for key in ("name", "rho"))
        young = {
            "young": {"type": "number", "exclusiveMinimum": 0, "description": "Young's modulus [Pa], > 0"},
            "poisson": {
                "type": "number",
                "exclusiveMinimum": -1,
                "exclusiveMaximum": 0.5,
                "description": "Poisson's ratio [1], between -1 and 0.5",
            },
        }
        pair = {**lame, "properties": {"name": name, **young, "rho": rho}, "required": [*young, "rho"]}
        schema.clear()
        schema |= {"title": lame["title"], "anyOf": [{"enum": list(materials.LIBRARY)}, lame, pair]}
        return reference

    @model_validator(mode="after")
    def _stable(self) -> Material:
        if 3 * self.lam + 2 * self.mu <= 0:
            raise ValueError(f"lambda is {self.lam}; it must be > -2 mu / 3 = {-2 * self.mu / 3:g} (nu > -1)")
        if self.nu >= 0.5:  # lambda / mu beyond double precision
            raise ValueError(f"lambda is {self.lam}; with mu = {self.mu} it gives nu = 0.5, it must stay below")
        return self

    @property
    def young(self) -> float:
        """Young's modulus [Pa]."""
        return materials.young_poisson(self.lam, self.mu)[0]

    @property
    def nu(self) -> float:
        """Poisson's ratio [1]."""
        return materials.young_poisson(self.lam, self.mu)[1]


class Layer(Section):
    """A part of the tissue with a material of its own."""

    tag: int | str | None = Field(
        None, description="cell tag, or name of a cell set, in the mesh file [no unit]; excludes box"
    )
    box: Box | None = Field(None, description="[[lo], [hi]] [m]; cells whose midpoint lies inside; excludes tag")
    material: Material = Field(description="library name, {lambda, mu, rho} or {young, poisson, rho} [Pa, kg/m3]")
    beta: NonNegative | None = Field(None, description="Kelvin-Voigt time of this layer [s]; else the scene's")
    parameters: dict[str, float] = Field(
        default_factory=dict, description="own values of tissue.parameters, by name [units of the energy]"
    )

    @model_validator(mode="after")
    def _check(self) -> Layer:
        if (self.tag is None) == (self.box is None):
            raise ValueError("box or tag must be given, and not both")
        check_box(self.box, "box")
        return self


class Refine(Section):
    """Cells that shrink towards the singular ends of contact zone, layers and boundary."""

    tolerance: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        None,
        description="largest error of the outputs against the hand over the largest of them that the mesh may leave "
        "[1]; chooses the cells of a box itself; default: only grade the given cells",
    )
    grading: Literal["auto", "off"] | Annotated[float, Field(gt=0, le=1)] = Field(
        "auto",
        description="mu of the cell size h0 (r / R)^(1 - mu) at the distance r from a singular end [no unit]: a "
        "number, 'auto' by the element order, or 'off' for cells that only meet the ends",
    )
    method: Literal["auto", "bisect", "lines"] = Field(
        "auto",
        description="how cells shrink [no unit]: bisected, or by moved lines of a box; auto: lines in 3D boxes and "
        "where there is no tolerance, else bisect",
    )
    contact: Literal["inherit", "select"] = Field(
        "inherit",
        description="contact zone of a bisected mesh [no unit]: parts of the facets bonded before, or those selected "
        "again by their midpoints; layers alike",
    )
    passes: Annotated[int, Field(ge=0)] = Field(
        3, description="refinements after the first estimate, at most [1]; 0: the a-priori mesh as it is"
    )
    most: Annotated[int, Field(ge=1)] = Field(200_000, description="tissue unknowns, at most [1]")

    @model_validator(mode="after")
    def _check(self) -> Refine:
        if self.tolerance is not None and self.tolerance < ROUNDING:
            raise ValueError(f"tolerance is {self.tolerance}; below {ROUNDING:g} rounding decides, use a larger one")
        if self.tolerance is not None and self.grading == "off":
            raise ValueError("grading is 'off'; a tolerance needs graded cells, drop one of them")
        return self


class Tissue(Section):
    """Geometry, material and element order of the tissue."""

    size: Dropped[Annotated[list[Positive], Field(min_length=2, max_length=3)]] = Field(
        None, description="edge lengths of the structured box [m]; with cells"
    )
    origin: Dropped[list[float]] = Field(None, description="lowest corner of the structured box [m]; default 0")
    cells: Dropped[Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=3)]] = Field(
        None, description="cells along each edge [1]; with size"
    )
    mesh: Dropped[str] = Field(None, description="mesh file, relative to the scene [no unit]; excludes size, cells")
    scale: Positive = Field(1.0, description="length of one unit of the mesh file [m]")
    repair: bool = Field(
        False,
        description="turn the inverted cells of a mesh file round and join its doubled nodes [no unit]; "
        "else refuse those and warn of these",
    )
    seam: Annotated[float, Field(gt=0, lt=0.1)] = Field(
        1e-4,
        description="boundary nodes of a mesh file closer than this share of the shortest edge there are doubled [1]",
    )
    read_limit: Dropped[Positive] = Field(
        None, description="longest processor time for reading the mesh file [s]; default 10, and 1 more a megabyte"
    )
    order: Literal[1, 2, 3] = Field(1, description="polynomial order of the displacement [1]")
    thickness: Positive = Field(1.0, description="thickness out of the plane [m], 2D only")
    material: Material = Field(description="library name, {lambda, mu, rho} or {young, poisson, rho} [Pa, kg/m3]")
    energy: Dropped[str] = Field(
        None,
        description='energy in UFL, "file.py:function", the file relative to the scene; it is run as a Python program '
        "[no unit]; off unless given",
    )
    parameters: dict[str, float] = Field(
        default_factory=dict, description="parameters of the energy, by name [units of the energy]"
    )
    layers: dict[str, Layer] = Field(default_factory=dict, description="parts with another material, by name [no unit]")
    refine: Dropped[Refine] = Field(
        None, description="graded cells {tolerance, grading, method, contact, passes, most} [no unit]; off unless given"
    )

    @model_validator(mode="after")
    def _check(self) -> Tissue:
        if "tissue" in self.layers:
            raise ValueError("layers.tissue is the name of the cells outside of all layers; give it another name")
        self._check_energy()
        if self.mesh is not None:
            given = [key for key in ("size", "cells", "origin") if getattr(self, key) is not None]
            if self.refine is not None and self.refine.method == "lines":
                raise ValueError("refine.method is 'lines'; a mesh file has no lines to move, use 'bisect'")
            if given:
                drop = " ".join(f"--set tissue.{key}=false" for key in given)
                raise ValueError(f"{' and '.join(given)} cannot go with tissue.mesh; drop them, or mesh ({drop})")
            return self
        if self.size is None or self.cells is None:
            missing = "size" if self.size is None else "cells"
            raise ValueError(f"{missing} is missing; give size and cells, or mesh")
        if len(self.cells) != len(self.size):
            raise ValueError(f"cells is {self.cells}; it must have {len(self.size)} entries as size does")
        for key in ("scale", "repair", "seam", "read_limit"):
            if getattr(self, key) != type(self).model_fields[key].default:
                raise ValueError(f"{key} needs tissue.mesh; a structured box has no use for it")
        for name, layer in self.layers.items():
            if layer.tag is not None:
                raise ValueError(f"layers.{name}.tag needs tissue.mesh; on a structured box give box")
        return self

    def _check_energy(self) -> None:
        """ValueError unless parameters and energy fit each other."""
        if self.energy is None and (self.parameters or any(layer.parameters for layer in self.layers.values())):
            raise ValueError("parameters needs tissue.energy; give the energy that has them, or drop them")
        if self.energy is not None and self.energy != "given" and not re.fullmatch(r".+\.py:[A-Za-z_]\w*", self.energy):
            raise ValueError(f"energy is '{self.energy}'; write a file and its function, as in \"law.py:W\"")
        for key in self.parameters:
            if not key.isidentifier() or key.startswith("_") or key in TAKEN:
                raise ValueError(
                    f"parameters has '{key}'; a name is a word of letters and digits, none of {', '.join(TAKEN)}"
                )
        for name, layer in self.layers.items():
            for key in layer.parameters:
                if key not in self.parameters:
                    raise ValueError(
                        f"layers.{name}.parameters has '{key}', which tissue.parameters lacks; give it there too"
                    )


class Contact(Section):
    """Boundary facets that the hand holds: midpoint on one of the sides and in the box, if given."""

    sides: list[Side] = Field(
        default_factory=list,
        description="planes of the bounding box [no unit]: x- to z+, left, right, bottom, top, front, back",
    )
    box: Dropped[Box] = Field(None, description="[[lo], [hi]] [m]; facets whose midpoint lies inside")
    facet_tag: int | str | None = Field(
        None, description="facet tag, or name of a facet set, in the mesh file [no unit]"
    )

    @model_validator(mode="after")
    def _check(self) -> Contact:
        if not self.sides and self.box is None and self.facet_tag is None:
            raise ValueError("sides, box or facet_tag must be given")
        check_box(self.box, "box")
        return self

    def axes(self, dimension: int) -> list[tuple[int, int]]:
        """(axis, -1 or +1) of each named side; bottom and top are y in 2D and z in 3D.

        Raises ValueError: a side does not exist in this dimension.
        """
        names = {"left": "x-", "right": "x+", "bottom": "y-", "top": "y+"}
        if dimension == 3:
            names |= {"bottom": "z-", "top": "z+", "front": "y-", "back": "y+"}
        planes = []
        for side in self.sides:
            code = names.get(side, side)
            if len(code) != 2 or "xyz".index(code[0]) >= dimension:
                raise ValueError(f"contact.sides has '{side}'; a {dimension}D tissue has no such side")
            planes.append(("xyz".index(code[0]), 1 if code[1] == "+" else -1))
        return planes
