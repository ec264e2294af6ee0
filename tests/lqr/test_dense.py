"""Dense Riccati solver on benchmark examples with known solutions, and the plant against scikit-fem in the paper's
coordinates."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.errors import ResourceError
from softgrasp.fem.model.build import build
from softgrasp.lqr.dense.care import care, riccati_schur
from softgrasp.lqr.dense.modal import DenseRiccati, relative_space
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.block import Block
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import Gain
from softgrasp.lqr.plant.operators import (
    costates_to_absolute,
    costates_to_relative,
    gain_to_absolute,
    states_to_relative,
)
from softgrasp.lqr.plant.problem import RiccatiProblem, RiccatiSolution, translation_defect, velocity_defect
from tests.helpers.models import (
    Array,
    close,
    first_order,
    gather_rows,
    held_by_paper,
    held_on_top,
    make_scene,
    reference,
)

EPS = np.finfo(float).eps
Example = tuple[Array, Array, Array, Array, Array, Array]  # A, B, C, Q, R, X

DRAG = {"effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.004, "drag": "space"}}}
BETA = {"effects": {"damping": {"kind": "kelvin-voigt", "beta": 0.002}}}


# --- CAREX (Abels and Benner 1999): examples with exact solutions


def carex_1_1() -> Example:
    return np.array([[0.0, 1], [0, 0]]), np.eye(2)[:, 1:], np.eye(2), np.diag([1.0, 2]), np.eye(1), _a([[2, 1], [1, 2]])


def carex_1_2() -> Example:
    Q = _a([[9, 6], [6, 4]])
    return _a([[4, 3], [-4.5, -3.5]]), _a([[1], [-1]]), np.eye(2), Q, np.eye(1), (1 + np.sqrt(2)) * Q


def carex_2_1(e: float) -> Example:
    """Becomes unstabilisable as e -> 0."""
    x_11, x_12 = (1 + np.sqrt(1 + e**2)) / e**2, 1 / (2 + np.sqrt(1 + e**2))
    X = _a([[x_11, x_12], [x_12, (1 - (e * x_12) ** 2) / 4]])
    return np.diag([1.0, -2]), _a([[e], [0]]), np.ones((1, 2)), np.eye(1), np.eye(1), X


def carex_2_3(e: float) -> Example:
    s = np.sqrt(1 + 2 * e)
    return _a([[0, e], [0, 0]]), np.eye(2)[:, 1:], np.eye(2), np.eye(2), np.eye(1), _a([[s / e, 1], [1, s]])


def carex_2_4(e: float) -> Example:
    """Closed-loop eigenvalue of about e: the Hamiltonian matrix is nearly defective at 0."""
    t = 1 + e
    x = (2 * t + np.sqrt(2) * (np.sqrt(t**2 + 1) + e)) / 2
    y = x / (x - t)
    return _a([[t, 1], [1, t]]), np.eye(2), np.eye(2), e**2 * np.eye(2), np.eye(2), _a([[x, y], [y, x]])


def carex_2_6(e: float) -> Example:
    """Entries from 1/e to e^2."""
    V = np.eye(3) - 2 / 3 * np.ones((3, 3))
    A, Q = e * V @ np.diag([1.0, 2, 3]) @ V, V @ np.diag([1 / e, 1, e]) @ V
    exact = [e**2 + np.sqrt(e**4 + 1), 2 * e**2 + np.sqrt(4 * e**4 + e), 3 * e**2 + e * np.sqrt(9 * e**2 + 1)]
    return A, np.eye(3), np.eye(3), (Q + Q.T) / 2, e * np.eye(3), V @ np.diag(exact) @ V


def carex_3_2(n: int) -> Example:
    first = np.zeros(n)
    first[[0, 1, -1]] = -2, 1, 1
    cosine = np.cos(2 * np.pi * np.arange(n) / n)
    values = -2 + 2 * cosine + np.sqrt(5 + 4 * cosine * (cosine - 2))
    one = np.eye(n)
    return scipy.linalg.circulant(first), one, one, one, one, scipy.linalg.circulant(np.fft.ifft(values).real)


def _a(rows: list[list[float]]) -> Array:
    return np.array(rows, dtype=float)


EXAMPLES: list[tuple[str, Callable[[], Example], float]] = [  # of X: 1e-14 is 45 eps
    ("1.1", carex_1_1, 1e-15),
    ("1.2", carex_1_2, 1e-13),  # X is singular: condition of the equation about 1e2
    ("2.1, e = 1", lambda: carex_2_1(1.0), 1e-14),
    ("2.1, e = 1e-3", lambda: carex_2_1(1e-3), 1e-14),
    ("2.1, e = 1e-6", lambda: carex_2_1(1e-6), 1e-13),  # the balancing takes e out
    ("2.3, e = 1", lambda: carex_2_3(1.0), 1e-14),
    ("2.3, e = 1e6", lambda: carex_2_3(1e6), 1e-14),
    ("2.4, e = 1", lambda: carex_2_4(1.0), 1e-14),
    ("2.4, e = 1e-4", lambda: carex_2_4(1e-4), 5e-12),  # the spectrum lies e from its mirror: some eps / e
    ("2.4, e = 1e-7", lambda: carex_2_4(1e-7), 1e-8),  # sqrt(eps) at a nearly defective eigenvalue, at worst
    ("2.6, e = 1", lambda: carex_2_6(1.0), 1e-14),
    ("2.6, e = 1e6", lambda: carex_2_6(1e6), 1e-13),  # entries over 18 decades: some hundred eps
    ("3.2, n = 64", lambda: carex_3_2(64), 1e-13),  # sums of 64
]


@pytest.mark.serial
def test_carex_with_known_solution() -> None:
    for name, example, tolerance in EXAMPLES:
        A, B, C, Q, R, X = example()
        copies = [M.copy() for M in (A, B, C, Q, R)]
        found = care(A, B, C, Q, R)
        assert close(found.X, X) < tolerance, name
        assert close(found.K, -np.linalg.solve(R, B.T @ X)) < 10 * tolerance, name  # ten for R^-1 B'
        assert found.abscissa < 0, name
        assert all((copy == M).all() for M, copy in zip((A, B, C, Q, R), copies, strict=True)), name


@pytest.mark.serial
def test_carex_2_5_indefinite_constant_term() -> None:
    for e in (1.0, 1e-2, 1e-4):
        A, B = _a([[3 - e, 1], [4, 2 - e]]), np.ones((2, 1))
        H = _a([[4 * e - 11, 2 * e - 5], [2 * e - 5, 2 * e - 2]])
        X, poles, _ = riccati_schur(A, B @ B.T, H)
        assert close(X, _a([[2, 1], [1, 1]])) < 100 * EPS / e**2, e  # poles -e +- i: the separation from the axis is e
        assert np.allclose(sorted(poles.imag), [-1, 1], atol=1e-6), e  # of a nearly double eigenvalue
    with pytest.raises(ControlError, match="no output may be rewarded"):
        care(A, B, np.eye(2), H, np.eye(1))


@pytest.mark.serial
def test_carex_2_5_on_the_axis_is_refused() -> None:
    A, B = _a([[3, 1], [4, 2]]), np.ones((2, 1))
    with pytest.raises(ControlError, match="on the imaginary axis to working precision"):
        riccati_schur(A, B @ B.T, _a([[-11, -5], [-5, -2]]))


@pytest.mark.serial
def test_carex_4_1_chain_of_integrators() -> None:
    n = 21
    A, one = np.diag(np.ones(n - 1), 1), np.eye(n)
    found = care(A, one[:, -1:], one[:1], np.eye(1), np.eye(1))
    assert abs(found.X[0, -1] - 1) < 1e-5  # x_1n = sqrt(qr); X has the condition 2e17, SciPy gets 6e-7
    assert found.backward < 1e-13  # eps n^2


@pytest.mark.serial
def test_carex_4_3_springs() -> None:
    """A free chain of masses: the rigid motion is a zero eigenvalue, as the hand's is."""
    k = 30
    N = 2 * np.eye(k) - np.eye(k, k=1) - np.eye(k, k=-1)
    N[0, 0] = N[-1, -1] = 1
    A = np.block([[np.zeros((k, k)), np.eye(k)], [-N / 4, -np.eye(k)]])
    B = np.zeros((2 * k, 2))
    B[k, 0], B[-1, 1] = 0.25, -0.25
    one = np.eye(2 * k)
    found = care(A, B, one, one, np.eye(2))
    X = scipy.linalg.solve_continuous_are(A, B, one, np.eye(2))
    assert close(found.X, X) < 1e-10  # SciPy's own accuracy on this well scaled example
    assert np.linalg.eigvalsh(found.X)[0] > 0


