"""How often the true material lies within the stated errors of an identification, over random noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI

from benchmarks import driver
from benchmarks.driver import Goal
from softgrasp.fem.accuracy.adapt import build
from softgrasp.fem.model.build import Model
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.fem.scene.scene import Scene
from softgrasp.reduction.identify.data import Measurements
from softgrasp.reduction.identify.identify import identify

WITHIN = 0.95  # share of the seeds, to reach
REFUSED = 0.05  # share of the seeds that chance may refuse, by the misfit
TIMES = 2.0  # of the stated errors
KEEP = "output.snapshots='none'"


@dataclass(frozen=True)
class Case:
    """A scene whose material is looked for."""

    scene: str  # that ships
    keys: tuple[str, ...]  # of the fit
    finer: tuple[str, ...]  # of the data: a finer mesh and smaller steps
    truth: dict[str, float]  # true value of each parameter over the one the fit starts from
    noise: float  # [m]
    every: int  # steps of the data between two measurements
    strained: bool = False  # whether the data are of neo-Hooke, where the fit is linear


CASES = {
    "2D": Case(
        "paper_forward",
        ("effects.damping={kind='kelvin-voigt', beta=0.002}", "time.end=6.0", "time.steps=1200", "tissue.order=2",
         "tissue.refine.tolerance=1e-2"),
        ("tissue.refine.tolerance=1e-3", "time.steps=2400"),
        {"mu": 1.6, "lambda": 1.2, "beta": 1.5}, 1e-3, 4,
    ),
    "layers": Case(
        "layers_2d", (), ("tissue.order=3", "time.steps=1600"), {"mu": 1.3, "fat.mu": 1.5, "fat.beta": 1.2}, 3e-5, 8,
    ),
    "3D": Case(
        "block_3d",
        ("control.outputs=[{kind='node', point=[0.025, 0.025, 0.0], name='tip'}]", "tissue.cells=[4, 3, 6]",
         "motion.duration=0.2", "time.end=0.5", "time.steps=100"),
        ("tissue.cells=[6, 4, 10]", "time.steps=400"),
        {"mu": 1.3, "beta": 1.4}, 3e-3, 8,
    ),
    "neo-Hooke": Case(
        "paper_forward",
        ("tissue.size=[1.0, 1.0]", "contact={sides=['top'], box=[[0.0, 0.9], [1.0, 1.0]]}", "motion.target=[3.0, 0.0]",
         "motion.duration=1.5", "time.end=3.0", "time.steps=300", "tissue.order=2", "tissue.refine={tolerance=1e-2}",
         "effects.damping={kind='kelvin-voigt', beta=0.02}"),
        ("tissue.refine={tolerance=3e-3}", "time.steps=600", "effects.finite_strain={law='neo-hooke'}"),
        {"mu": 1.4, "beta": 1.25}, 1e-2, 2, strained=True,
    ),
}  # fmt: skip
COLUMNS = {
    "case": "case",
    "fitted": "fitted",
    "n_e": "n_e",
    "of the data": "finer",
    "seeds": "seeds",
    "within 1": "once",
    f"within {TIMES:g}": "twice",
    "refused": "refused",
    "refused or warned": "warned",
    "error / stated, median": "median .2g",
    "a fit [s]": "seconds .2g",
}
HELP = f"""How often the truth lies within {TIMES:g} times the errors that `identify` states, over seeds of the noise.

