"""Restart, streamed snapshots, stops and refusals of a run."""

from __future__ import annotations

import gc
import json
import os
import signal
import time
import weakref
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.errors import CheckpointError, Interrupted, ResourceError, SceneError, SolverError
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.run.midpoint import TissueMidpoint
from softgrasp.fem.run.simulate import Run, RunOptions, simulate
from softgrasp.fem.run.states.checkpoint import FORMAT
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.scene.file import load_scene
from softgrasp.fem.solve.solvers import TissueSolver

pytestmark = pytest.mark.ranks

SCENES = Path(__file__).parents[3] / "demos" / "scenes"


def small(comm: MPI.Intracomm, *overrides: str, scene: str = "paper_forward") -> Model:
    changes = ["tissue.cells=[4,8]", "time.steps=40", "time.end=3.0", *overrides]
    return build(load_scene(SCENES / f"{scene}.toml", changes), comm=comm)


@pytest.mark.parametrize(("snapshots", "stop"), [("memory", 1), ("hdf5", 17), ("none", 17)])
@pytest.mark.parametrize("scene", ["paper_forward", "paper_lqr"])
def test_restart_is_bitwise(comm: MPI.Intracomm, mpi_tmp_path: Path, snapshots: str, stop: int, scene: str) -> None:
    extra = (f'output.snapshots="{snapshots}"', "output.every=3")
    whole = simulate(small(comm, *extra, scene=scene), RunOptions(directory=mpi_tmp_path / "whole"))
    with pytest.raises(Interrupted, match=f"step {stop} of 40"):
        simulate(small(comm, *extra, scene=scene), RunOptions(directory=mpi_tmp_path / "parts", until=stop))
    rest = simulate(small(comm, *extra, scene=scene), RunOptions(directory=mpi_tmp_path / "parts", resume=True))
    assert np.array_equal(whole.final, rest.final)
    assert np.array_equal(whole.outputs, rest.outputs)
    assert np.array_equal(whole.q_s, rest.q_s)
    assert whole.energy_drift == rest.energy_drift
    if whole.snapshots is not None and rest.snapshots is not None:
        assert np.array_equal(whole.snapshots.Z, rest.snapshots.Z)