@pytest.mark.serial
@pytest.mark.parametrize("seed", range(2))
def test_random_with_descriptor_against_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, m, p = 12, 2, 3
    A, B, C = rng.standard_normal((n, n)), rng.standard_normal((n, m)), rng.standard_normal((p, n))
    E = np.eye(n) + 0.2 * rng.standard_normal((n, n))
    Q, R = np.diag([1.0, 10, 0]), _a([[2, 0.5], [0.5, 1]])
    found = care(A, B, C, Q, R, E)
    # SciPy's own way with E raises here, so E is taken out by hand: E'XE solves the equation of E^-1 A, E^-1 B
    Y = scipy.linalg.solve_continuous_are(np.linalg.solve(E, A), np.linalg.solve(E, B), C.T @ Q @ C, R)
    X = np.linalg.solve(E.T, np.linalg.solve(E.T, Y).T)
    assert close(found.X, X) < 1e-9  # condition of E and of the equation about 1e4
    residual = A.T @ X @ E + E.T @ X @ A - E.T @ X @ B @ np.linalg.solve(R, B.T @ X @ E) + C.T @ Q @ C
    assert np.linalg.norm(residual) < 1e-13 * np.linalg.norm(C.T @ Q @ C) * np.linalg.norm(X)  # rounding
    poles = scipy.linalg.eigvals(A + B @ found.K, E)
    assert close(np.sort(poles.real), np.sort(found.poles.real)) < 1e-10  # condition of the eigenvalues


