"""Hard cases of what goes wrong around a run: NaN in every number a user can write, one of two ranks."""

from __future__ import annotations

import tempfile
import time
import tomllib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
from mpi4py import MPI
from pydantic import TypeAdapter, ValidationError

from softgrasp.fem.errors import SceneError, SoftgraspError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import to_scipy
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.scene.scene import scene_schema
from softgrasp.study.shell.processes import in_mpi_job, run_ranks
from tests.hardcases.cases import Family, HardCase, Outcome, here, make, short, textbook
from tests.hardcases.textbook import textbook_midpoint

BAD = ("nan", "inf", "-inf")
SCENE = """
name = "every key"
contact = { sides = ["left", "right"], box = [[0.0, 1.5], [1.0, 2.0]] }
hand = { mass = 20.0 }
motion = { target = [5.0, 3.0] }
time = { steps = 5 }
control = { outputs = [{ kind = "node", point = [0.5, 0.0] }], constraints = {} }
obstacle = [{ kind = "disc", center = [9.0, 9.0], radius = 0.5 }]
[effects]
gravity = { g = [0.0, -9.0] }
damping = { kind = "rayleigh", beta = 0.01, alpha = 0.4 }
[tissue]
size = [1.0, 2.0]
cells = [2, 4]
material = { lambda = 50.0, mu = 50.0, rho = 1.0 }
layers.low = { box = [[0.0, 0.0], [1.0, 0.5]], material = { lambda = 90.0, mu = 20.0, rho = 2.5 } }
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
    """All keys of the scene in one row, since a zero says the same of each; then files and forces with NaN."""
    keys = numeric_keys()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        file.write_text(SCENE)
        load_scene(file)
        taken = [note for path, _, text in keys for note in accepted(file, path, text)]
        answer = Outcome(float(len(taken)), taken[0] if taken else "")
        accepts = Outcome(float(sum(type_check_accepts(kind) for _, kind, _ in keys)))
        reason = "every one must be refused, and the sentence must name the key"
        yield HardCase(f"NaN and infinity in {len(keys)} keys", 1, answer, accepts, 0.0, reason)
        yield from _file_rows(Path(folder), file, 2)
    yield _force_row(4)


EXCLUSIVE = (  # what excludes each other, overrides of SCENE
    ("turning hand, finite strain", (
        "effects.rotation=true", "hand.inertia=3.0", "motion.target=[5.0, 3.0, 0.3]", "effects.finite_strain={}",
        "effects.damping=false")),
    ("turning hand without inertia", ("effects.rotation=true", "motion.target=[5.0, 3.0, 0.3]")),
    ("start in equilibrium without gravity", ("effects.gravity=false", "time.start='equilibrium'")),
    ("damped layer without damping", ("effects.damping=false", "tissue.layers.low.beta=0.1")),
    ("facet marks of a structured box", ("contact.facet_tag=3",)),
    ("thickness in 3D", (
        "tissue.size=[1.0, 1.0, 2.0]", "tissue.cells=[1, 1, 2]", "tissue.thickness=0.5", "tissue.layers={}",
        "contact={sides=['left']}", "motion.target=[1.0, 0.0, 0.0]", "effects.gravity=false", "control=false",
        "obstacle=false")),
)  # fmt: skip


def exclusive_rows(quick: bool) -> Iterator[HardCase]:
    """Effects and keys that exclude each other, each of them right by itself."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        file.write_text(SCENE)
        for i, (name, changes) in enumerate(EXCLUSIVE[::2] if quick else EXCLUSIVE):
            ours = here(lambda: float(load_scene(file, list(changes)).time_end))  # noqa: B023  (at once)
            theirs = textbook(by_schema, list(changes))
            yield HardCase(name, i + 1, ours, theirs, None, "no model is meant by both together")


def by_schema(changes: list[str]) -> Outcome:
    """What a check of the scene against its JSON schema says, key by key."""
    data = tomllib.loads(SCENE)
    for change in changes:
        path, value = change.split("=", 1)
        *parents, last = path.split(".")
        table = data
        for key in parents:
            table = table.setdefault(key, {})
        table[last] = tomllib.loads(f"x = {value}")["x"]
        if table[last] is False and last not in ("rotation", "reaction"):
            del table[last]  # false leaves an optional table out
    jsonschema.validate(data, scene_schema())
    return Outcome(None, "every key fits the schema")


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
        return simulate(build(load_scene(scene, changes), comm=MPI.COMM_SELF)).energy_drift

    read = textbook(lambda: float(np.isnan(np.genfromtxt(folder / "hand.csv", delimiter=",")).sum()))
    reason = "a file must be refused before the first step"
    lines = (folder / "body.mesh").read_text().split()
    taken = Outcome(float(sum(not np.isfinite(float(x)) for x in lines if x[0].isdigit() or x == "nan")))
    yield HardCase("NaN in a trajectory file", at, here(run, motion), read, None, reason)
    yield HardCase("NaN in a mesh file", at + 1, here(run, mesh), taken, None, reason)


