"""What the commands do with a small scene, as a few numbers: started on more ranks than it has room for."""

from __future__ import annotations

import softgrasp.fem  # noqa: F401  (threads and MPI first)

# isort: split
import json
import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from softgrasp.fem.fields.probe import make_probe
from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.run.simulate import RunOptions, simulate
from softgrasp.fem.scene.file import load_scene, shipped_scenes
from softgrasp.lqr.design.feedback import design
from softgrasp.reduction.replay import full_run
from softgrasp.study.forward.cautions import run_warnings
from softgrasp.study.pictures.frames import Frames
from softgrasp.study.precision.full import find_places
from softgrasp.study.reduce.linear.measure import sweep

CHANGES = ["tissue.cells=[2,2]", "time.steps=40", "time.end=4.0", "reduction.N=[6]", "output.frames=2"]


def numbers(folder: Path) -> dict[str, list[float]]:
    """Fewest unknowns of a rank, then what every number of ranks must give alike. Collective."""
    comm = MPI.COMM_WORLD
    scene = load_scene(shipped_scenes()["paper_lqr"], CHANGES)
    model = build(scene, comm=comm)
    frames = Frames(model, folder)
    run = simulate(model, RunOptions(folder, frame=frames, begin=frames.begin))
    frames.close()
    swept = [sweep(name, full_run(model, run), scene.reduction) for name in ("componentwise_pod", "psd")]
    solved = design(model, Stopwatch(comm))
    places = find_places(scene, model)
    make_probe(model.space, places.points, scene.effects.rotation)
    return {
        "least": [min(comm.allgather(model.system.layout.n_local))],
        "simulate": [*run.outputs[-1], *(float(np.abs(state).sum()) for state in frames.states)],
        "warnings": [len(run_warnings(model, run, frames.most[1:]))],
        "reduce": [point.error for basis in swept for point in basis.points],
        "control": np.abs(solved.gain.K_s).sum(axis=1).tolist(),
    }


if __name__ == "__main__":
    result = numbers(Path(sys.argv[1]))
    if MPI.COMM_WORLD.rank == 0:
        sys.stdout.write(json.dumps(result))
