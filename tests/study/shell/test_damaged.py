"""Every kind of file that the program reads, cut, flipped, emptied, exchanged: refused with one sentence, or right.

A file with checksums gives what was written or a sentence. One that people write (scene, table, mesh) has none, so a
changed digit is another valid file: it must end in a value or a sentence.
"""

from __future__ import annotations

import json
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

import softgrasp as sg
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.mesh.file import load_arrays
from softgrasp.fem.owned import LIST, LOCK, hold, own_files, release
from softgrasp.fem.run.simulate import RunOptions
from softgrasp.fem.scene.table import read_csv
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.reduction.archive import save
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.study.precision.cache import Cache
from softgrasp.study.query.request import read_batch
from softgrasp.study.runs.listing import compare, runs_below
from softgrasp.study.runs.run import run_sweep
from softgrasp.study.runs.sweep import Sweep, parse_axes, read_points
from softgrasp.study.shell.folder import read_result
from tests.helpers.certified import ritz
from tests.reduction.strain.test_strain import model_of

pytestmark = pytest.mark.serial
SCENE = sg.fem.scene.file.shipped_scenes()["paper_forward"]
SMALL = ["tissue.cells=[2,4]", "time.steps=12", "output.frames=2"]
QUIET = Console(quiet=True)
LIMIT = 60  # [s] on the clock, of a read that takes far below one: a hang
FEW, MANY = 6, 60


@dataclass(frozen=True)
class Kind:
    """A kind of file."""

    file: Path  # the good one
    read: Callable[[Path], Any]  # of a folder like that of the good one
    top: Path  # folder that is copied
    sealed: bool = True  # a wrong value is a defect, not another valid file


def flat(value: Any) -> Any:
    """A value that == compares: arrays by their bytes, objects by their attributes."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes() if value.dtype != object else value.tolist()
    if isinstance(value, dict):
        return {str(key): flat(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [flat(item) for item in value]
    return flat(vars(value)) if type(value).__module__.startswith("softgrasp") else repr(value)


@contextmanager
def within(seconds: int) -> Iterator[None]:
    def late(number: int, frame: Any) -> None:
        raise AssertionError("the file was not read to an end")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes after one accident."""
    n, at = len(data), int(rng.integers(0, len(data)))
    wide = int(rng.integers(1, max(2, n // 4)))
    what = int(rng.integers(0, 9))
    if what == 0:
        return data[:at]
    if what == 1:
        return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(0, 8)))]) + data[at + 1 :]
    if what == 2:
        return data[:at] + bytes(min(wide, n - at)) + data[at + wide :]
    if what == 3:
        return data[:at] + rng.bytes(min(wide, n - at)) + data[at + wide :]
    if what == 4:
        return data[:at] + data[at + wide :]
    if what == 5:
        return data + data[at:]
    if what == 6:
        return rng.choice([b"", b"\0", b"[]", b"null", b"{}", b"1", b"\xff\xfe", b"[" * 5000])
    words = [b"nan", b"-1", b"1e999", b'"text"', b"[]", b"null", b"9" * 400, b"{}", b"\n", b",", b"true"]
    if what == 7:  # a number becomes another word
        starts = [i for i in range(n) if data[i : i + 1].isdigit() and not data[i - 1 : i].isdigit()] or [at]
        begin = int(rng.choice(starts))
        end = next((i for i in range(begin, n) if data[i : i + 1] not in b"0123456789.eE+-"), n)
        return data[:begin] + rng.choice(np.array(words, dtype=object)) + data[end:]
    lines = data.splitlines(keepends=True)
    i, j = rng.integers(0, len(lines), 2)
    lines[i], lines[j] = lines[j], lines[i]
    return b"".join(lines)


