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
from softgrasp.fem.petsc import Array, to_scipy
from softgrasp.fem.scene.file import load_scene_collective, shipped_scenes
from softgrasp.lqr.design import make_problem
from softgrasp.lqr.lowrank.galerkin import StructuredGalerkin
from softgrasp.lqr.lowrank.newton import NewtonADI
from softgrasp.lqr.lowrank.radi import RADI
from softgrasp.lqr.lowrank.residual import residual
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.coordinates import costates_to_relative, gain_of, gain_to_relative
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from softgrasp.study.report.origin import peak_memory_mb
from softgrasp.study.shell.jobs import leave_result

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
    return make_problem(build(load_scene_collective(comm, shipped_scenes()["paper_lqr"], changes), comm))


def gain_difference(problem: RiccatiProblem, K: Block, reference: Block) -> float:
    """||K - K_ref||_2 / ||K_ref||_2, Frobenius, hand-relative coordinates. Collective."""
    comm = problem.layout.comm

    def size(X: Block) -> float:
        return float(np.sum(X.hand**2) + comm.allreduce(float(np.sum(X.tall**2))))

    return float(np.sqrt(size(Block(K.hand - reference.hand, K.tall - reference.tall)) / size(reference)))


def run_method(comm: MPI.Intracomm, problem: RiccatiProblem, name: str, repeats: int) -> tuple[RiccatiSolution, float]:
    """The solution and the median time of a few runs [s]. Collective."""
    times: list[float] = []
    while True:
        comm.Barrier()
        begin = time.perf_counter()
        solution = METHODS[name]().solve(problem)
        times.append(comm.allreduce(time.perf_counter() - begin, op=MPI.MAX))
        if len(times) >= repeats or sum(times) > REPEAT_SECONDS:
            return solution, float(np.median(times))


def describe(solution: RiccatiSolution, seconds: float, base: float, memory: float) -> dict[str, Any]:
    """The numbers of one method. Not collective."""
    split = {name: sum(solution.seconds.get(key, 0.0) for key in keys) for name, keys in STAGES.items()}
    return {
        "seconds": seconds,
        "split": split,
        "solves": solution.counts["solves"],
        "newton_steps": solution.counts["newton_steps"],
        "rank": solution.rank,
        "residual": solution.residual,
        "memory_mb": memory,
        "memory_base_mb": base,
    }


def measure(nx: int, beta: float, methods: list[str], repeats: int, partial: str = "") -> dict[str, Any]:
    """All methods on one mesh; gains are compared with the first one. Collective.

    Args:
        nx: cells across.
        beta: Kelvin-Voigt time [s].
        methods: names in :data:`METHODS`.
        repeats: runs behind each median.
        partial: file that keeps the methods done so far.
    """
    comm = MPI.COMM_WORLD
    problem = problem_for(comm, nx, beta)
    base = peak_memory_mb(comm)
    result: dict[str, Any] = {"states": problem.layout.states, "n_e": problem.layout.n_e, "ranks": comm.size}
    rows: dict[str, Any] = {}
    reference: Block | None = None
    for name in methods:
        try:
            solution, seconds = run_method(comm, problem, name, repeats)
        except SoftgraspError as error:
            rows[name] = {"error": str(error)}
            continue
        rows[name] = describe(solution, seconds, base, peak_memory_mb(comm))
        gain = gain_of(solution)
        if reference is None:
            reference = gain
        else:
            rows[name]["gain_difference"] = gain_difference(problem, gain, reference)
        if partial and comm.rank == 0:
            Path(partial).write_text(json.dumps(result | {"methods": rows}))
    return result | {"methods": rows}


