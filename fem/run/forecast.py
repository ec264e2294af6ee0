"""Modelled time and memory of a scene's run on other ranks, by :mod:`softgrasp.fem.solve.costs`.

Seconds of cores like the one where its constants were measured; pictures and the estimate of the mesh come on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from softgrasp.fem.model.build import Model
from softgrasp.fem.model.memory import factor_bytes, need, solver_memory, steps_of
from softgrasp.fem.resources import size_text
from softgrasp.fem.run.states.frames import frame_count
from softgrasp.fem.scene.scene import Scene
from softgrasp.fem.solve.costs import BUILD, ENTRIES, ITERATIVE, SolverName, seams
from softgrasp.fem.solve.stiffness import resting_solves

if TYPE_CHECKING:
    from softgrasp.fem.run.contact.expected import ExpectedContact

TYPICAL, WORST = 1.3, 2.4  # factors of `python -m benchmarks scale`, the geometric mean and the largest, of whole runs
START = 3.0  # time of every command: imports, page and pictures of a small run [s]
LIBRARIES = 160.0 * 2**20  # memory of the libraries on each rank [byte]
PRODUCTS = 2  # products of a step beside its solve, those of its vectors included [1]
# Time of a frame of the field files, by dimension and order [s a cell].
FRAME = {(2, 1): 3.5e-7, (2, 2): 6e-7, (2, 3): 1.1e-6, (3, 1): 3.5e-7, (3, 2): 8e-7, (3, 3): 3e-6}
RELIABLE = f"wrong by a factor of {TYPICAL:g}, at most {WORST:g}, on the machine where it was measured (1 and 2 ranks)"
RANKS = (1, 2, 16, 128)  # numbers of ranks in the forecast


@dataclass(frozen=True)
class Forecast:
    """Modelled time and memory of a run."""

    ranks: int  # number of ranks [1]
    solver: SolverName  # solver of the steps
    build: float  # time of mesh and assembly [s]
    setup: float  # time of the set-up of the solver [s]
    equilibrium: float  # time of the equilibrium at the start [s]; 0 without one
    steps: float  # time of all steps [s]
    fields: float  # time of the field files [s]
    frames: int  # number of their instants [1]
    memory: float  # memory over all ranks [byte]
    contact: float = 0.0  # time of first touches of obstacles and, at most, of steps in contact [s]

    @property
    def seconds(self) -> float:
        """Time in all, the start of the command included [s]."""
        return START + self.build + self.setup + self.equilibrium + self.steps + self.fields + self.contact


def forecast(
    scene: Scene,
    n: int,
    d: int,
    cells: int,
    ranks: int,
    touching: ExpectedContact | None = None,
) -> Forecast:
    """Modelled time and memory of a linear run on so many ranks.

    Args:
        n: unknowns of the tissue.
        d: dimension.
        cells: triangles or tetrahedra.
        touching: contact with obstacles, or None.
    """
    kind, work, share = (d, scene.tissue.order), steps_of(scene, n, d, ranks), seams(n, d, ranks)
    requested, limit = scene.time.solver, solver_memory(scene, n, d)
    name = work.solver(requested, limit)
    first = scene.time.start == "equilibrium" and scene.effects.gravity
    static = replace(work, solves=resting_solves(n, d), few=True)
    resting = static.solver(requested, limit)
    frames = frame_count(scene, n) + 1 if scene.output.fields != "none" else 0
    memory = need(scene, d, cells, ranks, run=True).of(1.0, ranks) + ranks * LIBRARIES
    if name in ITERATIVE:
        memory += work.memory(name)
    if first:  # both are there at once
        memory += static.memory(resting)
    if touching is not None:
        memory += touching.memory(n, ranks, work.copies(name), name)
    return Forecast(
        ranks=ranks,
        solver=name,
        build=BUILD[kind] * cells * share,
        setup=work.setup(name),
        equilibrium=static.setup(resting) + static.solve(resting) if first else 0.0,
        steps=work.solves * (work.solve(name) + PRODUCTS * work.product(ENTRIES[kind])),
        frames=frames,
        fields=frames * FRAME[kind] * cells * share,
        memory=memory,
        contact=0.0
        if touching is None
        else touching.seconds(n, work.solve(name), work.solves, factor_bytes(name, n, d, 1.0), name),
    )


def forecasts(
    model: Model, scene: Scene | None = None, n_e: int | None = None, cells: int | None = None
) -> tuple[Forecast, ...]:
    """Modelled time and memory of a run on its own number of ranks and on :data:`RANKS`, linear only.

    Args:
        scene, n_e, cells: scene, unknowns and cells of the run; None: those of the model.
    """
    scene, layout = scene or model.scene, model.system.layout
    if model.system.points is not None or model.system.frame is not None:
        return ()
    n, simplices = n_e or layout.n_e, cells or model.cells
    counts, touching = sorted({*RANKS, layout.comm.size}), None
    if scene.effects.obstacles:  # only scenes with contact pay for it
        from softgrasp.fem.run.contact.expected import expected_contact

        touching = expected_contact(model, n)
    return tuple(forecast(scene, n, layout.dimension, simplices, ranks, touching) for ranks in counts)


def told(results: Sequence[Forecast]) -> str:
    """Time and memory by the number of ranks in one sentence; empty without any."""
    if not results:
        return ""
    first, *others = [f"{f.seconds:.2g} s and {size_text(f.memory)}" for f in results]
    ranks = [f"{f.ranks}" for f in results]
    rest = ", ".join(f"{text} on {count}" for text, count in zip(others, ranks[1:], strict=True))
    return f"cost model: about {first} on {ranks[0]} rank, {rest}; {RELIABLE}"
