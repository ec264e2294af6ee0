"""Random queries against full runs of the scene itself: no bound lies below the truth, at any step, motion or batch.

`make test` asks a few; `pytest -m slow tests/study/query/test_random_queries.py --queries 500 --seed 1` asks many and,
with -s, prints how far the bounds lie above the truth.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from rich.console import Console

from softgrasp.fem.columns import label_unit
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.reduction.certified.archive import load_certified, save_certified
from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
from softgrasp.reduction.certified.motion import Materials
from softgrasp.reduction.certified.training import certified_model
from softgrasp.reduction.certified.validation import true_error
from softgrasp.reduction.parameters import materials_at
from softgrasp.reduction.replay import FullRun
from softgrasp.study.query.request import drive_of
from softgrasp.study.query.run import run_query

SMALL = ["tissue.cells=[4, 8]", "time.steps=90"]
SCENES = {
    "undamped": SMALL,
    "kelvin-voigt": [*SMALL, "effects.damping={kind='kelvin-voigt', beta=0.002}"],
    "falling": [
        *SMALL, "effects.gravity={g=[1.0, -9.0]}", "time.start='equilibrium'",
        "effects.damping={kind='rayleigh', beta=0.004, alpha=0.4, drag='space'}",
    ],
    "pushed": [*SMALL, "motion.drive='force'", "time.end=4.0"],
    "pushed by a table": [*SMALL, "motion={profile='csv', csv='own.csv', drive='force'}", "time.end=3.0"],
    "led by a table": [*SMALL, "motion={profile='csv', csv='own.csv'}", "time.end=3.0"],
}  # fmt: skip
TABLE = np.array([[0, 0, 0], [0.4, 1, 2], [0.5, 3, -1], [1.1, 0, 1], [1.7, 5, 2], [2.3, 4, 4], [3, 5, 3]], dtype=float)
# modes of the answer, of the proof, of 78, and whether there are duals of the outputs
MODES = (60, 77, False), (16, 40, True)
ROUNDING = 1e-9  # of the largest output, or energy norm: full runs solve to rounding
KINDS = ("plain", "dt", "motion", "motion and dt", "batch", "batch and dt")


@cache
def made(name: str, folder: Path) -> tuple[Model, CertifiedModel, Path]:
    """Scene, certified model as a query reads it from its file, and the file."""
    np.savetxt(folder / "own.csv", TABLE, delimiter=",")
    (folder / "scene.toml").write_text(shipped_scenes()["paper_forward"].read_text().replace("target", "# target"))
    overrides = ["motion.target=[5, 3]"] * ("table" not in name)
    model = build(load_scene(folder / "scene.toml", [*overrides, *SCENES[name]]), comm=MPI.COMM_SELF)
    box, (k, k2, duals) = ParameterDomain((30.0, 500.0), (20.0, 500.0)), MODES[name in ("kelvin-voigt", "falling")]
    Phi, places = lowest_modes(model.system, k2)[1], [materials_at(model, x, y) for x in box.lam for y in box.mu]
    save_certified(certified_model(model, Phi, k=k, box=box, places=places * duals), folder / f"{name}.h5")
    return model, load_certified(folder / f"{name}.h5", model.system.layout), folder / f"{name}.h5"


@dataclass(frozen=True)
class Question:
    """One random query."""

    kind: str  # one of KINDS
    settings: list[dict[str, float]]  # of every parameter
    dt: float | None  # --dt [s]
    motion: Path | None  # --motion


def question(rng: np.random.Generator, model: Model, folder: Path) -> Question:
    """A query at random, in the box or somewhat outside it."""
    kind, end, motion, dt = str(rng.choice(KINDS)), model.scene.time_end, None, None
    settings = [
        {"lambda": float(np.exp(rng.uniform(*np.log([20, 700])))), "mu": float(np.exp(rng.uniform(*np.log([15, 700]))))}
        | ({"rho": float(rng.uniform(0.5, 2))} if rng.random() < 0.2 else {})
        for _ in range(int(rng.integers(2, 5)) if "batch" in kind else 1)
    ]
    if "motion" in kind:
        end, rows = float(rng.uniform(1.0, 4.0)), int(rng.integers(5, 20))
        t = np.linspace(0, end, rows)
        values = np.cumsum(rng.standard_normal((rows, 2)), axis=0) * (t[:, None] > 0)
        motion = folder / f"motion{rng.integers(1 << 40)}.csv"
        np.savetxt(motion, np.column_stack([t, values]), delimiter=",", header="t,x,y", comments="")
    if "dt" in kind:
        dt = float(end / np.exp(rng.uniform(*np.log([12, 500]))))
    return Question(kind, settings, dt, motion)


def truth(model: Model, asked: Question, steps: int, materials: Materials) -> tuple[Model, Trajectory]:
    """The full run of the scene with another number of steps and motion, as a user would write them into it."""
    scene: Scene = model.scene
    if asked.motion is not None:
        end = float(np.loadtxt(asked.motion, delimiter=",", skiprows=1)[-1, 0])
        data: dict[str, Any] = {"profile": "csv", "csv": str(asked.motion), "target": None}
        scene = scene.model_copy(update={"motion": scene.motion.model_copy(update=data)})
        scene = scene.model_copy(update={"time": scene.time.model_copy(update={"end": end})})
    scene = scene.model_copy(update={"time": scene.time.model_copy(update={"steps": steps})})
    full = replace(model, scene=scene, system=model.system.with_materials(materials))
    return full, simulate(full)


def columns(path: Path) -> dict[str, np.ndarray]:
    rows = list(csv.reader(path.open()))
    return {name: np.array([row[i] for row in rows[1:]]) for i, name in enumerate(rows[0])}


def ratios(name: str, asked: Question, folder: Path) -> dict[str, list[float]]:
    """Bound over truth of one query, in the energy norm and for every output; asserts that none is below 1."""
    model, certified, file = made(name, folder)
    out, batch, text = folder / "answer.csv", folder / "batch.csv", io.StringIO()
    keys = list(asked.settings[0])
    settings = [f"{key}={value!r}" for key, value in asked.settings[0].items()]
    if len(asked.settings) > 1:
        keys = sorted({key for each in asked.settings for key in each})
        rows = [[each.get(key, 1.0) for key in keys] for each in asked.settings]
        batch.write_text("\n".join([",".join(keys), *(",".join(map(repr, row)) for row in rows)]))
        settings = []
    many = {"batch": batch} if not settings else {}
    run_query(file, Console(file=text), settings=settings, motion=asked.motion, dt=asked.dt, out=out, **many)
    table, drive = columns(out), drive_of(certified, asked.motion, asked.dt)
    found = defaultdict(list)
    for i, each in enumerate(asked.settings):
        materials = certified.materials(each["lambda"], each["mu"], each.get("rho"))
        full, trajectory = truth(model, asked, drive.steps, materials)
        run = certified.run(materials, drive, allow=True)
        assert trajectory.snapshots is not None
        Phi = certified.fine.reconstruction.L_q[:, 4 : 4 + certified.k]  # type: ignore[union-attr]
        reference = FullRun(full, trajectory, trajectory.snapshots)
        error, size = true_error(reference, run.trajectory, Phi), float(np.sqrt(2 * reference.energy.max()))
        assert (run.certificate.energy.values >= error - ROUNDING * size).all(), asked
        found["energy"].append(float(run.certificate.energy.largest) / error.max())
        largest = np.abs(trajectory.outputs).max()
        for j, label in enumerate(trajectory.output_names):
            unit = f"[{label_unit(label)}]"
            if settings:
                off = np.abs(table[f"{label} {unit}"].astype(float) - trajectory.outputs[:, j])
                bound = table[f"error of {label} at most {unit}"].astype(float)
                energy = table["energy norm of the error at most [J^0.5]"].astype(float)
                assert (energy >= error - ROUNDING * size).all(), asked
            else:
                off = np.abs(run.trajectory.outputs[:, j] - trajectory.outputs[:, j]).max()
                bound = table[f"{label} error at most {unit}"].astype(float)[i]
                assert float(table["error at most"][i]) >= error.max() / size - ROUNDING, asked
            assert (bound >= off - ROUNDING * largest).all(), asked
            found["outputs"].append(float(np.max(bound) / np.max(off)))
    return found


def ask(seed: int, count: int, folder: Path) -> dict[str, list[float]]:
    rng, found = np.random.default_rng(seed), defaultdict(list)
    for i in range(count):
        name = list(SCENES)[i % len(SCENES)]
        asked = question(rng, made(name, folder)[0], folder)
        for what, values in ratios(name, asked, folder).items():
            found[f"{name}, {what}"] += values
    return found


@pytest.mark.serial
def test_no_bound_is_below_the_truth(tmp_path: Path) -> None:
    assert len(ask(7, 12, tmp_path)) == 2 * len(SCENES)


@pytest.mark.serial
@pytest.mark.slow
def test_no_bound_is_below_the_truth_in_many(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    seed, count = request.config.getoption("--seed"), request.config.getoption("--queries")
    for what, values in ask(seed, count, tmp_path).items():
        least, middle = min(values), float(np.median(values))
        print(f"{what}: {len(values)} bounds, {least:.3g} times the truth at least, {middle:.3g} in the median")  # noqa: T201