def paper_form(problem: RiccatiProblem) -> tuple[Any, Any, Array, Array]:
    """Sparse E, A and dense B, C of the paper, x = [q_s, v_s, q_e, v_e], one rank, one-way. Not collective."""
    system, n_s = problem.system, problem.layout.n_s
    M, K = to_scipy(system.M_ee), to_scipy(system.K_ee)
    n = M.shape[0]
    D = system.damping.alpha * M + system.damping.beta * K
    M_es, one = scipy.sparse.csc_matrix(system.G - M @ system.T), scipy.sparse.identity
    K_es, D_es = scipy.sparse.csc_matrix(-K @ system.T), scipy.sparse.csc_matrix(-D @ system.T)
    E = scipy.sparse.bmat(
        [
            [one(n_s), None, None, None],
            [None, scipy.sparse.csc_matrix(problem.M_s), None, None],
            [None, None, one(n), None],
            [None, M_es, None, M],
        ]
    ).tocsc()
    A = scipy.sparse.bmat(
        [
            [None, one(n_s), None, None],
            [scipy.sparse.csc_matrix((n_s, n_s)), None, None, None],
            [None, None, scipy.sparse.csc_matrix((n, n)), one(n)],
            [-K_es, -D_es, -K, -D],
        ]
    ).tocsc()
    B = np.zeros((2 * (n + n_s), n_s))
    B[n_s : 2 * n_s] = np.eye(n_s)
    C = np.zeros((problem.C_s.shape[0], len(B)))
    C[:, :n_s] = problem.C_s - problem.C_z.T @ system.T
    C[:, 2 * n_s : 2 * n_s + n] = problem.C_z.T
    return E, A, B, C


def _answer(problem: RiccatiProblem, E: Any, B: Array, Z: Array, seconds: float) -> Answer:
    s = 2 * problem.layout.n_s
    gain = -np.linalg.solve(problem.R, (B.T @ Z) @ (E.T @ Z).T).T
    relative = costates_to_relative(problem.system, Block(Z[:s], Z[s:]))
    return Answer(relative, gain_to_relative(problem.system, Block(gain[:s], gain[s:])), seconds)


def scipy_answer(problem: RiccatiProblem) -> Answer:
    """SciPy's dense solver on the paper's matrices as they stand. Not collective."""
    E, A, B, C = paper_form(problem)
    begin = time.perf_counter()
    X = scipy.linalg.solve_continuous_are(A.toarray(), B, C.T @ problem.Q @ C, problem.R, e=E.toarray())
    seconds = time.perf_counter() - begin
    values, vectors = np.linalg.eigh((X + X.T) / 2)
    keep = values > 0
    return _answer(problem, E, B, vectors[:, keep] * np.sqrt(values[keep]), seconds)


def slycot_answer(problem: RiccatiProblem) -> Answer:
    """SLICOT's SG02AD through slycot on the paper's matrices. Not collective."""
    slycot = importlib.import_module("slycot")

    E, A, B, C = paper_form(problem)
    n, m, p = len(B), B.shape[1], len(C)
    begin = time.perf_counter()
    found = slycot.sg02ad(
        "C", "B", "N", "U", "Z", "N", "S", "R", n, m, p, A.toarray(), E.toarray(), B,
        C.T @ problem.Q @ C, problem.R, np.zeros((n, m)),
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    values, vectors = np.linalg.eigh((found[1] + found[1].T) / 2)
    keep = values > 0
    return _answer(problem, E, B, vectors[:, keep] * np.sqrt(values[keep]), seconds)


def pymor_answer(problem: RiccatiProblem) -> Answer:
    """The low-rank RADI of pyMOR on the paper's sparse matrices. Not collective."""
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
    """One peer against our Newton-ADI, on one rank. Not collective."""
    if importlib.util.find_spec(peer) is None:
        return {"missing": True}
    problem = problem_for(MPI.COMM_WORLD, nx, beta)
    reference = gain_of(NewtonADI().solve(problem))
    begin = time.perf_counter()
    try:
        answer = PEERS[peer](problem)
    except Exception as error:  # a peer's failure is a result of the comparison
        return {"error": f"{type(error).__name__}: {error}"[:200], "seconds": time.perf_counter() - begin}
    n, Z = problem.layout.n_local, answer.Z
    candidate = RiccatiSolution(
        Z.hand, Z.tall[:n], Z.tall[n:], answer.K.hand.T, answer.K.tall[:n], answer.K.tall[n:], np.inf, peer
    )
    return {
        "seconds": answer.seconds,
        "rank": candidate.rank,
        "residual": residual(problem, candidate),
        "gain_difference": gain_difference(problem, answer.K, reference),
        "states": problem.layout.states,
    }


def run_worker(spec: dict[str, Any]) -> None:
    """Measure what the driver asks for and leave the numbers in its file. Collective."""
    arguments = {key: value for key, value in spec.items() if key != "file"}
    leave_result(spec["file"], lambda: measure_peer(**arguments) if "peer" in arguments else measure(**arguments))
