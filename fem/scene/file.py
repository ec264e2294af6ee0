"""Scene files: read TOML, apply `--set`, explain what is wrong in one sentence, write the resolved scene."""

from __future__ import annotations

import difflib
import json
import os
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError

from softgrasp import PACKAGE
from softgrasp.fem.errors import SceneError, shortened
from softgrasp.fem.scene.obstacles import replace_paths
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.scene.text import check_values, parse_toml, read_text

if TYPE_CHECKING:  # scenes are listed and explained without MPI
    from mpi4py import MPI

_BARE = re.compile(r"[A-Za-z0-9_-]+")
_FILES = (("tissue", "mesh"), ("motion", "csv"))
_EXPECTED = {
    "model_type": "a table",
    "dict_type": "a table",
    "list_type": "a list",
    "string_type": "a string",
    "float_type": "a number",
    "int_type": "an integer",
    "int_from_float": "an integer",
    "bool_type": "true or false",
    "finite_number": "a finite number",
    "string_pattern_mismatch": "in one line without $ and \\",
}

ALIKE = 0.65  # least likeness of a key that is suggested [1]; "stiffness" and "tissue" have 0.53
PART = 4  # letters of a part of a name that is recognised
TABLES = 2  # most tables with a key of one name, for which another table is suggested [1]
_OTHER_WORDS = {  # words of the field for a key
    "stiffness": "tissue.material.young", "modulus": "tissue.material.young", "e": "tissue.material.young",
    "young": "tissue.material.young", "poisson": "tissue.material.poisson", "nu": "tissue.material.poisson",
    "density": "tissue.material.rho", "degree": "tissue.order", "dt": "time.steps",
}  # fmt: skip
_FORMS = {
    "effects.gravity": "gravity = { g = [0, -9.81] }",
    "effects.damping": 'damping = { kind = "kelvin-voigt", beta = 0.01 }',
    "tissue.material": 'material = "muscle" or material = { young = 2e4, poisson = 0.45, rho = 1060 }',
    "tissue.size": "size = [0.06, 0.12]",
    "tissue.cells": "cells = [12, 24]",
    "tissue.refine": "refine = { tolerance = 1e-2 }",
    "contact.sides": 'sides = ["left", "right"]',
    "contact.box": "box = [[0, 0.09], [0.06, 0.12]]",
    "hand.inertia": "inertia = 1e-3, or in 3D inertia = [1e-3, 1e-3, 5e-4] about x, y and z",
    "motion.target": "target = [0.3, 0.2]",
    "obstacle": 'obstacle = [{ kind = "halfspace", normal = [0, 1], offset = -0.05 }]',
    "control.outputs": 'outputs = [{ kind = "node", point = [0.03, 0] }]',
}


def shipped_scenes() -> dict[str, Path]:
    """Name and path of the scenes that ship with the project."""
    folder = (PACKAGE / "scenes").resolve()
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def find_scene(path: str | Path) -> Path:
    """The scene that ships under a bare name, else the file of that path."""
    file = Path(path)
    bare = len(file.parts) == 1 and not os.path.isfile(file)  # false for a name that is too long, which Path raises
    return shipped_scenes().get(file.name, file) if bare else file


def as_overrides(tables: Mapping[str, Any], above: str = "") -> list[str]:
    """Tables by sections as "section.key=value" each, with values in TOML; an empty table is a value."""
    result = []
    for name, value in tables.items():
        key = f"{above}{name}"
        if isinstance(value, Mapping) and value:
            result += as_overrides(value, f"{key}.")
        elif isinstance(value, Mapping):
            result.append(f"{key}={{}}")
        else:
            result.append(f"{key}={toml_value(value.tolist() if hasattr(value, 'tolist') else value)}")
    return result


def load_scene(path: str | Path, overrides: Sequence[str] = (), **tables: Any) -> Scene:
    """Read and validate a scene file, without MPI; under MPI use :func:`load_scene_collective`.

    Args:
        overrides: each ``a.b.c=value`` with a TOML value, as after ``--set``; a bare word is a string, and ``false``
            switches off an optional table.
        tables: the same by sections, ``tissue={"cells": [4, 8]}``.

    Raises:
        SceneError: the file is missing, no TOML, or a key is unknown, missing, ill-typed or meaningless.

    >>> import softgrasp as sg
    >>> sg.load_scene("paper_lqr", ["control.R=2"]).control.R
    2.0
    >>> sg.load_scene("paper_lqr", control={"R": 3}).control.R
    3.0
    """
    file = find_scene(path)
    data = _read(file)
    for override in (*overrides, *as_overrides(tables)):
        _apply(data, override)
    try:
        check_values(data)
        scene = Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError(f"{path}: {_explain(error, data)}") from None
    except ValueError as error:
        raise SceneError(f"{path}: {error}") from None
    scene._directory = file.resolve().parent
    return scene


