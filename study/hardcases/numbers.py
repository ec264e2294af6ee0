"""Hard case: NaN and infinity in every number that a user can write, found by walking the JSON schema."""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from pydantic import TypeAdapter, ValidationError

from softgrasp.fem.errors import SceneError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import scene_schema
from softgrasp.study.hardcases.cases import Family, HardCase, Outcome, here, make, textbook
from softgrasp.study.hardcases.textbook import textbook_midpoint

BAD = ("nan", "inf", "-inf")
SCENE = """
name = "every key"
[tissue]
size = [1.0, 2.0]
cells = [2, 4]
material = { lambda = 50.0, mu = 50.0, rho = 1.0 }
[tissue.layers.low]
box = [[0.0, 0.0], [1.0, 0.5]]
material = { lambda = 90.0, mu = 20.0, rho = 2.5 }
[contact]
sides = ["left", "right"]
box = [[0.0, 1.5], [1.0, 2.0]]
[hand]
mass = 20.0
[effects]
gravity = { g = [0.0, -9.0] }
damping = { kind = "rayleigh", beta = 0.01, alpha = 0.4 }
[motion]
target = [5.0, 3.0]
[time]
steps = 5
[control]
outputs = [{ kind = "node", point = [0.5, 0.0] }]
"""


def numeric_keys() -> list[tuple[str, str, str]]:
    """Every numeric key of a scene as (dotted path, number or integer, TOML text with %s for the value)."""
    schema = scene_schema()
    keys = sorted({key for key in _walk(schema, schema["$defs"], "") if not key[0].endswith((".young", ".poisson"))})
    for part in ("tissue.material", "tissue.layers.low.material"):  # the other way to write a material
        keys.append((f"{part}.young", "number", "{young=%s, poisson=0.3, rho=1.0}"))
        keys.append((f"{part}.poisson", "number", "{young=1.0, poisson=%s, rho=1.0}"))
    return keys


def _walk(node: dict[str, Any], definitions: dict[str, Any], path: str) -> Iterator[tuple[str, str, str]]:
    if "$ref" in node:
        node = definitions[node["$ref"].rsplit("/", 1)[-1]]
    for choice in node.get("anyOf", []):
        yield from _walk(choice, definitions, path)
    kind = node.get("type")
    if kind in ("number", "integer"):
        yield path, kind, "%s"
    elif kind == "array":
        copies = max(2, node.get("minItems", 0))
        for inner, what, text in _walk(node["items"], definitions, "@"):
            if inner == "@":
                rest = ", ".join([text.replace("%s", "1" if what == "integer" else "1.0")] * (copies - 1))
                yield path, what, f"[{text}, {rest}]"
            else:
                yield f"{path}.0{inner[1:]}", what, text
    for key, part in node.get("properties", {}).items():
        yield from _walk(part, definitions, f"{path}.{key}".lstrip("."))
    if isinstance(node.get("additionalProperties"), dict):
        yield from _walk(node["additionalProperties"], definitions, f"{path}.low")


def accepted(file: Path, path: str, text: str) -> list[str]:
    """The bad values that a key takes, or refuses without naming the key."""
    key = path.rsplit(".", 1)[0] if text.startswith("{") else path
    result = []
    for value in BAD:
        try:
            load_scene(file, [f"{key}={text % value}"])
        except SceneError as error:
            if path not in str(error):
                result.append(f"{path} = {value}: {error}")
        else:
            result.append(f"{path} = {value}")
    return result


def type_check_accepts(kind: str) -> int:
    """How many of the bad values a type check alone takes: TOML has them, and they are floats."""
    adapter: TypeAdapter[Any] = TypeAdapter(float if kind == "number" else int)
    count = 0
    for value in BAD:
        with suppress(ValidationError):
            adapter.validate_python(tomllib.loads(f"x = {value}")["x"])
            count += 1
    return count


def number_rows(quick: bool) -> Iterator[HardCase]:
    """One row a section of the scene; then files and forces with NaN."""
    keys = numeric_keys()
    sections = list(dict.fromkeys(path.split(".", 1)[0] for path, _, _ in keys))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        file.write_text(SCENE)
        load_scene(file)
        for i, section in enumerate(sections):
            own = [key for key in keys if key[0].split(".", 1)[0] == section]
            taken = [note for path, _, text in own for note in accepted(file, path, text)]
            answer = Outcome(float(len(taken)), taken[0] if taken else "")
            accepts = Outcome(float(sum(type_check_accepts(kind) for _, kind, _ in own)))
            reason = "every one must be refused, and the sentence must name the key"
            yield HardCase(f"[{section}], {len(own)} keys", i + 1, answer, accepts, 0.0, reason)
        yield from _file_rows(Path(folder), file, len(sections) + 1)
    yield _force_row(len(sections) + 3)


def _file_rows(folder: Path, scene: Path, at: int) -> Iterator[HardCase]:
    """NaN in a trajectory and in a mesh file."""
    (folder / "hand.csv").write_text("0,0,0\n0.5,nan,0\n1,1,1\n")
    (folder / "body.mesh").write_text(
        "MeshVersionFormatted 2\nDimension 2\nVertices\n4\n0 0 0\n1 0 0\n1 nan 0\n0 2 0\n"
        "Triangles\n2\n1 2 3 0\n1 3 4 0\nEnd\n"
    )
    motion = ["motion={profile='csv', csv='hand.csv'}"]
    mesh = ["tissue={mesh='body.mesh', material={lambda=1.0, mu=1.0, rho=1.0}}", "contact={sides=['left']}"]

    def run(changes: list[str]) -> float:
        simulate(build(load_scene(scene, changes), comm=MPI.COMM_SELF))
        return 1.0

    def read() -> float:
        return float(np.isnan(np.genfromtxt(folder / "hand.csv", delimiter=",")).sum())

    reason = "a file must be refused before the first step"
    lines = (folder / "body.mesh").read_text().split()
    taken = Outcome(float(sum(not np.isfinite(float(x)) for x in lines if x[0].isdigit() or x == "nan")))
    yield HardCase("NaN in a trajectory file", at, here(lambda: run(motion)), textbook(read), None, reason)
    yield HardCase("NaN in a mesh file", at + 1, here(lambda: run(mesh)), taken, None, reason)


def _force_row(at: int) -> HardCase:
    """A controller that gives NaN in the middle of a run."""
    model = make("paper_forward", "tissue.cells=[2, 4]", "time.steps=60")

    def run() -> float:
        simulate(model, force=lambda n, t, q, v: np.full(2, np.nan if n == 30 else 1.0))
        return 1.0

    def loop() -> float:
        z = np.full(model.system.layout.n_e, np.nan)
        return textbook_midpoint(to_scipy(model.system.M_ee), to_scipy(model.system.K_ee), z, 0.1, 5)

    reason = "the run must stop and not write NaN as a result"
    return HardCase("feedback that turns NaN at step 30", at, here(run), textbook(loop), None, reason)


FAMILIES = (
    Family("numbers", "NaN and infinity in every numeric key", "section", "bad values taken", "type check alone",
           "NaN is a float to TOML and to every type check; each key has to ask for a finite number.", number_rows,
           axis="listed"),
)  # fmt: skip
