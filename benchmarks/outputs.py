"""How far the proved bounds of outputs lie above the truth, and the time of an answer with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from mpi4py import MPI

from benchmarks import driver
from benchmarks.driver import Goal
from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.run.states.trajectory import Trajectory
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.trainer import Trainer, build_certified

ROUNDING = 1e-9  # of the largest output, which a bound exact in exact arithmetic may miss
MEDIAN = 4.0  # of bound over truth, to reach
COARSE = "reduction.grid=10"
SCENES: dict[str, tuple[str, tuple[str, ...]]] = {
    "paper": ("paper_forward", ("effects.damping={kind='kelvin-voigt', beta=0.002}",)),
    "franka": ("franka_muscle", (COARSE,)),
    "pillow": ("pillow_3d", (COARSE,)),
    "undamped": ("paper_forward", ()),
}
DAMPED = "paper,franka,pillow"
COLUMNS = {
    "scene": "scene",
    "n_e": "n_e",
    "k + k2": "sizes",
    "materials": "materials",
    "below the truth": "below",
    "bound / truth, median": "median .3g",
    "most": "most .3g",
    "without duals": "plain .3g",
    "answer [ms]": "answer_ms .3g",
    "without duals [ms]": "plain_ms .3g",
    "full run [ms]": "full_ms .3g",
}
HELP = f"""Proved bounds of outputs over the true errors at random materials of the box, and times of the answers.

A model is trained to a tolerance of 1e-2 for each scene: paper is paper_forward with Kelvin-Voigt damping of 2 ms,
franka and pillow are franka_muscle and pillow_3d, undamped is paper_forward as it ships. For every material and output
component it divides the largest bound over the run by the largest true error; errors below {ROUNDING:g} of the output
are rounding. Times are medians of processor time, each call at another material."""


@dataclass(frozen=True)
class OutputBounds:
    """Bounds and times of one scene."""

    scene: str  # name
    n_e: int  # unknowns of the tissue
    sizes: str  # modes of the answer, and of the basis that certifies it
    materials: int  # number tested
    below: int  # number of materials at which a bound lies below the truth at some step
    median: float  # median of bound over truth
    most: float  # largest bound over truth
    plain: float  # median of the bound without duals over the truth
    answer_ms: float  # processor time of an answer [ms]
    plain_ms: float  # processor time of an answer without duals [ms]
    full_ms: float  # processor time of a full run with its factor [ms]
    ratios: tuple[float, ...]  # bound over truth of every output component at every material


def trained(name: str, *changes: str) -> tuple[Model, CertifiedModel]:
    """A scene of :data:`SCENES` with more changes, and its certified model to 1e-2."""
    scene, own = SCENES[name]
    model = build(load_scene(shipped_scenes()[scene], [*own, *changes]), comm=MPI.COMM_SELF)
    trainer = Trainer(model)
    try:
        return model, build_certified(trainer, 1e-2)
    finally:
        trainer.destroy()


def measure(name: str, materials: int, *changes: str) -> OutputBounds:
    """Bounds at random materials, each beside the full run there. Raises SoftgraspError: no output has an error."""
    model, certified = trained(name, *changes)
    plain, box, rng = replace(certified, duals=None), certified.box, np.random.default_rng(1)
    assert box is not None
    low, high = np.log(np.array([box.lam, box.mu]).T)
    ratios: list[float] = []
    without: list[float] = []
    below, times = 0, np.zeros((materials, 3))
    for i in range(materials):
        place = certified.materials(*np.exp(rng.uniform(low, high)).tolist())
        system = model.system.with_materials(place)
        runs: list[CertifiedRun] = []
        full: list[Trajectory] = []
        calls = (
            lambda: runs.append(certified.run(place, allow=True)),  # noqa: B023  (at once)
            lambda: runs.append(plain.run(place, allow=True)),  # noqa: B023
            lambda: full.append(simulate(replace(model, system=system))),  # noqa: B023
        )
        times[i] = [driver.cpu_seconds(call) for call in calls]
        y = full[0].outputs
        error, rounding = np.abs(runs[0].trajectory.outputs - y), ROUNDING * np.abs(y).max()
        below += bool((runs[0].certificate.outputs.values < error - rounding).any())
        truth = error.max(axis=0)
        seen = truth > rounding
        for found, run in zip((ratios, without), runs, strict=True):
            found += (run.certificate.outputs.largest[seen] / truth[seen]).tolist()
    if not ratios:
        raise SoftgraspError(f"{name}: no output has an error above rounding")
    answer, less, whole = (1e3 * np.median(times, axis=0)).tolist()
    return OutputBounds(
        name, model.system.layout.n_e, f"{certified.k} + {certified.k2}", materials, below, float(np.median(ratios)),
        max(ratios), float(np.median(without)), answer, less, whole, tuple(ratios),
    )  # fmt: skip


def goals_of(rows: Sequence[OutputBounds]) -> list[Goal]:
    """No bound below the truth; with damping a median of at most :data:`MEDIAN`."""
    goals = [Goal(f"{r.scene}: materials with a bound below the truth", float(r.below), 0.0) for r in rows]
    damped = [r for r in rows if r.scene != "undamped"]
    goals += [Goal(f"{r.scene}: median of bound / truth", r.median, MEDIAN) for r in damped]
    return goals


def main(
    scenes: Annotated[str, typer.Option(help=f"with commas, of {', '.join(SCENES)}")] = DAMPED,
    materials: Annotated[int, typer.Option(help="materials for each", min=1)] = 60,
    out: Annotated[Path, typer.Option(help="folder for bench_outputs.json and bench_outputs.csv")] = Path("out"),
) -> None:
    """See HELP."""
    names = driver.parse_list(scenes, f"({'|'.join(SCENES)})", f"scene here; there are {', '.join(SCENES)}")
    console = driver.open_console(150)
    rows = driver.measure_each(console, names, lambda name: measure(name, materials))
    table = driver.table_of(rows, COLUMNS, "bounds of outputs at random materials, medians of processor time")
    driver.finish(console, out, "bench_outputs", rows, table, goals_of(rows))
