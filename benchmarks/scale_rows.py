"""What one row of ``benchmarks.scale`` measures, inside the ranks that it launches."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from softgrasp.fem.fields.series import SeriesWriter
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import PETSc
from softgrasp.fem.run.forecast import Forecast, forecast
from softgrasp.fem.run.inexact import InexactMidpoint
from softgrasp.fem.run.simulate import Run, RunOptions
from softgrasp.fem.run.stepping import make_ts
from softgrasp.fem.scene.file import load_scene_collective
from softgrasp.fem.scene.scene import Scene
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell.timing import processor_seconds

STEPS = 200  # of the run whose time is reported
MOST_TIMED = 40  # steps that are timed with a factor, which are all alike; with iterations all are
FIRST = 5  # steps before the timed ones
SECONDS = 3.0  # of these steps together [s], about, where 40 would need more
NEARLY = "tissue.material={young=69e3, poisson=0.49, rho=1070.0}"  # silicone


@dataclass(frozen=True)
class ScaleCost:
    """One mesh on so many ranks: processor time of the slowest rank, and the model's."""

    kind: str  # dimension and order of the elements
    n_e: int  # tissue unknowns
    cells: int  # triangles or tetrahedra
    ranks: int  # number of ranks
    solver: str  # solver of the steps
    iterations: float  # iterations of a step; 0 by a factor
    seconds: dict[str, float]  # time of each stage [s]
    modelled: dict[str, float]  # modelled time of each stage [s]
    memory_mb: float  # peak of all ranks [MiB]
    memory_modelled_mb: float  # peak of all ranks by the cost model [MiB]
    memory_base_mb: float  # memory of the libraries alone, of all ranks [MiB]
    balance: dict[str, float]  # operations of the slowest rank over those of one rank's share, by stage [1]
    flops: dict[str, float]  # operations of all ranks by stage [1]


def scale_scene(comm: MPI.Intracomm, kind: str, size: int, solver: str = "auto") -> Scene:
    """The silicone block in a hand, or the paper's, on even cells with about so many unknowns. Collective."""
    d, order = int(kind[0]), int(kind[-1])
    even = [f"tissue.order={order}", f"time.steps={STEPS}", f"time.solver={solver}", "output.snapshots=none"]
    if d == 2:
        m = max(round((size / (4 * order**2)) ** 0.5), 2)
        return load_scene_collective(comm, "paper_forward", [*even, f"tissue.cells=[{m}, {2 * m}]"])
    m = max(round((size / (3 * order**3) / (32 / 9)) ** (1 / 3)), 2)
    cells = f"tissue.cells=[{round(4 * m / 3)}, {m}, {round(8 * m / 3)}]"
    return load_scene_collective(comm, "block_3d", [*even, cells, "tissue.refine=false", NEARLY])


class Stages:
    """Processor time and operations of named stages. Collective."""

    def __init__(self, comm: MPI.Intracomm) -> None:
        self.comm = comm
        self.seconds: dict[str, float] = {}
        self.flops: dict[str, float] = {}
        self.balance: dict[str, float] = {}

    def take(self, name: str, call: Callable[[], Any], times: int = 1) -> None:
        """Record the processor time of a call, divided by the number of times that it does the same."""
        before = PETSc.Log.getFlops()
        self.seconds[name] = processor_seconds(self.comm, call) / times
        mine = PETSc.Log.getFlops() - before
        every = self.comm.allreduce(mine)
        self.flops[name] = every / times
        self.balance[name] = self.comm.allreduce(mine, MPI.MAX) * self.comm.size / every if every else 1.0


def measure_row(*, kind: str, size: int, solver: str = "auto") -> list[ScaleCost]:
    """A run of so many unknowns, stage by stage. Collective."""
    comm = MPI.COMM_WORLD
    build(scale_scene(comm, kind, 10), comm=comm)  # compiles the forms
    base = peak_memory_mb(comm)
    scene, stages, made = scale_scene(comm, kind, size, solver), Stages(comm), list[Any]()
    stages.take("build", lambda: made.append(build(scene, comm=comm)))
    model = made[0]
    layout = model.system.layout
    model.system.release()
    stages.take("set-up", lambda: made.append(Run(model, RunOptions())))
    run = made[1]
    ts = make_ts(run)
    stages.take("equilibrium", run.start)
    iterations = 0.0
    if isinstance(run.midpoint, InexactMidpoint):  # iterations become fewer along a run, as the last solutions serve
        stages.take("step", lambda: run.advance_to(ts, STEPS), STEPS)
        iterations = float(np.mean(run.midpoint.iterations))
    else:
        run.advance_to(ts, FIRST)
        paced = processor_seconds(comm, lambda: run.advance_to(ts, FIRST + 1))
        count = int(np.clip(SECONDS / max(paced, 1e-6), 2, MOST_TIMED))
        stages.take("step", lambda: run.advance_to(ts, FIRST + 1 + count), count)
    with tempfile.TemporaryDirectory() as folder:
        writer = SeriesWriter(model, comm.bcast(folder))
        (z, v), q = np.split(run.state.array, 2), np.zeros(layout.n_s)
        stages.take("frame", lambda: writer.write(0.0, z, v, q, q))
        comm.Barrier()
    mesh = model.space.mesh
    cells = int(mesh.mesh.topology.index_map(mesh.dimension).size_global)
    told = forecast(scene, layout.n_e, layout.dimension, cells, comm.size)
    return [
        ScaleCost(
            kind, layout.n_e, cells, comm.size, run.solver.name, iterations, stages.seconds, stages_of(told),
            peak_memory_mb(comm), told.memory / 2**20, base, stages.balance, stages.flops,
        )
    ]  # fmt: skip


def stages_of(told: Forecast) -> dict[str, float]:
    """The model's time of each stage, of one step and one frame [s]."""
    return {
        "build": told.build, "set-up": told.setup, "equilibrium": told.equilibrium, "step": told.steps / STEPS,
        "frame": told.fields / max(told.frames, 1),
    }  # fmt: skip