def load_scene_collective(comm: MPI.Intracomm, path: str | Path, overrides: Sequence[str] = ()) -> Scene:
    """`load_scene` on rank 0, broadcast to all. Collective. Raises SceneError: on every rank, as rank 0 met it."""
    from softgrasp.fem.petsc import on_root  # loads MPI, which scenes do without

    return on_root(comm, lambda: load_scene(path, overrides))


def resolved_toml(scene: Scene) -> str:
    """TOML text with every default and absolute file names; it loads to the same scene."""
    data = scene.model_dump(mode="json", by_alias=True, exclude_none=True)
    for section, key in _FILES:
        if key in data[section]:
            data[section][key] = str(scene.path(data[section][key]))
    replace_paths(data, lambda name: str(scene.path(name)))
    file, colon, name = data["tissue"].get("energy", "").rpartition(":")
    if colon:
        data["tissue"]["energy"] = f"{scene.path(file)}:{name}"
    lines = [f"{key} = {toml_value(value)}" for key, value in data.items() if not isinstance(value, dict)]
    for section, table in data.items():
        if isinstance(table, dict):
            lines += ["", f"[{section}]"] + [f"{_key(key)} = {toml_value(value)}" for key, value in table.items()]
    return "\n".join(lines) + "\n"


def _read(file: Path) -> dict[str, Any]:
    try:
        return parse_toml(read_text(file))
    except FileNotFoundError:
        near = difflib.get_close_matches(file.stem, shipped_scenes(), n=1)
        hint = f"; did you mean {near[0]}?" if near else "; give the path of a TOML scene file"
        raise SceneError(f"{file}: there is no such scene file{hint}") from None
    except OSError as error:
        raise SceneError(f"{file}: the scene file cannot be read ({error.strerror})") from None
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{file}: the scene file is not valid TOML: {error}") from None
    except ValueError as error:
        raise SceneError(f"{file}: the scene file {error}") from None


def _apply(data: dict[str, Any], override: str) -> None:
    key, equals, text = (part.strip() for part in override.partition("="))
    parts = key.split(".")
    if not equals or not text or not all(parts):
        raise SceneError(f"--set {shortened(override)}: it must read section.key=value")
    node: Any = data
    for done, part in enumerate(parts[:-1], start=1):
        node = _child(node, part, override, ".".join(parts[:done]))
    last = parts[-1]
    if isinstance(node, list):
        node[_index(node, last, override)] = _parse(text, override)
    else:
        node[last] = _parse(text, override)


def _child(node: Any, part: str, override: str, path: str) -> Any:
    child = node[_index(node, part, override)] if isinstance(node, list) else node.setdefault(part, {})
    if not isinstance(child, dict | list):
        raise SceneError(f"--set {shortened(override)}: {path} is {_show(child)}, which has no keys; set {path} itself")
    return child


def _index(node: list[Any], part: str, override: str) -> int:
    if not part.isdecimal() or len(part) > 9 or int(part) >= len(node):
        raise SceneError(f"--set {shortened(override)}: '{shortened(part)}' must be an index below {len(node)}")
    return int(part)


def _parse(text: str, override: str) -> Any:
    try:
        table = parse_toml(f"value = {text}")
    except tomllib.TOMLDecodeError:
        if re.fullmatch(r"[A-Za-z_./~][A-Za-z0-9_./~+-]*", text):  # the shell ate the quotes
            return text
        form = f"write [{shortened(text)}]" if re.fullmatch(r"[^,\[\]]+(,[^,\[\]]+)+", text) else "a text is '\"...\"'"
        raise SceneError(f"--set {shortened(override)}: '{shortened(text)}' is not a TOML value; {form}") from None
    except ValueError as error:
        raise SceneError(f"--set {shortened(override)}: it {error}") from None
    if table.keys() != {"value"}:
        raise SceneError(f"--set {shortened(override)}: it must have one value")
    return table["value"]


def _explain(error: ValidationError, data: dict[str, Any]) -> str:
    """The first problem as a sentence, and how many more there are; misspelled keys come first.

    A key that is missing because it is misspelled counts once.
    """
    problems: dict[str, str] = {}
    misspelled, missing = [], []
    for item in error.errors(include_url=False):
        kind, message = item["type"], item["msg"]
        path, value = _locate(item["loc"], data, kind)
        dotted = ".".join(path)
        if kind == "extra_forbidden":
            text = f"{dotted} is not a key; {_suggest(path)}"
            misspelled.append(text)
        elif kind == "missing":
            text = f"{dotted} is missing; {_purpose(path)}"
            missing.append(dotted)
        elif kind == "value_error":
            reason = message.removeprefix("Value error, ")
            text = f"{dotted} {reason}" if reason.startswith("'") else ".".join(filter(None, [dotted, reason]))
        else:
            text = _EXPECTED.get(kind) or re.sub(r"^(Input|List|String) should (be |have )?", "", message)
            verb = "have" if kind.startswith(("too_", "string_too_")) else "be"
            text = text.replace("greater than", ">").replace("> or equal to", ">=").replace("less than", "<")
            text = text.replace(" after validation", "")
            text = (
                f"{problems[dotted].partition('; write ')[0]} or {text}"
                if dotted in problems
                else f"{dotted} is {_show(value)}; it must {verb} {text}"
            )
        if kind == "missing" or kind.endswith("_type") or kind.startswith("too_"):
            text += next((f"; write {form}" for key, form in _FORMS.items() if f"{dotted}.".startswith(f"{key}.")), "")
        problems[dotted] = text
    meant = [key for key in missing if any(text.endswith(f"did you mean {key}?") for text in misspelled)]
    first = next(iter(misspelled or problems.values()))
    more = len(problems) - len(meant) - 1
    return first + (f"; {more} more key{'s are' if more > 1 else ' is'} wrong" if more else "")