def triple_chain(k: int, alpha: float, beta: float) -> tuple[Array, Array, Array, Array]:
    """Three chains of k masses tied to one more [TV09]: E, A, B, C."""
    n = 3 * k + 1
    M = np.diag(np.repeat([1.0, 2.0, 3.0, 10.0], [k, k, k, 1]))
    stiffness = [10.0, 20.0, 1.0]
    K = np.zeros((n, n))
    for j, kappa in enumerate(stiffness):
        part = slice(j * k, (j + 1) * k)
        K[part, part] = kappa * (2 * np.eye(k) - np.eye(k, k=1) - np.eye(k, k=-1))
        K[(j + 1) * k - 1, -1] = K[-1, (j + 1) * k - 1] = -kappa
    K[-1, -1] = sum(stiffness) + 50
    D = alpha * M + beta * K
    for i in (0, k, 2 * k):
        D[i, i] += 5
    zero, one = np.zeros((n, n)), np.eye(n)
    E, A = scipy.linalg.block_diag(one, M), np.block([[zero, one], [-K, -D]])
    return E, A, np.vstack([np.zeros((n, 1)), np.ones((n, 1))]), np.hstack([np.ones((1, n)), np.zeros((1, n))])


@pytest.mark.serial
def test_triple_chain_oscillator() -> None:
    E, A, B, C = triple_chain(20, 0.002, 0.002)
    found = care(A, B, C, np.eye(1), np.eye(1), E)
    X = found.X
    residual = A.T @ X @ E + E.T @ X @ A - E.T @ X @ B @ B.T @ X @ E + C.T @ C
    assert np.linalg.norm(residual, 2) < 1e-12 * np.linalg.norm(C.T @ C, 2)  # rounding of the products
    assert scipy.linalg.eigvals(A + B @ found.K, E).real.max() < -1e-4  # lightly damped, but stable
    assert np.linalg.eigvalsh(X)[0] > -1e-12 * np.linalg.norm(X, 2)  # rounding only


REFUSED: list[tuple[str, dict[str, Array], str]] = [
    ("input misses an unstable mode", {"B": _a([[0], [1]])}, "not stabilisable: no input reaches .* eigenvalue 1"),
    ("output misses an unstable mode", {"C": _a([[0, 1]])}, "not detectable: no weighted output sees"),
    ("R negative", {"R": -np.eye(1)}, "R has the eigenvalue -1"),
    ("R zero", {"R": np.zeros((1, 1))}, "R has the eigenvalue 0; all must be > 0"),
    ("Q negative", {"Q": -np.eye(1)}, "Q has the eigenvalue -1"),
    ("Q of the wrong size", {"Q": np.eye(2)}, r"Q has the shape \(2, 2\); it must be \(1, 1\)"),
    ("NaN", {"A": _a([[np.nan, 0], [0, 1]])}, "A has 1 entries that are not finite"),
    ("E singular", {"E": np.diag([1.0, 0])}, "E is singular"),
]


@pytest.mark.serial
def test_refused_with_one_sentence() -> None:
    data = {"A": np.diag([1.0, -2]), "B": np.ones((2, 1)), "C": np.ones((1, 2)), "Q": np.eye(1), "R": np.eye(1)}
    care(**data)
    for name, change, message in REFUSED:
        with pytest.raises(ControlError) as caught:
            care(**(data | change))
        assert re.search(message, str(caught.value)), name


