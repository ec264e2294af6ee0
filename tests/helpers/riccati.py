"""Control problems for the tests of the Riccati solvers, and their distance to an oracle."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import Array
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.dense.care import WeightedSystem
from softgrasp.lqr.dense.modal import DenseRiccati
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution
from tests.helpers.models import CUBE, LAYERS, gather_rows, make_scene

SCENE = Path(__file__).parents[2] / "demos" / "scenes" / "paper_lqr.toml"
NODE = {"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}
KELVIN = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.003}}, "control": NODE}
DRAG = {"effects": {"damping": {"kind": "rayleigh", "alpha": 0.05, "beta": 0.003, "drag": "space"}}}
REGION = [{"kind": "region", "box": [[0.0, 0.0], [0.6, 0.6]]}, {"kind": "hand"}]
CUBE_NODE = {"control": {"outputs": [{"kind": "node", "point": [0.9, 0.7, 0.1]}]}}
CASES: dict[str, tuple[dict[str, Any], ...]] = {
    "one_way": (KELVIN,),
    "two_way": (KELVIN, {"effects": {"reaction": True}}),
    "drag_in_space": (KELVIN, DRAG),
    "two_way_drag_in_space": (KELVIN, DRAG, {"effects": {"reaction": True}}),
    "layers": (KELVIN, {"tissue": {"layers": LAYERS}}),
    "cube": (CUBE, KELVIN, CUBE_NODE),
    "cube_two_way": (CUBE, KELVIN, CUBE_NODE, {"effects": {"reaction": True}}),
    "region_hand_weights": (
        KELVIN,
        {"control": {"outputs": REGION, "Q": np.diag([9.0, 1.0, 4.0, 0.0]).tolist(), "R": [[2.0, 0.5], [0.5, 1.0]]}},
    ),
}


@cache
def problem_of(name: str) -> RiccatiProblem:
    return make_problem(build(make_scene(*CASES[name]), comm=MPI.COMM_WORLD))


@cache
def oracle(name: str) -> RiccatiSolution:
    return DenseRiccati().solve(problem_of(name))


@cache
def paper(*changes: str) -> RiccatiProblem:
    return make_problem(build(load_scene(SCENE, ["tissue.cells=[5,10]", *changes]), comm=MPI.COMM_WORLD))


def gain(problem: RiccatiProblem, solution: RiccatiSolution) -> Array:
    """The gain in node order, (2n, m), on every rank."""
    layout = problem.layout
    K = solution.gain
    return np.vstack([K.K_s.T, gather_rows(layout, K.K_z), gather_rows(layout, K.K_v)])


def gain_error(problem: RiccatiProblem, ours: RiccatiSolution, theirs: RiccatiSolution) -> float:
    a, b = gain(problem, ours), gain(problem, theirs)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def factor(problem: RiccatiProblem, solution: RiccatiSolution) -> Array:
    """Z in node order, on every rank."""
    layout, n, Z = problem.layout, problem.layout.n_local, solution.factor
    return np.vstack([Z.hand, gather_rows(layout, Z.tall[:n]), gather_rows(layout, Z.tall[n:])])


def x_error(problem: RiccatiProblem, ours: RiccatiSolution, theirs: RiccatiSolution) -> float:
    a, b = factor(problem, ours), factor(problem, theirs)
    return float(np.linalg.norm(a @ a.T - b @ b.T, 2) / np.linalg.norm(b @ b.T, 2))


def hand_start(problem: RiccatiProblem, displacement: Sequence[float] | Array) -> Block:
    """Whole body at rest, displaced rigidly by hand coordinates [m, rad], (n_s,), as one column."""
    n_s = problem.layout.n_s
    hand = np.zeros((2 * n_s, 1))
    hand[:n_s, 0] = displacement
    return Block(hand, np.zeros((2 * problem.layout.n_local, 1)))


def closed_loop(m: WeightedSystem, P_N: Array) -> Array:
    """Eigenvalues of the reduced closed loop."""
    K = -np.linalg.solve(m.R, m.B.T @ P_N @ m.E)
    return np.asarray(scipy.linalg.eigvals(np.linalg.solve(m.E, m.A + m.B @ K)))