def exchanged(file: Path, rng: np.random.Generator) -> bool:
    """Another accident of an HDF5 file: datasets exchanged, of another type or shape, gone or not finite."""
    names: list[str] = []
    with h5py.File(file, "r+") as opened:
        opened.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        name, other = (str(x) for x in rng.choice(names, 2))
        value, what = opened[name][()], int(rng.integers(0, 5))
        put = {0: opened[other][()], 1: np.asarray(value).astype("S8"), 2: np.asarray(value).ravel()[:1]}
        put[3] = np.full_like(np.asarray(value, dtype=float), np.nan)
        del opened[name]
        if what in put:
            opened[name] = put[what]
    return what != 0 or name != other


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Kind]:
    """The good files."""
    top = tmp_path_factory.mktemp("good")

    def folder(name: str) -> Path:
        (top / name).mkdir()
        return top / name

    made: dict[str, Kind] = {}
    text = folder("scene") / "my.toml"
    text.write_text(SCENE.read_text())
    made["scene"] = Kind(text, lambda at: sg.load_scene(at / "my.toml"), text.parent, False)
    table = folder("motion") / "hand.csv"
    table.write_text("t,x,y\n" + "".join(f"{t / 10},{t * 0.1},{t * 0.01}\n" for t in range(20)))
    made["motion"] = Kind(table, lambda at: read_csv(at / "hand.csv", 2, 1.0), table.parent, False)
    import meshio

    points = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]], dtype=float)
    strip = meshio.Mesh(points, [("triangle", [[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])])
    for suffix in ("msh", "vtu", "inp", "mesh", "vtk", "xdmf"):
        body = folder(f"mesh-{suffix}") / f"body.{suffix}"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            strip.write(body, "gmsh" if suffix == "msh" else None)
        made[f"mesh .{suffix}"] = Kind(
            body, lambda at, name=body.name: load_arrays(at / name, 1.0, repair=False, limit=2.0), body.parent, False
        )
    body = folder("mesh-ansys") / "body.msh"
    strip.write(body, "ansys", binary=False)
    made["mesh .msh of Ansys"] = Kind(
        body, lambda at: load_arrays(at / "body.msh", 1.0, repair=False, limit=2.0), body.parent, False
    )
    batch = folder("batch") / "batch.csv"
    batch.write_text("lambda [Pa],mu\n" + "".join(f"{50 + i},{40.5 + i}\n" for i in range(12)))
    made["batch table"] = Kind(batch, lambda at: read_batch(at / "batch.csv"), batch.parent, False)
    add_runs(made, folder)
    add_models(made, folder)
    add_gains(made, folder)
    return made


def add_runs(made: dict[str, Kind], folder: Callable[[str], Path]) -> None:
    """Files of runs."""
    model, stopped = sg.build(SCENE, [*SMALL, "output.snapshots='hdf5'"]), folder("restart")
    with pytest.raises(SoftgraspError):
        sg.simulate(model, RunOptions(stopped, until=6))

    def resumed(at: Path) -> Any:
        run = sg.simulate(model, RunOptions(at, resume=True))
        with h5py.File(at / "snapshots-rank0.h5") as file:
            return run.final, run.outputs, file["Z"][()]

    (arrays,) = (stopped / "checkpoint").glob("*.npz")
    made["restart arrays"] = Kind(arrays, resumed, stopped)
    made["restart manifest"] = Kind(stopped / "checkpoint" / "checkpoint.json", resumed, stopped)
    made["snapshots"] = Kind(stopped / "snapshots-rank0.h5", resumed, stopped)
    out = folder("run")
    from softgrasp.study.forward.run import run_simulate

    run_simulate(SCENE, out, SMALL, QUIET, quiet=True, pictures=False)

    def seen(at: Path) -> Any:
        pytest.importorskip("pyvista")
        from softgrasp.study.pictures.view import Move

        move = Move(at, "von_mises")
        return [(move.label(i), np.asarray(move.body(i).points)) for i in range(len(move.times))]

    def compared(at: Path) -> Any:
        found = compare(at, out)
        return len(runs_below(at)[0].rows), found.keys.rows, found.numbers.rows, found.traces

    made["fields .vtu"] = Kind(out / "fields" / "000001.vtu", seen, out)
    made["fields .pvd"] = Kind(out / "fields.pvd", seen, out)
    made["result.json"] = Kind(out / "result.json", lambda at: (read_result(at), compared(at)), out, False)
    made["trajectory.csv"] = Kind(out / "trajectory.csv", compared, out, False)
    made["scene.toml of a run"] = Kind(out / "scene.toml", compared, out, False)
    made["list of files"] = Kind(out / LIST, lambda at: own_files(at), out, False)

    def held(at: Path) -> None:
        hold(at)
        release()

    (lock := folder("lock") / LOCK).write_text(json.dumps({"host": "x", "pid": 1, "started": 1.0}))
    made["lock"] = Kind(lock, held, lock.parent, False)
    swept, axes = folder("sweep"), ["tissue.material.mu=20:60:3"]
    run_sweep(SCENE, swept, SMALL, QUIET, axes=axes, quiet=True, pictures=False)
    sweep = Sweep(SCENE, SMALL, parse_axes(axes))
    points = read_points(sweep, swept)
    assert len(points) == 3

    def known(at: Path) -> bool:
        again = read_points(sweep, at)
        return all(flat(points[key]) == flat(point) for key, point in again.items())  # the others are run again

    made["points of a sweep"] = Kind(swept / "points-0.jsonl", known, swept)


@dataclass(frozen=True)
class Measured:
    """A point as a study keeps it."""

    error: float  # relative
    name: str  # of a method


def add_models(made: dict[str, Kind], folder: Callable[[str], Path]) -> None:
    """Files of models, controllers and studies."""
    model = sg.build(SCENE, SMALL)
    linear, strain, certified = (folder(name) / "rom.h5" for name in ("linear", "strain", "certified"))
    save(sg.reduce(model, sg.simulate(model), "psd", N=8), linear)
    save(model_of(), strain)
    save_certified(ritz(sg.build(SCENE, [*SMALL, "effects.damping={kind='kelvin-voigt', beta=0.01}"]), 2, 4), certified)
    layout = model.system.layout
    made["linear model"] = Kind(linear, lambda at: sg.load(at / "rom.h5", layout), linear.parent)
    made["strain model"] = Kind(strain, lambda at: sg.load(at / "rom.h5"), strain.parent)
    made["certified model"] = Kind(certified, lambda at: load_certified(at / "rom.h5"), certified.parent)
    kept = folder("controller")
    from softgrasp.study.control.run import run_control

    paper = sg.fem.scene.file.shipped_scenes()["paper_lqr"]
    run_control(paper, kept, SMALL[:1], QUIET, quiet=True, pictures=False, gain_only=True)
    made["controller"] = Kind(kept / "controller.npz", lambda at: sg.Controller.load(at / "controller.npz"), kept)
    cache = folder("cache")

    def measured(at: Path) -> Any:
        store = Cache(at, MPI.COMM_SELF, model.scene)
        return store.get("run", {"n": 1}, Measured, lambda: [Measured(0.125, "psd"), Measured(3.5, "pod")])

    measured(cache)
    made["cache of a study"] = Kind(next(cache.glob("*.json")), measured, cache)


def add_gains(made: dict[str, Kind], folder: Callable[[str], Path]) -> None:
    """Restart files of Newton's method with ADI."""
    damped = "effects.damping={kind='kelvin-voigt', beta=0.01}"
    problem, stopped = sg.problem(sg.build("paper_lqr", ["tissue.cells=[4,8]", damped])), folder("newton")

    def stop(entry: dict[str, float]) -> None:
        if entry["solve"] == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        NewtonADI(checkpoint=stopped, checkpoint_every=4, checkpoint_after=0.0, progress=stop).solve(problem)

    def resumed(at: Path) -> Any:
        found = NewtonADI(checkpoint=at).solve(problem)
        return found.gain.K_s, found.residual, found.counts

    made["restart arrays of a gain"] = Kind(next(stopped.glob("*.npz")), resumed, stopped)
    made["restart manifest of a gain"] = Kind(stopped / "newton.json", resumed, stopped)


NAMES = (
    "scene", "motion", "mesh .msh", "mesh .vtu", "mesh .inp", "mesh .mesh", "mesh .vtk", "mesh .xdmf",
    "restart arrays", "restart manifest", "snapshots", "fields .vtu", "fields .pvd", "result.json", "trajectory.csv",
    "scene.toml of a run", "list of files", "lock", "points of a sweep", "linear model", "strain model",
    "certified model", "controller", "cache of a study", "mesh .msh of Ansys", "batch table",
    "restart arrays of a gain", "restart manifest of a gain",
)  # fmt: skip


def outcome(kind: Kind, at: Path, right: Any) -> str:
    """What came of a damaged file: refused or right, or else what is wrong."""
    try:
        with within(LIMIT), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            value = kind.read(at)
    except SoftgraspError as error:
        text = str(error)
        single = text and "\n" not in text and "Traceback" not in text
        return "refused" if single else f"a sentence that is none: {text!r}"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        return f"{type(error).__name__}: {error}"
    finally:
        release()
    return "right" if not kind.sealed or flat(value) == right else "a wrong value"


def tried(kind: Kind, tmp_path: Path, count: int) -> dict[str, int]:
    """Outcomes of so many accidents; the defects fail with their number."""
    shutil.copytree(kind.top, tmp_path / "good")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            right = flat(kind.read(tmp_path / "good"))
        except SoftgraspError:
            assert kind.file.name == LOCK  # one of another machine is refused
            right = None
    release()
    counts = {"refused": 0, "right": 0}
    for number in range(count):
        rng, at = np.random.default_rng([number, count]), tmp_path / str(number)
        shutil.copytree(kind.top, at)
        file = at / kind.file.relative_to(kind.top)
        if not (file.suffix == ".h5" and number % 3 == 0 and exchanged(file, rng)):
            file.write_bytes(damaged(kind.file.read_bytes(), rng))
        said = outcome(kind, at, right)
        assert said in counts, f"{kind.file.name}, accident {number}: {said}"
        counts[said] += 1
        shutil.rmtree(at)
    return counts


@pytest.mark.parametrize("name", NAMES)
def test_some_damaged_files_are_refused_or_right(kinds: dict[str, Kind], name: str, tmp_path: Path) -> None:
    assert set(kinds) == set(NAMES)
    assert sum(tried(kinds[name], tmp_path, FEW).values()) == FEW


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_sixty_damaged_files_of_each_kind(
    kinds: dict[str, Kind], name: str, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    counts = tried(kinds[name], tmp_path, MANY)
    record_property("outcomes", counts)
    print(f"{name}: {counts['refused']} refused, {counts['right']} right")  # noqa: T201  shown by -s
    assert sum(counts.values()) == MANY


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("mesh")])
def test_a_pipe_is_refused_at_once(kinds: dict[str, Kind], name: str, tmp_path: Path) -> None:
    import os

    kind, at = kinds[name], tmp_path / "pipe"
    shutil.copytree(kind.top, at)
    file = at / kind.file.relative_to(kind.top)
    file.unlink()
    os.mkfifo(file)
    with within(20):
        said = outcome(kind, at, None)
    assert said == "refused" or name in ("list of files", "points of a sweep", "cache of a study", "result.json")
