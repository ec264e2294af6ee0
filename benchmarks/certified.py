"""Time of a certified answer over that of the full run, and the share of its proof."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI

from benchmarks import driver
from benchmarks.driver import Goal
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import Drive, Materials, modal_motions
from softgrasp.reduction.certified.oscillators import SecondOrder
from softgrasp.reduction.certified.trainer import Trainer, build_certified
from softgrasp.reduction.online import run as stepped_run
from softgrasp.reduction.propagator import propagator
from softgrasp.study.shell.timing import interleave, medians

K, K2 = 16, 48  # modes of the answer, and of the basis that certifies it
ALONE = (8, K, K2)  # modes of one basis
BOX = ((30.0, 500.0), (20.0, 500.0))  # lambda and mu [Pa]
SHARE = 0.3  # of an answer, and of the run of one basis in state space, that the proof may cost
OF_FULL = {15: 1 / 3, 60: 1 / 50}  # of a full run that a query may cost, by cells of the short side
FULL, STEP = "full run with its factor", ", with the time step's error"
COLUMNS = {
    "cells": "cells",
    "answer": "answer",
    "CPU ms": "ms 3",
    "without the proof": "plain 3",
    "share of the proof": "share %",
    "proof / state space": "of_stepped %",
    "of a full run": "of_full 3",
}
HELP = f"""Certified answers of the paper's scene with Kelvin-Voigt damping, {K} modes certified by {K2}.

