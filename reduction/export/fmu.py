"""A reduced model as an FMU of FMI 3.0 [FMI3]: the C of `plant.py` behind its functions, and a binary."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from softgrasp.fem.errors import ResourceError
from softgrasp.fem.owned import note
from softgrasp.reduction.export.affine import Label, affine_plant
from softgrasp.reduction.export.c import CODE
from softgrasp.reduction.export.plant import plant_texts
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.system import ModelError

FMI = Path(__file__).parent / "fmu"
"""Folder of the code around plant.c."""
NAME = "softgrasp"  # of the model inside the file
FLAGS = ("-std=c99", "-O3", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-Wl,-Bsymbolic")
SOURCES = ("fmi3.c", "plant.c")
INPUT, OUTPUT, CONSTANT, STATE, RATE = 1000, 2000, 3000, 4000, 5000  # first value references, as in fmi3.c
UNITS: dict[str, dict[str, str]] = {  # exponents of the base units
    "m": {"m": "1"},
    "m/s": {"m": "1", "s": "-1"},
    "rad": {"rad": "1"},
    "rad/s": {"rad": "1", "s": "-1"},
    "N": {"kg": "1", "m": "1", "s": "-2"},
    "N m": {"kg": "1", "m": "2", "s": "-2"},
    "Pa": {"kg": "1", "m": "-1", "s": "-2"},
    "s": {"s": "1"},
}


@dataclass(frozen=True)
class Face:
    """What an importer sees of an FMU."""

    description: str  # in words
    tick: float  # step of co-simulation [s]
    inputs: tuple[Label, ...]  # held over a tick
    outputs: tuple[Label, ...]  # after each step
    constants: tuple[tuple[int, Label, float], ...] = ()  # place, label and value of those that may be changed
    states: tuple[float, ...] | None = None  # at the start, for model exchange; None: co-simulation alone


def write_fmu(model: ReducedModel, path: str | Path, tick: float = 1e-3) -> Path:
    """Write a file of FMI 3.0 for co-simulation and model exchange, sources and a binary for this machine inside.

    Inputs: load on the hand; outputs: hand and outputs of the scene; tunable: mu, lambda and, with damping, beta. Not
    collective.

    Args:
        model: linear reduced model.
        path: file to write, `plant.fmu`.
        tick: step of co-simulation [s]; communication steps are multiples of it.

    Raises:
        ModelError: no C compiler, the tick is no positive number, or the model cannot be exported.
        UnstableModelError: the model is unstable with its own material.
        ResourceError: the file cannot be written; what was there stays.
    """
    path, plant = Path(path), affine_plant(model, tick)
    texts = {name: (CODE / name).read_text() for name in ("plant.c", "plant.h", "vector.h")} | plant_texts(plant)
    numbers = zip(plant.constants(), plant.theta.ravel().tolist(), plant.tunable(), strict=True)
    face = Face(
        f"Hand and tissue, {plant.name}, {plant.N} states", plant.tick, plant.inputs, plant.outputs,
        tuple((i, label, value) for i, (label, value, able) in enumerate(numbers) if able),
        tuple(plant.start.tolist()),
    )  # fmt: skip
    return write_archive(path, texts, face)


def write_archive(path: Path, texts: dict[str, str], face: Face, sources: tuple[str, ...] = SOURCES) -> Path:
    """Write an FMU of texts in C and what they need of FMI. Not collective.

    Args:
        path: file to write.
        texts: files of C by name, with the interface of plant.h.
        face: what an importer sees.
        sources: names of those that are compiled.

    Raises:
        ModelError: no C compiler, or two variables have one name.
        ResourceError: the file cannot be written; what was there stays.
    """
    texts = texts | {file.name: file.read_text() for file in FMI.iterdir() if file.suffix in (".c", ".h")}
    token = "{" + hashlib.sha256("\0".join(f"{k}\0{v}" for k, v in sorted(texts.items())).encode()).hexdigest() + "}"
    texts["token.h"] = f'#define TOKEN "{token}"\n'
    texts["buildDescription.xml"] = _text(_build(sources))
    description = _description(face, token)
    names = [each.get("name") for each in description.iterfind("ModelVariables/*")]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ModelError(f"two variables of the FMU are called {twice[0]}; rename the output or the own parameter")
    fresh = path.with_name(f"new-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        note(path)
        with zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", _text(description))
            for name, text in sorted(texts.items()):
                archive.writestr(f"sources/{name}", text)
            archive.writestr(f"binaries/{platform.machine()}-linux/{NAME}.so", _compiled(texts, sources))
        fresh.replace(path)
    except OSError as error:
        raise ResourceError(f"{path} cannot be written ({error.strerror or error}); name another file") from error
    finally:
        with suppress(OSError):  # its folder may be none
            fresh.unlink()
    return path


def _compiled(texts: dict[str, str], sources: tuple[str, ...]) -> bytes:
    """The shared library of these sources. Raises ModelError: there is no compiler, or it refuses them."""
    compiler = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise ModelError("an FMU contains a binary, and there is no C compiler here; install one, or name it in CC")
    with tempfile.TemporaryDirectory() as folder:
        for name, text in texts.items():
            (Path(folder) / name).write_text(text)
        command = [*compiler.split(), *FLAGS, *sources, "-o", f"{NAME}.so"]
        try:
            subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            first = (str(getattr(error, "stderr", "") or "") or str(error)).strip().splitlines()[0]
            raise ModelError(f"{compiler} cannot compile the FMU ({first}); name another compiler in CC") from error
        return (Path(folder) / f"{NAME}.so").read_bytes()


def _build(sources: tuple[str, ...]) -> ET.Element:
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    files = ET.SubElement(ET.SubElement(root, "BuildConfiguration", modelIdentifier=NAME), "SourceFileSet")
    files.set("language", "C99")
    for name in sources:
        ET.SubElement(files, "SourceFile", name=name)
    return root


def _description(face: Face, token: str) -> ET.Element:
    """modelDescription.xml."""
    root = ET.Element(
        "fmiModelDescription", fmiVersion="3.0", modelName=NAME, instantiationToken=token, generationTool="softgrasp",
        variableNamingConvention="flat", description=face.description,
    )  # fmt: skip
    tick, own = repr(face.tick), {"modelIdentifier": NAME, "canGetAndSetFMUState": "true"}
    if face.states is not None:
        ET.SubElement(root, "ModelExchange", own)
    steps = {"canHandleVariableCommunicationStepSize": "true", "fixedInternalStepSize": tick}
    ET.SubElement(root, "CoSimulation", own | steps)
    _units(root, face)
    errors = ET.SubElement(ET.SubElement(root, "LogCategories"), "Category", name="logStatusError")
    errors.set("description", "one sentence for everything that is refused")
    ET.SubElement(root, "DefaultExperiment", startTime="0", stopTime=repr(1000 * face.tick), stepSize=tick)
    _variables(ET.SubElement(root, "ModelVariables"), face)
    structure = ET.SubElement(root, "ModelStructure")
    outputs, rates = range(OUTPUT, OUTPUT + len(face.outputs)), range(RATE, RATE + len(face.states or ()))
    for kind, references in (
        ("Output", outputs), ("ContinuousStateDerivative", rates), ("InitialUnknown", [*outputs, *rates]),
    ):  # fmt: skip
        for reference in references:
            ET.SubElement(structure, kind, valueReference=str(reference))
    return root


def _units(root: ET.Element, face: Face) -> None:
    used = {label.unit for label in (*face.inputs, *face.outputs, *(label for _, label, _ in face.constants))}
    units = ET.SubElement(root, "UnitDefinitions")
    for unit in sorted(used & set(UNITS) | {"s"}):
        ET.SubElement(ET.SubElement(units, "Unit", name=unit), "BaseUnit", UNITS[unit])


def _variables(parent: ET.Element, face: Face) -> None:
    def add(reference: int, label: Label, causality: str, **attributes: str) -> None:
        given = {"name": label.name, "valueReference": str(reference), "causality": causality} | attributes
        ET.SubElement(parent, "Float64", given | ({"unit": label.unit} if label.unit in UNITS else {}))

    add(0, Label("time", "s"), "independent", variability="continuous")
    for i, label in enumerate(face.inputs):
        add(INPUT + i, label, "input", start="0", description="held over a tick")
    for i, label in enumerate(face.outputs):
        add(OUTPUT + i, label, "output", initial="calculated")
    for i, label, value in face.constants:
        add(CONSTANT + i, label, "parameter", variability="tunable", start=repr(value))
    for i, value in enumerate(face.states or ()):
        state = Label(f"w_{i + 1}", "")
        add(STATE + i, state, "local", initial="exact", start=repr(value), description="energy coordinate")
    for i in range(len(face.states or ())):
        add(RATE + i, Label(f"der_w_{i + 1}", ""), "local", initial="calculated", derivative=str(STATE + i))


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