@pytest.mark.serial
def test_undamped_oscillator_that_nothing_reaches() -> None:
    A = scipy.linalg.block_diag(_a([[0, 1], [-1, 0]]), -1.0)
    with pytest.raises(ControlError, match=r"eigenvalue 0\+1j"):
        care(A, _a([[0], [0], [1]]), np.ones((1, 3)), np.eye(1), np.eye(1))


# --- the plant


PLANTS: list[tuple[str, list[dict], Callable]] = [
    ("one-way", [BETA], held_by_paper),
    ("two-way", [BETA, {"effects": {"reaction": True}}], held_by_paper),
    ("Rayleigh", [{"effects": {"damping": {"kind": "rayleigh", "alpha": 0.3, "beta": 0.004}}}], held_by_paper),
    ("drag", [DRAG], held_by_paper),
    ("drag, two-way", [DRAG, {"effects": {"reaction": True}}], held_by_paper),
    (
        "rotation",
        [BETA, {"effects": {"rotation": True}},
         {"control": {"outputs": [{"kind": "node", "point": [0.5, 0.0]}, {"kind": "node", "point": [1.0, 1.0]}]}}],
        held_by_paper,
    ),
    ("3D", [BETA, {"tissue": {"size": [1.0, 0.8, 0.6], "cells": [2, 2, 3]},
                   "contact": {"sides": ["z+"], "box": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]},
                   "motion": {"target": [0.3, 0.2, 0.1]}}], held_on_top),
]  # fmt: skip


def make(*changes: dict) -> tuple:
    model = build(make_scene({"tissue": {"cells": [2, 4]}}, *changes), comm=MPI.COMM_WORLD)
    return model, make_problem(model)


def gather_block(layout, X: Block) -> Array:  # type: ignore[no-untyped-def]
    """Rows [q_s, q, v_s, v] in node order, the order of `helpers.first_order`."""
    n_s, n = layout.n_s, layout.n_local
    q, v = gather_rows(layout, X.tall[:n]), gather_rows(layout, X.tall[n:])
    return np.concatenate([X.hand[:n_s], q, X.hand[n_s:], v])


@pytest.mark.ranks
@pytest.mark.parametrize(("changes", "held"), [pytest.param(c, h, id=name) for name, c, h in PLANTS])
def test_solution_in_the_papers_coordinates_against_scikit_fem(changes: list[dict], held: Callable) -> None:
    """Residual of P in E, A, B assembled by another code in absolute displacements, and K = -R^-1 B'PE."""
    model, problem = make(*changes)
    layout = problem.layout
    solution = DenseRiccati().solve(problem)
    Z, K = costates_to_absolute(problem.system, solution.factor), gain_to_absolute(problem.system, solution.gain.block)
    plant = first_order(reference(model, held))
    n_s, Z = layout.n_s, gather_block(layout, Z)
    T, C_z = gather_rows(layout, problem.system.T), gather_rows(layout, problem.C_z)
    C = np.zeros((len(problem.Q), len(Z)))
    C[:, :n_s], C[:, n_s : n_s + len(C_z)] = problem.C_s - C_z.T @ T, C_z.T
    E, A, B, P = plant.E, plant.A, plant.B, Z @ Z.T
    residual = A.T @ P @ E + E.T @ P @ A - E.T @ P @ B @ np.linalg.solve(problem.R, B.T @ P @ E) + C.T @ problem.Q @ C
    # rounding of the two assemblies, 1e-13, times |A| |P| |E| / |C'QC| of about 1e4
    assert np.linalg.norm(residual, 2) < 1e-9 * np.linalg.norm(C.T @ problem.Q @ C, 2)
    K = gather_block(layout, K).T
    assert close(K, -np.linalg.solve(problem.R, B.T @ P @ E)) < 1e-10  # P has the condition 1e4 here
    assert scipy.linalg.eigvals(A + B @ K, E).real.max() < 0
    assert solution.residual < 1e-10  # rounding, as above
    # P_hat is unique: any other stabilising P, e.g. of twice the weight, must miss
    assert np.linalg.norm(residual + C.T @ C, 2) > 1e-3


def test_layers_of_different_damping_and_true_residual() -> None:
    layers = {
        "low": {"box": [[0.0, 0.0], [1.0, 1.0]], "material": {"lambda": 90.0, "mu": 20.0, "rho": 2.5}, "beta": 0.03}
    }
    _, problem = make(BETA, {"tissue": {"layers": layers}})
    solution = DenseRiccati().solve(problem)
    space = relative_space(problem)
    Z, K = whole(problem, solution.factor), whole(problem, solution.gain.block).T
    if space is not None:
        P, C = Z @ Z.T, space.C
        residual = space.A.T @ P @ space.E + space.E.T @ P @ space.A - K.T @ problem.R @ K + C.T @ problem.Q @ C
        assert np.linalg.norm(residual, 2) < 1e-10 * np.linalg.norm(C.T @ C, 2)  # rounding times |A| = 1e3
        assert scipy.linalg.eigvals(space.A + space.B @ K, space.E).real.max() < 0