def _force_row(at: int) -> HardCase:
    """A controller that gives NaN in the middle of a run."""
    model = make("paper_forward", "tissue.cells=[2, 4]", "time.steps=60")

    def run() -> float:
        return simulate(model, force=lambda n, t, q, v: np.full(2, np.nan if n == 30 else 1.0)).energy_drift

    def loop() -> float:
        z = np.full(model.system.layout.n_e, np.nan)
        return textbook_midpoint(to_scipy(model.system.M_ee), to_scipy(model.system.K_ee), z, 0.1, 5)

    reason = "the run must stop and not write NaN as a result"
    return HardCase("feedback that turns NaN at step 30", at, here(run), textbook(loop), None, reason)


# --- a rank that fails alone

# what happens, what must be said, and the same in a bare script
FAULTS: dict[str, tuple[str, str, str]] = {
    "disk": ("rank 1 cannot write its restart file", "cannot be written", 'raise OSError("disk full")'),
    "bug": ("a bug raises on rank 1 in the middle of the run", "RuntimeError", 'raise RuntimeError("a bug")'),
    "nan": ("the state of rank 1 turns NaN", "not finite", 'x = float("nan")'),
    "killed": ("rank 1 is killed by the system", "", "os.kill(os.getpid(), signal.SIGKILL)"),
}
HEALTHY_LIMIT = 600.0  # [s] for the run without a fault
# Times of a run without a fault on the same machine, measured just before, so that no bound judges the machine. A job
# that ends early needs less than one; the rest is for other work that comes in between. One that hangs never ends.
PATIENCE = 20.0
BARE_PATIENCE = 1.0  # the bare script only starts, which is a part of the run
BARE = """
import os, signal
from mpi4py import MPI
x = 1.0
if MPI.COMM_WORLD.rank == 1:
    {fault}
print(MPI.COMM_WORLD.allreduce(x))
"""
FAULTY = ["-m", "tests.hardcases.faulty"]  # then fault and folder


def healthy_seconds() -> float:
    """Seconds of the command on two ranks without a fault: what this machine needs, loaded as it is."""
    with tempfile.TemporaryDirectory() as folder:
        status, output, seconds = job([*FAULTY, "", folder], HEALTHY_LIMIT)
    if status != 0:
        said = output.strip().splitlines()[-1:] or ["it says nothing"]
        raise SoftgraspError(f"a run on two ranks without a fault fails, status {status}: {said[0]}")
    return seconds


def job(command: list[str], limit: float) -> tuple[int | None, str, float]:
    """Run two ranks for at most ``limit`` [s]; status, None when that was not enough, output and seconds."""
    begin = time.perf_counter()
    status, output = run_ranks(command, 2, limit)
    return status, output, time.perf_counter() - begin


def ending(command: list[str], patience: float, healthy: float, sentence: str) -> Outcome:
    """Time until both ranks have ended over that of a healthy run, or why that is no good end."""
    status, output, seconds = job(command, patience * healthy)
    if status is None:
        return Outcome(float("inf"), f"hangs, still waiting after {patience:g} times a healthy run")
    if status == 0:
        return Outcome(None, "status 0, the fault goes unnoticed")
    if sentence not in output:
        return Outcome(None, f"ended without saying '{sentence}'")
    said = next((line.strip() for line in output.splitlines() if sentence and sentence in line), f"status {status}")
    return Outcome(seconds / healthy, short(said))


def rank_rows(quick: bool) -> Iterator[HardCase]:
    """Two ranks, one of them fails; all must end, with a status and a sentence."""
    if in_mpi_job():
        return  # an MPI job cannot start another one
    healthy = healthy_seconds()
    reason = "all ranks must end sooner than a healthy run, times what other work may slow it down"
    for i, fault in enumerate(["disk"] if quick else list(FAULTS)):
        text, sentence, same = FAULTS[fault]
        with tempfile.TemporaryDirectory() as folder:
            outcome = ending([*FAULTY, fault, folder], PATIENCE, healthy, sentence)
        bare = textbook(ending, ["-c", BARE.format(fault=same)], BARE_PATIENCE, healthy, "")
        yield HardCase(text, i + 1, outcome, bare, PATIENCE, reason)


FAMILIES = (
    Family("numbers", "NaN and infinity in every numeric key", "place", "bad values accepted", "type check alone",
           "NaN is a float to TOML and to every type check; each key has to ask for a finite number.", number_rows,
           axis="listed"),
    Family("exclusive", "Effects and keys that exclude each other", "pair", "must be refused", "the JSON schema",
           "Each key is right by itself, so a schema takes them all; the sentence here names both.",
           exclusive_rows, axis="listed"),
    Family("rank", "A rank that fails alone", "fault", "time until all ranks have ended / time of a healthy run",
           "bare mpi4py script",
           "In a bare script the healthy rank waits for ever, or goes on with the NaN of the other; here all ranks "
           "agree on the failure or are ended.",
           rank_rows, axis="listed"),
)  # fmt: skip
