"""What one row of the Riccati benchmark measures, inside the ranks that ``study.bench.riccati`` launches."""

from __future__ import annotations

import importlib
import importlib.util
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
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
from softgrasp.lqr.plant.coordinates import costates_to_relative, gain_to_absolute
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.lqr.reduced.riccati import gain_error
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
class Answer:
    """Factor and gain of a peer in hand-relative coordinates, with its time."""

    Z: Block
    K: Block
    seconds: float


def problem_for(comm: MPI.Intracomm, nx: int, beta: float) -> RiccatiProblem:
    """The paper's control problem on nx x 2 nx cells. Collective."""
    changes = [f"tissue.cells=[{nx}, {2 * nx}]", f"effects.damping.beta={beta!r}"]
    return make_problem(build(load_scene_collective(comm, shipped_scenes()["paper_lqr"], changes), comm=comm))


def run_method(comm: MPI.Intracomm, problem: RiccatiProblem, name: str, repeats: int) -> tuple[RiccatiSolution, float]:
    """The solution and the median time of a few runs [s]. Collective."""
    solution: list[RiccatiSolution] = []

    def solve() -> None:
        solution[:] = [METHODS[name]().solve(problem)]

    seconds = float(np.median(repeated(comm, solve, repeats, REPEAT_SECONDS)))
    return solution[0], seconds


def measure(nx: int, beta: float, methods: list[str], repeats: int, partial: str = "") -> dict[str, Any]:
    """All methods on nx x 2 nx cells; gains are compared with the first one. Collective.

    ``beta`` is the Kelvin-Voigt time [s]; the file ``partial`` keeps the methods done so far.
    """
    comm = MPI.COMM_WORLD
    problem = problem_for(comm, nx, beta)
    base = peak_memory_mb(comm)
    result: dict[str, Any] = {"states": problem.layout.states, "n_e": problem.layout.n_e, "ranks": comm.size}
    rows: dict[str, Any] = {}
    reference: Gain | None = None
    for name in methods:
        try:
            solution, seconds = run_method(comm, problem, name, repeats)
        except SoftgraspError as error:
            rows[name] = {"error": str(error)}
            continue
        rows[name] = {
            "seconds": seconds,
            "split": {part: sum(solution.seconds.get(key, 0.0) for key in keys) for part, keys in STAGES.items()},
            "solves": solution.counts["solves"],
            "newton_steps": solution.counts["newton_steps"],
            "rank": solution.rank,
            "residual": solution.residual,
            "memory_mb": peak_memory_mb(comm),
            "memory_base_mb": base,
        }
        gain = solution.gain
        if reference is None:
            reference = gain
        else:
            rows[name]["gain_difference"] = gain_error(problem, reference, gain)
        if partial and comm.rank == 0:
            Path(partial).write_text(json.dumps(result | {"methods": rows}))
    return result | {"methods": rows}


def _answer(problem: RiccatiProblem, E: Any, B: Array, Z: Array, seconds: float) -> Answer:
    s = 2 * problem.layout.n_s
    gain = -np.linalg.solve(problem.R, (B.T @ Z) @ (E.T @ Z).T).T
    relative = costates_to_relative(problem.system, Block(Z[:s], Z[s:]))
    return Answer(relative, gain_to_absolute(problem.system, Block(gain[:s], gain[s:]), -1), seconds)


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


def measure_peer(nx: int, beta: float, peer: str) -> dict[str, Any]:
    """One peer against our Newton-ADI, on one rank."""
    if importlib.util.find_spec(peer) is None:
        return {"missing": True}
    problem = problem_for(MPI.COMM_WORLD, nx, beta)
    reference = NewtonADI().solve(problem).gain
    begin = time.perf_counter()
    try:
        answer = PEERS[peer](problem)
    except Exception as error:  # a peer's failure is a result of the comparison
        return {"error": f"{type(error).__name__}: {error}"[:200], "seconds": time.perf_counter() - begin}
    return {
        "seconds": answer.seconds,
        "rank": answer.Z.columns,
        "residual": residual(problem, answer.Z),
        "gain_difference": gain_error(problem, reference, Gain.of_block(answer.K)),
        "states": problem.layout.states,
    }


def measure_row(**arguments: Any) -> dict[str, Any]:
    """A row that :mod:`softgrasp.study.bench.riccati` launches. Collective."""
    return (measure_peer if "peer" in arguments else measure)(**arguments)