def test_restart_leaves_the_same_streamed_snapshots(
    comm: MPI.Intracomm, mpi_tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extra = ('output.snapshots="hdf5"', "output.every=3")
    monkeypatch.setattr(
        "softgrasp.fem.run.states.streamed.BUFFER_BYTES", 20_000
    )  # a few columns: the buffer is filled several times
    simulate(small(comm, *extra), RunOptions(directory=mpi_tmp_path / "whole"))
    with pytest.raises(Interrupted):
        simulate(small(comm, *extra), RunOptions(directory=mpi_tmp_path / "parts", until=17))
    simulate(small(comm, *extra), RunOptions(directory=mpi_tmp_path / "parts", resume=True))
    with (
        h5py.File(mpi_tmp_path / "whole" / "snapshots.h5") as whole,
        h5py.File(mpi_tmp_path / "parts" / "snapshots.h5") as parts,
    ):
        for key in ("z", "v", "q_s", "v_s", "steps"):
            assert np.array_equal(whole[key][:], parts[key][:]), key
        assert np.abs(whole["z"][1:]).max(axis=1).min() > 0  # every column was written


@pytest.mark.parametrize("extra", [("effects.reaction=true", 'motion.drive="force"'), ()])
def test_restart_with_layered_damping_is_bitwise(
    comm: MPI.Intracomm, mpi_tmp_path: Path, extra: tuple[str, ...]
) -> None:
    def model() -> Model:
        return build(
            load_scene(
                SCENES / "layers_2d.toml", ["tissue.refine=false", "tissue.cells=[8,5]", "time.steps=40", *extra]
            ),
            comm=comm,
        )

    assert model().system.damping.matrix is not None
    whole = simulate(model())
    with pytest.raises(Interrupted):
        simulate(model(), RunOptions(directory=mpi_tmp_path, until=13))
    rest = simulate(model(), RunOptions(directory=mpi_tmp_path, resume=True))
    assert np.array_equal(whole.final, rest.final)
    assert np.array_equal(whole.v_s, rest.v_s)
    assert whole.energy_drift == rest.energy_drift


def test_streamed_snapshots_that_are_gone_do_not_resume(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    hdf5 = 'output.snapshots="hdf5"'
    with pytest.raises(Interrupted):
        simulate(small(comm, hdf5), RunOptions(directory=mpi_tmp_path, until=20))
    mine = mpi_tmp_path / f"snapshots-rank{comm.rank}.h5"
    with h5py.File(mine, "r+") as file:
        file.attrs["written"] = 7 if comm.rank == 0 else 21
    with pytest.raises(CheckpointError, match="has 7 snapshots, step 20 needs 21"):
        simulate(small(comm, hdf5), RunOptions(directory=mpi_tmp_path, resume=True))
    if comm.rank == comm.size - 1:
        mine.unlink()
    comm.Barrier()
    with pytest.raises(CheckpointError, match=f"snapshots-rank{comm.size - 1}.h5 cannot be read"):
        simulate(small(comm, hdf5), RunOptions(directory=mpi_tmp_path, resume=True))


@pytest.mark.parametrize("where", ["set-up", "check"])
def test_a_solver_that_fails_on_one_rank_ends_the_run_on_all(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Every rank holds the whole factor here, so that one may fail alone."""

    def fail(*arguments: object, **options: object) -> None:
        raise SolverError("out of memory")

    if comm.rank == comm.size - 1:
        if where == "set-up":
            monkeypatch.setattr("softgrasp.fem.run.midpoint.make_solver", fail)
        else:
            monkeypatch.setattr(TissueSolver, "check", fail)
    with pytest.raises(SolverError, match="out of memory"):
        simulate(small(comm))


@pytest.mark.parametrize("force", [lambda n, t, q, v: np.zeros(3), lambda n, t, q, v: 1.0])
def test_a_force_of_the_wrong_shape_is_refused(comm: MPI.Intracomm, force: Any) -> None:
    with pytest.raises(SolverError, match=r"the force has shape .* return 2 numbers"):
        simulate(small(comm), force=force)


@pytest.mark.parametrize("step", [0, 25, 39])
@pytest.mark.parametrize("reaction", [False, True])
def test_a_force_that_is_not_finite_is_named(comm: MPI.Intracomm, step: int, reaction: bool) -> None:
    def force(n: int, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([1.0, np.nan if n >= step and comm.rank == comm.size - 1 else 1.0])  # on one rank is enough

    said = rf"force on the hand is nan in y in step {step + 1}, at t = {(step + 0.5) * 3 / 40:g} s"
    with pytest.raises(SolverError, match=said):
        simulate(small(comm, f"effects.reaction={str(reaction).lower()}"), force=force)


@pytest.mark.filterwarnings("ignore:overflow", "ignore:invalid value")
def test_a_run_that_is_no_longer_finite_stops(comm: MPI.Intracomm) -> None:
    """The energy overflows, the force does not."""
    with pytest.raises(SolverError, match="the energy is not finite at step 4"):
        simulate(small(comm), force=lambda n, t, q, v: np.full(2, 1.0 if n < 2 else 1e200))


def residuals_seen(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Every residual that a run asks for from now on."""
    seen: list[float] = []
    real = TissueMidpoint.residual

    def watched(self: TissueMidpoint) -> float:
        seen.append(real(self))
        return seen[-1]

    monkeypatch.setattr(TissueMidpoint, "residual", watched)
    return seen


def test_first_and_last_solve_are_checked(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = residuals_seen(monkeypatch)
    run = simulate(small(comm))
    assert run.residuals == tuple(seen)
    assert len(seen) == 2
    assert seen[0] != seen[1]


def test_checks_are_no_part_of_the_time_of_a_step(comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch) -> None:
    real = TissueMidpoint.residual

    def slow(self: TissueMidpoint) -> float:
        time.sleep(0.5)
        return real(self)

    monkeypatch.setattr(TissueMidpoint, "residual", slow)
    assert simulate(small(comm, "time.steps=2")).seconds["steps"] < 0.5  # two steps of 30 us and a busy machine


def test_a_run_is_freed_with_its_last_reference(comm: MPI.Intracomm) -> None:
    """Its snapshots may fill the memory, which the next run needs."""
    gc.collect()
    gc.disable()
    try:
        run = Run(small(comm), RunOptions())
        ts = make_ts(run)
        run.start()
        run.check_step(ts, 3)
        ts.destroy()
        run.midpoint.destroy()
        gone = weakref.ref(run)
        del run
        assert gone() is None
    finally:
        gc.enable()


def test_restart_file_of_another_format(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        simulate(small(comm), RunOptions(directory=mpi_tmp_path, until=5))
    manifest = mpi_tmp_path / "checkpoint" / "checkpoint.json"
    if comm.rank == 0:
        manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"format": 1}))
    comm.Barrier()
    with pytest.raises(CheckpointError, match=f"another version of softgrasp .format 1, this one reads {FORMAT}.; run"):
        simulate(small(comm), RunOptions(directory=mpi_tmp_path, resume=True))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_on_one_rank_leaves_a_restart_file(
    comm: MPI.Intracomm, mpi_tmp_path: Path, capfd: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    def interrupt(run: Run) -> None:
        if comm.rank == comm.size - 1:
            os.kill(os.getpid(), number)

    extra = ("time.steps=1000", 'output.snapshots="none"', "tissue.cells=[6,12]")
    whole = simulate(small(comm, *extra))
    before = signal.getsignal(number)  # a job in the background ignores it
    with pytest.raises(Interrupted, match="stopped after step"):
        simulate(small(comm, *extra), RunOptions(directory=mpi_tmp_path, progress=interrupt))
    assert signal.getsignal(number) is before
    assert capfd.readouterr().err.count("stopping as soon as") == (comm.size == 1)  # rank 0 speaks when it was asked
    rest = simulate(small(comm, *extra), RunOptions(directory=mpi_tmp_path, resume=True))
    assert np.array_equal(whole.final, rest.final)


@pytest.mark.parametrize("scene", ["paper_forward", "paper_lqr"])
def test_two_way_force_restart_is_bitwise(comm: MPI.Intracomm, mpi_tmp_path: Path, scene: str) -> None:
    extra = ("effects.reaction=true", 'motion.drive="force"')
    whole = simulate(small(comm, *extra, scene=scene))
    with pytest.raises(Interrupted):
        simulate(small(comm, *extra, scene=scene), RunOptions(directory=mpi_tmp_path, until=11))
    rest = simulate(small(comm, *extra, scene=scene), RunOptions(directory=mpi_tmp_path, resume=True))
    assert np.array_equal(whole.final, rest.final)
    assert np.array_equal(whole.v_s, rest.v_s)


def test_mumps_restarts_bitwise(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    extra = ("tissue.cells=[5,5,10]", "tissue.order=1", "time.steps=10", 'time.solver="mumps"')
    whole = simulate(small(comm, *extra, scene="block_3d"))
    with pytest.raises(Interrupted):
        simulate(small(comm, *extra, scene="block_3d"), RunOptions(directory=mpi_tmp_path, until=4))
    rest = simulate(small(comm, *extra, scene="block_3d"), RunOptions(directory=mpi_tmp_path, resume=True))
    assert np.array_equal(whole.final, rest.final)
    assert np.array_equal(whole.v_s, rest.v_s)


def test_streamed_snapshots_equal_those_in_memory(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    memory = simulate(small(comm, "output.every=7")).snapshots
    simulate(small(comm, "output.every=7", 'output.snapshots="hdf5"'), RunOptions(directory=mpi_tmp_path))
    assert memory is not None
    start, n = memory.layout.start, memory.layout.n_local
    with h5py.File(mpi_tmp_path / "snapshots.h5") as file:
        assert np.array_equal(file["steps"][:], np.arange(0, 41, 7))
        assert np.array_equal(file["z"][:, start : start + n], memory.Z[:n].T)
        assert np.array_equal(file["v"][:, start : start + n], memory.Z[n:].T)
        assert np.array_equal(file["q_s"][:], memory.q_s.T)
        assert np.array_equal(file["nodes"][start // 2 : (start + n) // 2], memory.layout.nodes)


def test_snapshots_that_cannot_be_joined_end_every_rank(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    if comm.rank == 0:
        (mpi_tmp_path / "snapshots.h5").mkdir()
    comm.Barrier()
    with pytest.raises(ResourceError, match=r"snapshots\.h5 cannot be written"):
        simulate(small(comm, 'output.snapshots="hdf5"'), RunOptions(directory=mpi_tmp_path))


def test_resume_without_or_with_foreign_checkpoint(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        simulate(small(comm), RunOptions(directory=mpi_tmp_path, resume=True))
    with pytest.raises(Interrupted):
        simulate(small(comm), RunOptions(directory=mpi_tmp_path, until=5))
    resumed = RunOptions(directory=mpi_tmp_path, resume=True)
    with pytest.raises(CheckpointError, match=r"with tissue\.material\.mu = 50.0, this run has 51.0; resume"):
        simulate(small(comm, "tissue.material.mu=51.0", "output.frames=7"), resumed)
    shown = ("output.frames=7", 'output.fields="none"', "output.checkpoint_every=9")  # the numbers are the same
    assert np.array_equal(simulate(small(comm, *shown), resumed).final, simulate(small(comm)).final)


def test_a_changed_csv_does_not_resume(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    table = mpi_tmp_path / "motion.csv"
    csv = (f'motion.csv="{table}"', 'motion.profile="csv"', "motion.target=false")

    def write(end: str) -> None:
        if comm.rank == 0:
            table.write_text(f"0,0,0\n1,0.5,0.2\n3,{end},1\n")
        comm.Barrier()

    write("2")
    with pytest.raises(Interrupted):
        simulate(small(comm, *csv), RunOptions(directory=mpi_tmp_path, until=5))
    write("2.5")
    with pytest.raises(CheckpointError, match="a file that the scene names is not what it was"):
        simulate(small(comm, *csv), RunOptions(directory=mpi_tmp_path, resume=True))
    write("nan")
    with pytest.raises(SceneError, match="has nan as column 2, at t = 3 s, in data row 3"):
        simulate(small(comm, *csv))


def test_snapshots_that_cannot_fit_are_refused_before_the_run(
    comm: MPI.Intracomm, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Tiny:
        available = 1000

    model = small(comm)  # which would not be built either
    monkeypatch.setattr("psutil.virtual_memory", lambda: Tiny)
    needed = 16 * model.system.layout.n_e * 41
    with pytest.raises(ResourceError, match=f"need {needed} bytes"):
        simulate(model)


def test_until_behind_the_checkpoint_is_refused(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        simulate(small(comm), RunOptions(directory=mpi_tmp_path, until=20))
    with pytest.raises(SceneError, match="at step 20 already"):
        simulate(small(comm), RunOptions(directory=mpi_tmp_path, resume=True, until=10))


def test_streamed_snapshots_of_another_stride_do_not_resume(comm: MPI.Intracomm, mpi_tmp_path: Path) -> None:
    hdf5 = 'output.snapshots="hdf5"'
    with pytest.raises(Interrupted):
        simulate(small(comm, hdf5), RunOptions(directory=mpi_tmp_path, until=20))
    with pytest.raises(CheckpointError, match=r"has \(41, .* needs \(21, "):
        simulate(small(comm, hdf5, "output.every=2"), RunOptions(directory=mpi_tmp_path, resume=True))


def test_steps_longer_than_the_move_are_refused(comm: MPI.Intracomm) -> None:
    with pytest.raises(SceneError, match=r"time\.steps = 20 .* use at least 200"):
        simulate(small(comm, "time.steps=20", "time.end=300.0", scene="paper_lqr"))