The data come from a finer mesh and smaller steps than those of the fit. It counts the seeds in which the error of the
logarithm of every value is at most the sum of noise, |mesh|, |time step| and |reduction|, and at most {TIMES:g} times
that. Times are medians of processor time, with all that is offline. The law of the fit is linear; in one case that of
the data is neo-Hooke, and the answer must be refused or warn of the range of linear elasticity."""


@dataclass(frozen=True)
class Seeds:
    """One case over all seeds."""

    case: str  # name
    fitted: str  # parameters
    n_e: int  # unknowns of the tissue in the fit
    finer: int  # and of the data
    seeds: int  # number of fits
    once: int  # number with the truth within the errors
    twice: int  # within twice the errors
    refused: int  # number of refused answers
    warned: int  # number of those refused or with a warning of the range of linear elasticity
    strained: bool  # whether the data are of another law
    median: float  # of the largest error of a value over the stated one
    seconds: float  # median of a fit's processor time [s]


def true_scene(case: Case) -> tuple[Scene, dict[str, float]]:
    """The scene of the data, and the true values."""
    values: dict[str, float] = {}

    def edit(table: dict[str, Any]) -> None:
        for name, factor in case.truth.items():
            layer, _, kind = name.rpartition(".")
            part = table["tissue"]["layers"][layer] if layer else table["tissue"]
            if kind == "beta":
                part = part if layer else table["effects"]["damping"]
            else:
                part = part["material"]
                part.pop("name", None)
            part[kind] = values[name] = factor * part[kind]

    keys = [*case.keys, *case.finer, KEEP]
    return load_scene(shipped_scenes()[case.scene], keys).changed(edit), values


def measure(name: str, seeds: int, case: Case | None = None) -> Seeds:
    """Fits of one case, each with noise of its own."""
    case = CASES[name] if case is None else case
    true, values = true_scene(case)
    fine: Model = build(true, comm=MPI.COMM_SELF)
    run = simulate(fine)
    model = build(load_scene(shipped_scenes()[case.scene], [*case.keys, KEEP]), comm=MPI.COMM_SELF)
    y, times = run.outputs[:: case.every], run.times[:: case.every]
    far, refused, warned, seconds = [], 0, 0, []
    for seed in range(seeds):
        data = Measurements("markers", times, y + np.random.default_rng(seed).normal(0, case.noise, y.shape))
        found: list[Any] = []
        fit = partial(identify, model, data, list(case.truth), case.noise, law="linear")
        seconds.append(driver.cpu_seconds(lambda: found.append(fit())))  # noqa: B023  (at once)
        # The stated errors are of the logarithm.
        error = np.log(found[0].values / [values[u.name] for u in found[0].unknowns])
        far.append(float((np.abs(error) / found[0].total).max()))
        refused += bool(found[0].reasons)
        warned += bool(found[0].reasons) or any(w.startswith("Linear elasticity has") for w in found[0].warnings)
    once, twice = (sum(x <= most for x in far) for most in (1.0, TIMES))
    fitted, n_e, finer = ", ".join(case.truth), model.system.layout.n_e, fine.system.layout.n_e
    median, spent = float(np.median(far)), float(np.median(seconds))
    return Seeds(name, fitted, n_e, finer, seeds, once, twice, refused, warned, case.strained, median, spent)


def goals_of(rows: Sequence[Seeds]) -> list[Goal]:
    """Few seeds with the truth outside, few refused; all of another law refused or warned of."""
    own = [r for r in rows if not r.strained]
    goals = [Goal(f"{r.case}: share outside {TIMES:g} x errors", 1 - r.twice / r.seeds, 1 - WITHIN) for r in own]
    goals += [Goal(f"{r.case}: share refused", r.refused / r.seeds, REFUSED) for r in own]
    return goals + [
        Goal(f"{r.case}: share without refusal or warning", 1 - r.warned / r.seeds, 0.0) for r in rows if r.strained
    ]


def main(
    cases: Annotated[str, typer.Option(help=f"with commas, of {', '.join(CASES)}")] = ",".join(CASES),
    seeds: Annotated[int, typer.Option(help="fits for each", min=1)] = 100,
    out: Annotated[Path, typer.Option(help="folder for bench_seeds.json and bench_seeds.csv")] = Path("out"),
) -> None:
    """See HELP."""
    names = driver.parse_list(cases, f"({'|'.join(CASES)})", f"case here; there are {', '.join(CASES)}")
    console = driver.open_console(150)
    rows = driver.measure_each(console, names, lambda name: measure(name, seeds))
    table = driver.table_of(rows, COLUMNS, "true materials against stated errors, over seeds of the noise")
    driver.finish(console, out, "bench_seeds", rows, table, goals_of(rows))
