"""What one row of the Riccati benchmark measures, inside the ranks that ``study.bench.riccati`` launches."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
from mpi4py import MPI

from softgrasp.fem.errors import SoftgraspError
from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.file import load_scene_collective, shipped_scenes
from softgrasp.lqr.dense.modal import factor_psd
from softgrasp.lqr.dense.paper import paper_form
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import costates_to_relative, gain_to_absolute
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.riccati import gain_error
from softgrasp.study.bench.driver import Failure
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell.timing import repeated

METHODS: dict[str, Callable[[], Any]] = {"newton_adi": NewtonADI, "radi": RADI, "galerkin": StructuredGalerkin}
REPEAT_SECONDS = 3.0  # a method is repeated while it has taken less
STAGES = {
    "factor": ("factor",),
    "solve": ("solve",),
    "shifts": ("start", "shifts"),
    "dense": ("small", "products", "compress"),
    "residual": ("residual",),
}


@dataclass(frozen=True)
class RiccatiPoint:
    """One method on nx x 2 nx cells; a peer has fewer numbers."""

    nx: int
    ranks: int
    method: str
    states: int
    seconds: float  # median
    rank: int  # of Z
    residual: float  # relative, recomputed from Z
    gain_difference: float | None  # relative, to the gain of the first method
    split: dict[str, float] = field(default_factory=dict)  # seconds by stage
    solves: int = 0
    newton_steps: int = 0
    # memory_mb, memory_base_mb: peak of all ranks, and that before the first method [MiB]
    memory_mb: float = 0.0
    memory_base_mb: float = 0.0


def problem_for(comm: MPI.Intracomm, nx: int, beta: float) -> RiccatiProblem:
    """The paper's control problem on nx x 2 nx cells. Collective."""
    changes = [f"tissue.cells=[{nx}, {2 * nx}]", f"effects.damping.beta={beta!r}"]
    return make_problem(build(load_scene_collective(comm, shipped_scenes()["paper_lqr"], changes), comm=comm))


def measure(nx: int, beta: float, methods: Sequence[str], repeats: int) -> Iterator[RiccatiPoint | Failure]:
    """All methods on nx x 2 nx cells; gains are compared with the first one. Collective.

    ``beta`` is the Kelvin-Voigt time [s].
    """
    comm = MPI.COMM_WORLD
    problem = problem_for(comm, nx, beta)
    base = peak_memory_mb(comm)
    reference: Gain | None = None
    for name in methods:
        solved: list[RiccatiSolution] = []
        solve = partial(lambda name, to: to.append(METHODS[name]().solve(problem)), name, solved)
        try:
            seconds = float(np.median(repeated(comm, solve, repeats, REPEAT_SECONDS)))
        except SoftgraspError as error:
            yield Failure(f"nx = {nx}, {name}", comm.size, str(error))
            continue
        s = solved[-1]
        yield RiccatiPoint(
            nx, comm.size, name, problem.layout.states, seconds, s.rank, s.residual,
            None if reference is None else gain_error(problem, reference, s.gain),
            {part: sum(s.seconds.get(key, 0.0) for key in keys) for part, keys in STAGES.items()},
            s.counts["solves"], s.counts["newton_steps"], peak_memory_mb(comm), base,
        )  # fmt: skip
        reference = reference or s.gain


Answer = tuple[Block, Gain, float]  # Z and gain of a peer in hand-relative coordinates, and its seconds


def _answer(problem: RiccatiProblem, E: Any, B: Array, Z: Array, seconds: float) -> Answer:
    s = 2 * problem.layout.n_s
    gain = -np.linalg.solve(problem.R, (B.T @ Z) @ (E.T @ Z).T).T
    relative = costates_to_relative(problem.system, Block(Z[:s], Z[s:]))
    return relative, Gain.of_block(gain_to_absolute(problem.system, Block(gain[:s], gain[s:]), -1)), seconds


def scipy_answer(problem: RiccatiProblem) -> Answer:
    """SciPy's dense solver on the paper's matrices as they stand."""
    E, A, B, C = paper_form(problem)
    begin = time.perf_counter()
    X = scipy.linalg.solve_continuous_are(A.toarray(), B, C.T @ problem.Q @ C, problem.R, e=E.toarray())
    seconds = time.perf_counter() - begin
    return _answer(problem, E, B, factor_psd(X), seconds)


def slycot_answer(problem: RiccatiProblem) -> Answer:
    """SLICOT's SG02AD through slycot on the paper's matrices."""
    slycot = importlib.import_module("slycot")

    E, A, B, C = paper_form(problem)
    n, m, p = len(B), B.shape[1], len(C)
    begin = time.perf_counter()
    _, X, *_ = slycot.sg02ad(
        "C", "B", "N", "U", "Z", "N", "S", "R", n, m, p, A.toarray(), E.toarray(), B,
        C.T @ problem.Q @ C, problem.R, np.zeros((n, m)),
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    return _answer(problem, E, B, factor_psd(X), seconds)


def pymor_answer(problem: RiccatiProblem) -> Answer:
    """The low-rank RADI of pyMOR on the paper's sparse matrices."""
    from pymor.core.logger import set_log_levels
    from pymor.operators.numpy import NumpyMatrixOperator
    from pymor.solvers.matrix_equations.equations import RiccatiEquation
    from pymor.solvers.matrix_equations.radi import RADIRiccatiSolver

    set_log_levels({"pymor": "ERROR"})
    E, A, B, C = paper_form(problem)
    weighted = scipy.linalg.sqrtm(problem.Q).real @ C
    operator = NumpyMatrixOperator(A)
    space = operator.source
    equation = RiccatiEquation(
        operator, NumpyMatrixOperator(E), space.from_numpy(B), space.from_numpy(weighted.T), R=problem.R, trans=True
    )
    begin = time.perf_counter()
    Z = RADIRiccatiSolver().solve(equation).to_numpy()
    return _answer(problem, E, B, Z, time.perf_counter() - begin)


PEERS = {"scipy": scipy_answer, "slycot": slycot_answer, "pymor": pymor_answer}


def measure_peer(nx: int, beta: float, peer: str) -> Iterator[RiccatiPoint | Failure]:
    """One peer against our Newton-ADI, on one rank."""
    problem = problem_for(MPI.COMM_WORLD, nx, beta)
    reference = NewtonADI().solve(problem).gain
    try:
        Z, gain, seconds = PEERS[peer](problem)
    except Exception as error:  # a peer's failure is a result of the comparison
        yield Failure(f"{peer}, nx = {nx}", 1, f"failed, {type(error).__name__}: {error}"[:200])
        return
    accuracy = residual(problem, Z), gain_error(problem, reference, gain)
    yield RiccatiPoint(nx, 1, peer, problem.layout.states, seconds, Z.columns, *accuracy)


def measure_row(**arguments: Any) -> Iterator[RiccatiPoint | Failure]:
    """The points that :mod:`softgrasp.study.bench.riccati` asks for. Collective."""
    return (measure_peer if "peer" in arguments else measure)(**arguments)
