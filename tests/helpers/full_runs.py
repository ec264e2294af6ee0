"""Full runs of the paper's scene that tests of reductions compare with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.run.simulate import simulate
from softgrasp.reduction.replay import FullRun, full_run

PAPER = Path(__file__).parents[2] / "demos" / "scenes" / "paper_forward.toml"
SMALL = ["tissue.cells=[5,10]", "time.steps=120"]


def made(scene: Any, comm: MPI.Intracomm = MPI.COMM_WORLD) -> FullRun:
    """Run of a scene. Collective."""
    model = build(scene, comm=comm)
    return full_run(model, simulate(model))


def wanted(against: FullRun, N: list[int]) -> Any:
    """The table [reduction] of its scene with other orders."""
    return against.model.scene.reduction.model_copy(update={"N": N})