Each repeat draws a new material, for which every answer and the full run are made from the start, in turn, each after
a call of its own kind that is not timed; medians of CPU time on one rank. The proof's share is that of an answer less
the same answer without it: with two bases the estimate alone, with one basis the reduced run alone, mode by mode. A
query has the time step's error in it. The proof of one basis is compared with its run in state space too: operators
at the material, propagator, steps. A fast look: --cells 15."""


@dataclass(frozen=True)
class AnswerCost:
    """One way to an answer on one mesh; None where a number does not apply."""

    cells: int  # cells of the short side
    answer: str  # kind of the answer in words
    ms: float  # CPU time
    plain: float | None = None  # CPU time without the proof [ms]
    share: float | None = None  # share of the proof in the time of an answer
    stepped: float | None = None  # the reduced run in state space [ms]
    of_stepped: float | None = None  # proof over that
    of_full: float | None = None  # answer over the full run


def certified_on(nx: int) -> tuple[Model, CertifiedModel]:
    """The scene on nx x 2 nx cells, and the model of its first K2 modes by the greedy on few points."""
    changes = [
        f"tissue.cells=[{nx}, {2 * nx}]", "effects.damping={kind='kelvin-voigt', beta=0.002}",
        f"reduction={{lambda_range={list(BOX[0])}, mu_range={list(BOX[1])}, grid=3, certify='proof', "
        f"max_N={4 + 2 * K2}}}",
    ]  # fmt: skip
    model = build(load_scene(shipped_scenes()["paper_forward"], changes), comm=MPI.COMM_SELF)
    trainer = Trainer(model)
    try:
        return model, build_certified(trainer, 1e-12).with_sizes(K, K2)
    finally:
        trainer.destroy()


def plain(model: CertifiedModel, blocks: SecondOrder, materials: Materials, drive: Drive) -> None:
    """The reduced run of one basis, and that at the finer step, without residuals."""
    g = np.zeros(len(model.fine.parts["M_hand"]))
    for each in (drive, drive.finer):
        if each is not None and each.hand is not None:
            (motion,) = modal_motions(model.fine, blocks, None, [materials], each, g, each.hand)
            if each is drive:
                motion.trajectory(drive.dt, model.fine.outputs.names)


def in_state_space(model: CertifiedModel, materials: Materials, drive: Drive) -> None:
    """The reduced run of one basis by operators at the material, propagator and steps."""
    step = propagator(model.fine.at(materials), drive.dt, driven=True)
    stepped_run(step, hand=drive.hand)


def measure(nx: int, repeats: int) -> Iterator[AnswerCost]:
    """All answers on one mesh."""
    model, two = certified_on(nx)
    estimate, alone = replace(two, certify="estimate"), [two.with_sizes(k, k) for k in ALONE]
    assert two.drive is not None
    short = replace(two.drive, finer=None)
    calls: dict[str, Callable[[Materials], Any]] = {
        FULL: lambda m: simulate(replace(model, system=model.system.with_materials(m)))
    }
    answers = []
    for drive, what in ((two.drive, STEP), (short, "")):
        answers.append(f"{K} + {K2}{what}")
        calls[answers[-1]] = partial(two.run, drive=drive, allow=True)
        calls[f"{answers[-1]} plain"] = partial(estimate.run, drive=drive, allow=True)
        for one in alone:
            answers.append(f"{one.k} alone{what}")
            calls[answers[-1]] = partial(one.run, drive=drive, allow=True)
            calls[f"{answers[-1]} plain"] = partial(plain, one, SecondOrder.of(one.fine), drive=drive)
            if drive is short:
                calls[f"{answers[-1]} stepped"] = partial(in_state_space, one, drive=drive)

    def timed(call: Callable[[Materials], Any]) -> Callable[[], float]:
        rng = np.random.default_rng(0)  # the same materials for each

        def cpu() -> float:
            lam, mu = np.exp([rng.uniform(*np.log(limits)) for limits in BOX])
            call(two.materials(77.0, 60.0))  # else it pays for the memory that another call gave back
            return driver.cpu_seconds(lambda: call(two.materials(float(lam), float(mu))))

        cpu()
        return cpu

    ms = {name: 1e3 * t for name, t in medians(interleave({n: timed(c) for n, c in calls.items()}, repeats)).items()}
    yield AnswerCost(nx, FULL, ms[FULL])
    for name in answers:
        cost, less, stepped = ms[name], ms[f"{name} plain"], ms.get(f"{name} stepped")
        ratio = None if stepped is None else (cost - less) / stepped
        yield AnswerCost(nx, name, cost, less, 1 - less / cost, stepped, ratio, cost / ms[FULL])


def goals_of(rows: list[AnswerCost]) -> list[Goal]:
    """Goals: of all answers, of the proof of one basis beside its run in state space, and of queries."""
    goals = []
    for r in rows:
        name = f"nx = {r.cells}, {r.answer}"
        if r.share is not None:
            goals.append(Goal(f"{name}: share of the proof", r.share, SHARE))
        if r.of_stepped is not None:
            goals.append(Goal(f"{name}: proof over the run in state space", r.of_stepped, SHARE))
        if r.of_full is not None and r.answer == f"{K} + {K2}{STEP}" and r.cells in OF_FULL:
            goals.append(Goal(f"{name}: of a full run", r.of_full, OF_FULL[r.cells]))
    return goals


def main(
    cells: Annotated[str, typer.Option(help="of the short side, with commas")] = "15,60",
    repeats: Annotated[int, typer.Option(help="repeats behind each median", min=1)] = 21,
    out: Annotated[Path, typer.Option(help="folder for bench_certified.json and bench_certified.csv")] = Path("out"),
) -> None:
    """See HELP."""
    sizes = driver.parse_numbers(cells, r"([1-9]\d*)", "number of cells; write 15,60")
    console = driver.open_console(130)
    rows: list[AnswerCost] = []
    for nx in sizes:
        with console.status(f"{nx} x {2 * nx} cells"):
            rows += measure(nx, repeats)
    table = driver.table_of(rows, COLUMNS, f"certified answers, median CPU time of {repeats} new materials")
    console.print(table.terminal())
    goals = goals_of(rows)
    driver.show_goals(console, goals)
    numbers = [{key: x for key, x in row.items() if x is not None} for row in map(asdict, rows)]
    content = {"command": "bench_certified", "repeats": repeats, "rows": numbers, "goals": driver.goal_rows(goals)}
    driver.list_bench(console, driver.write_bench(out, "bench_certified", content, table))
