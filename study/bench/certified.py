"""What a certified answer costs beside the full run, and what its proof costs of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from mpi4py import MPI

from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.simulate import simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.reduction.certified.model import CertifiedModel
from softgrasp.reduction.certified.motion import Drive, Materials, modal_motions
from softgrasp.reduction.certified.oscillators import SecondOrder
from softgrasp.reduction.certified.trainer import Trainer, build_certified
from softgrasp.study.bench.driver import (
    Goal,
    Row,
    goal_rows,
    list_bench,
    open_console,
    parse_numbers,
    show_goals,
    table_of,
    write_bench,
)
from softgrasp.study.shell.timing import interleave, medians

K, K2 = 16, 48  # modes of the answer, and of the basis that certifies it
BOX = ((30.0, 500.0), (20.0, 500.0))  # lambda and mu [Pa]
SHARE = 0.3  # of an answer that its proof may cost
OF_FULL = {15: 1 / 3, 60: 1 / 50}  # of a full run that an answer may cost, by cells of the short side
FULL, STEP = "full run with its factor", ", with the time step's error"
COLUMNS = {
    "cells": "cells",
    "answer": "answer",
    "CPU ms": "ms 3",
    "without the proof": "plain 3",
    "share of the proof": "share .0%",
    "of a full run": "of_full 3",
}
HELP = f"""Certified answers of the paper's scene with Kelvin-Voigt damping, {K} modes certified by {K2}.

Each repeat draws a new material, for which every answer and the full run are made from the start, in turn, each after
a call of its own kind that is not timed; medians of CPU time on one rank. The proof's share is that of an answer less
the same answer without it: with two bases the estimate alone, with one basis the reduced run alone. A fast look:
--cells 15."""


def trained(nx: int) -> tuple[Model, CertifiedModel]:
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


def measure(nx: int, repeats: int) -> Iterator[Row]:
    """All answers on one mesh."""
    model, two = trained(nx)
    estimate, alone = replace(two, certify="estimate"), [two.with_sizes(k, k) for k in (K, K2)]
    blocks = [SecondOrder.of(one.fine) for one in alone]
    assert two.drive is not None
    step, short = two.drive, replace(two.drive, finer=None)
    answers: dict[str, tuple[Callable[[Materials], Any], Callable[[Materials], Any]]] = {}
    for drive, what in ((step, STEP), (short, "")):
        answers[f"{K} + {K2}{what}"] = (
            lambda m, drive=drive: two.run(m, drive, allow=True),  # type: ignore[misc]
            lambda m, drive=drive: estimate.run(m, drive, allow=True),  # type: ignore[misc]
        )
        for one, own in zip(alone, blocks, strict=True):
            answers[f"{one.k} alone{what}"] = (
                lambda m, drive=drive, one=one: one.run(m, drive, allow=True),  # type: ignore[misc]
                lambda m, drive=drive, one=one, own=own: plain(one, own, m, drive),  # type: ignore[misc]
            )

    def timed(call: Callable[[Materials], Any]) -> Callable[[], float]:
        rng = np.random.default_rng(0)  # the same materials for each

        def cpu() -> float:
            lam, mu = np.exp([rng.uniform(*np.log(limits)) for limits in BOX])
            call(two.materials(77.0, 60.0))  # else it pays for the memory that another call gave back
            begin = time.process_time()
            call(two.materials(float(lam), float(mu)))
            return time.process_time() - begin

        return cpu

    calls = {FULL: timed(lambda m: simulate(replace(model, system=model.system.with_materials(m))))}
    for name, pair in answers.items():
        calls |= {name: timed(pair[0]), f"{name} plain": timed(pair[1])}
    for call in calls.values():
        call()
    found = medians(interleave(calls, repeats))
    full = found[FULL]
    yield {"cells": nx, "answer": FULL, "ms": 1e3 * full}
    for name in answers:
        proved, less = found[name], found[f"{name} plain"]
        about = {"ms": 1e3 * proved, "plain": 1e3 * less, "share": 1 - less / proved, "of_full": proved / full}
        yield {"cells": nx, "answer": name, **about}


def goals_of(rows: list[Row]) -> list[Goal]:
    """What was asked for: of every answer, and of those with all three numbers."""
    goals = []
    for r in rows:
        name = f"nx = {r['cells']}, {r['answer']}"
        if "share" in r:
            goals.append(Goal(f"{name}: share of the proof", r["share"], SHARE))
        if r["answer"] == f"{K} + {K2}{STEP}" and r["cells"] in OF_FULL:
            goals.append(Goal(f"{name}: of a full run", r["of_full"], OF_FULL[r["cells"]]))
    return goals


def main(
    cells: Annotated[str, typer.Option(help="of the short side, with commas")] = "15,60",
    repeats: Annotated[int, typer.Option(help="repeats behind each median", min=1)] = 21,
    out: Annotated[Path, typer.Option(help="folder for bench_certified.json and bench_certified.csv")] = Path("out"),
) -> None:
    """See HELP."""
    sizes = parse_numbers(cells, r"([1-9]\d*)", "number of cells; write 15,60")
    console = open_console(130)
    rows: list[Row] = []
    for nx in sizes:
        with console.status(f"{nx} x {2 * nx} cells"):
            rows += measure(nx, repeats)
    table = table_of(rows, COLUMNS, f"certified answers, median CPU time of {repeats} new materials")
    console.print(table.terminal())
    goals = goals_of(rows)
    show_goals(console, goals)
    content = {"command": "bench_certified", "repeats": repeats, "rows": rows, "goals": goal_rows(goals)}
    list_bench(console, write_bench(out, "bench_certified", content, table))