def _show(value: Any) -> str:
    return shortened(toml_value(value) if isinstance(value, dict | list | str | bool | int | float) else str(value))


def _locate(loc: tuple[int | str, ...], data: Any, kind: str) -> tuple[list[str], Any]:
    """Path and value of an error; names of union branches, which are no keys, drop out."""
    path: list[str] = []
    for part in loc:
        if isinstance(data, dict) and (part in data or kind == "missing"):
            path.append(str(part))
            data = data.get(part)
        elif isinstance(data, list) and isinstance(part, int):
            path.append(str(part))
            data = data[part]
    return path, data


def _model(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as `list[Section]` or `Section | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := _model(part))), None)


def unit_of(key: str) -> str:
    """Unit of a key, "Pa" of ``tissue.material.mu``; empty where it has none."""
    *path, name = key.split(".")
    description = "[Pa]" if name == "young" else _fields(path).get(name, (None, ""))[1]
    unit = re.search(r"\[([^]]+)\]", description)
    return unit[1] if unit is not None and unit[1] not in ("no unit", "1") else ""


def _fields(path: Sequence[str]) -> dict[str, tuple[Any, str]]:
    """TOML keys below a path, with annotation and description."""
    model: type[BaseModel] | None = Scene
    skip = False
    for part in path:
        if skip or part.isdecimal():  # a layer's own name, or an index
            skip = False
            continue
        if model is None or part not in (known := _keys(model)):
            return {}
        skip = "dict[" in str(known[part][0])
        model = _model(known[part][0])
    return {} if model is None else _keys(model)


def _keys(model: type[BaseModel]) -> dict[str, tuple[Any, str]]:
    return {f.alias or name: (f.annotation, f.description or "") for name, f in model.model_fields.items()}


def _below(path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Keys below a table, those of layers left out."""
    for name in _fields(path):
        yield (*path, name)
        if name != "layers":
            yield from _below((*path, name))


def _suggest(path: Sequence[str]) -> str:
    known = _fields(path[:-1])
    if path[-2:-1] == ["material"]:
        known = known | {"young": (float, ""), "poisson": (float, "")}
    if meant := _OTHER_WORDS.get(path[-1].lower()):
        table = [*path[:-1], "material"] if "material" in known else path[:-1]
        own = table[-1:] == ["material"] == meant.split(".")[-2:-1]  # that of the layer
        return f"did you mean {'.'.join([*table, meant.rpartition('.')[2]]) if own else meant}?"
    if len(path) == 1 and (below := next((p for p in _below() if p[-1] == path[0]), None)):
        return f"did you mean {'.'.join(below)}?"
    near = difflib.get_close_matches(path[-1], known, n=1, cutoff=ALIKE)
    near = near or [name for name in known if _akin(path[-1], name)]
    if near:
        return f"did you mean {'.'.join([*path[:-1], near[0]])}?"
    elsewhere = [p for p in _below() if _akin(path[-1], p[-1])]
    if 0 < len(elsewhere) <= TABLES:
        return f"did you mean {'.'.join(elsewhere[0])}?"
    return f"keys of {'.'.join(path[:-1]) or 'a scene'} are {', '.join(known)}"


def _akin(word: str, name: str) -> bool:
    """Whether one is a part of the other: youngs_modulus and young, strain and finite_strain."""
    part, whole = sorted((word.lower(), name.lower()), key=len)
    return len(part) >= PART and part in whole


def _purpose(path: Sequence[str]) -> str:
    known = _fields(path[:-1])
    if path[-1] not in known:
        return "give it"
    annotation, description = known[path[-1]]
    choices = _choices(annotation)
    return f"give {description.removesuffix(' [no unit]')}" + (f": {', '.join(choices)}" if choices else "")


def _choices(annotation: Any) -> list[str]:
    """The values of a Literal, also inside an annotation such as `Literal["auto"] | bool`."""
    if get_origin(annotation) is Literal:
        return [repr(value) for value in get_args(annotation)]
    return [choice for part in get_args(annotation) for choice in _choices(part)]


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else toml_value(key)


def toml_value(value: Any) -> str:
    """A value as TOML writes it in one line."""
    if isinstance(value, dict):
        inner = ", ".join(f"{_key(key)} = {toml_value(item)}" for key, item in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
