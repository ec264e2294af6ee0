"""A rank without tissue unknowns takes part in every command."""

from __future__ import annotations

import softgrasp.fem  # noqa: F401  (threads and MPI first)

# isort: split
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
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
from softgrasp.study.shell.doctor import find_mpiexec

ROOT = Path(__file__).parents[3]
CHANGES = ["tissue.cells=[1,3]", "time.steps=40", "time.end=4.0", "reduction.N=[6]", "output.frames=2"]


def numbers(folder: Path, comm: MPI.Intracomm) -> dict[str, list[float]]:
    """Fewest unknowns of a rank, then what every number of ranks must give alike. Collective."""
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
        "simulate": run.outputs[-1].tolist(),
        "pictures": [float(np.abs(state).sum(dtype=float)) for state in comm.bcast(frames.states)],
        "warnings": [len(run_warnings(model, run, frames.most[1:]))],
        "reduce": [point.error for basis in swept for point in basis.points],
        "control": np.abs(solved.gain.K_s).sum(axis=1).tolist(),
    }


@pytest.mark.ranks
def test_a_rank_that_owns_no_tissue_gives_what_one_rank_gives(mpi_tmp_path: Path, comm: MPI.Intracomm) -> None:
    if comm.size < 3:
        pytest.skip("every rank owns some")
    many, one = numbers(mpi_tmp_path / "many", comm), numbers(mpi_tmp_path / f"one{comm.rank}", MPI.COMM_SELF)
    assert many.pop("least") == [0]  # else nothing is tested
    assert one.pop("least") == [8]
    for key, values in one.items():
        # rounding, that the least error of a basis enlarges; states of pictures have single precision
        assert many[key] == pytest.approx(values, rel=1e-6 if key == "pictures" else 1e-8), key


SMALL = ["--set", "tissue.cells=[2,4]", "--set", "output.frames=2", "--quiet"]
COMMANDS = {
    "simulate": ["paper_forward", *SMALL, "--set", "time.steps=40"],
    "control": ["paper_lqr", *SMALL, "--set", "time.steps=40", "--set", "time.end=4.0", "--set", "control.N=[12]"],
    "effects": ["franka_muscle", *SMALL, "--set", "time.steps=40", "--set", "contact.box=[[0.0,0.06],[0.06,0.12]]",
                "--set", "study.repeats=1"],
}  # fmt: skip
# what the machine, the clock and the number of ranks say, and polishing steps, which rounding decides
OWN = {
    "ranks", "time", "memory_peak_mb", "solver", "command_line", "machine", "versions", "date", "seconds", "time_are",
    "slowest", "noise", "base", "cost", "newton_steps", "time_tick", "builds",
}  # fmt: skip


def plain_numbers(value: object, name: str = "") -> dict[str, float]:
    """Numbers in nested dictionaries and lists by their path, without those of :data:`OWN`."""
    if isinstance(value, dict):
        pairs = [(key, entry) for key, entry in value.items() if key not in OWN]
    elif isinstance(value, list):
        pairs = [(str(i), entry) for i, entry in enumerate(value)]
    else:
        return {name: float(value)} if isinstance(value, (int, float)) else {}
    return {path: number for key, entry in pairs for path, number in plain_numbers(entry, f"{name}/{key}").items()}


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("ranks", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_mesh_of_two_by_four_gives_one_result_on_any_number_of_ranks(name: str, ranks: int, tmp_path: Path) -> None:
    """The whole command with its pictures; rounding is all that may differ."""
    mpiexec = find_mpiexec()
    if mpiexec is None:
        pytest.skip("no mpiexec")
    results = []
    for n in (1, ranks):
        out = tmp_path / str(n)
        command = [mpiexec, "-n", str(n), sys.executable, "-m", "softgrasp.study.cli", name, *COMMANDS[name]]
        run = subprocess.run([*command, "--out", str(out)], cwd=ROOT, capture_output=True, text=True, timeout=900)
        assert run.returncode == 0, run.stderr
        assert len(list(out.glob("*.png"))) > 0
        results.append(plain_numbers(json.loads((out / "result.json").read_text())))
    one, many = results
    assert many.keys() == one.keys()
    for path, number in one.items():
        assert many[path] == pytest.approx(number, rel=1e-6, abs=1e-9), path