def whole(problem: RiccatiProblem, X: Block) -> Array:
    """[q_s, v_s, z, v] in global numbering. Collective."""
    n, comm = problem.layout.n_local, problem.layout.comm
    halves = [np.concatenate(comm.allgather(np.array(part))) for part in (X.tall[:n], X.tall[n:])]
    return np.concatenate([X.hand, *halves])


@pytest.mark.parametrize("changes", [[BETA], [BETA, {"effects": {"reaction": True}}]], ids=["one-way", "two-way"])
def test_coordinates_there_and_back(changes: list[dict]) -> None:
    _, problem = make(*changes)
    system, rng = problem.system, np.random.default_rng(3)
    n_s, n = problem.layout.n_s, problem.layout.n_local
    X = Block(np.arange(2.0 * n_s * 3).reshape(2 * n_s, 3), rng.standard_normal((2 * n, 3)))
    solution = RiccatiSolution(X, Gain.of_block(X[:n_s]), 0, "dense")
    Z, K = costates_to_absolute(problem.system, solution.factor), gain_to_absolute(problem.system, solution.gain.block)
    for back, there in (
        (states_to_relative(system, states_to_relative(system, X, -1)), X),
        (costates_to_relative(system, Z), X),
        (gain_to_absolute(system, K, -1), solution.gain.block),
    ):
        assert close(back.hand, there.hand) < 1e-14  # one product with T and back
        assert n == 0 or close(back.tall, there.tall) < 1e-13  # as above


@pytest.mark.parametrize(("beta", "weight"), [(0.02, 1.0), (0.002, 1e4), (2e-4, 1.0)])
def test_exact_identities(beta: float, weight: float) -> None:
    R = [[2.0, 0.3], [0.3, 1.0]]
    control = {"outputs": [{"kind": "node", "point": [0.5, 0.0]}], "Q": weight, "R": R}
    _, problem = make({"effects": {"damping": {"kind": "kelvin-voigt", "beta": beta}}}, {"control": control})
    solution = DenseRiccati().solve(problem)
    assert translation_defect(problem, solution) < 1e-11  # the residual of X
    velocity = velocity_defect(problem, solution)
    assert velocity is not None
    assert velocity < 1e-11  # as above
    wrong = replace(solution, gain=replace(solution.gain, K_s=solution.gain.K_s * 1.001))
    assert translation_defect(problem, wrong) > 1e-3  # twice the 0.1 % in K'K


def test_drag_in_space_has_no_velocity_identity() -> None:
    _, problem = make(DRAG)
    solution = DenseRiccati().solve(problem)
    assert translation_defect(problem, solution) < 1e-11  # A x_T = 0 still
    assert velocity_defect(problem, solution) is None


def test_problem_is_not_changed_and_limits_are_told() -> None:
    _, problem = make(BETA)
    arrays = (problem.C_s, problem.C_z, problem.Q, problem.R, problem.system.G, problem.system.T)
    copies = [a.copy() for a in arrays]
    values = [A.getValuesCSR()[2].copy() for A in (problem.system.M_ee, problem.system.K_ee)]
    first, second = DenseRiccati().solve(problem), DenseRiccati().solve(problem)
    assert (first.gain.K_s == second.gain.K_s).all()
    assert (first.factor.tall == second.factor.tall).all()
    assert all((a == b).all() for a, b in zip(arrays, copies, strict=True))
    after = [A.getValuesCSR()[2] for A in (problem.system.M_ee, problem.system.K_ee)]
    assert all((a == b).all() for a, b in zip(after, values, strict=True))
    with pytest.raises(ResourceError, match="use newton_adi"):
        DenseRiccati(limit=10).solve(problem)


def test_unreachable_undamped_mode_is_named() -> None:
    """Without damping a mode that the output does not see cannot be stabilised."""
    model, _ = make()
    hand = {"outputs": [{"kind": "hand"}]}
    problem = make_problem(build(make_scene({"tissue": {"cells": [2, 4]}, "control": hand}), comm=MPI.COMM_WORLD))
    assert model.system.layout.n_e == problem.layout.n_e
    with pytest.raises(ControlError, match="modes cannot be stabilised in double precision, mode 1 "):
        DenseRiccati().solve(problem)
