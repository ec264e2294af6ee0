"""The Kalman filter of the full tissue: against a dense Riccati equation of all modes, and what it takes."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.model.build import build
from softgrasp.fem.petsc import rows_on_all, total
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.observer.full import FullFilter, full_filter
from softgrasp.lqr.observer.sensors import Disturbance, Noise, Sensors, make_disturbance, make_sensors
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import rest
from softgrasp.lqr.spectrum.modal_loop import DENSE_LIMIT, ModalLoop

MARKERS = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
BOTTOM = [[0.0, 0.0], [1.0, 0.0]]
TICK = 1e-3
STIFF = "tissue.layers.top={box=[[0,1],[1,2]],material={lambda=200.0,mu=200.0,rho=2.0},beta=0.004}"


def make(*overrides: str) -> tuple[RiccatiProblem, Sensors, Disturbance, FullFilter]:
    problem = make_problem(build(load_scene("paper_lqr", list(overrides)), comm=MPI.COMM_WORLD))
    sensors = make_sensors(problem, MARKERS, Noise(1e-5))
    disturbance = make_disturbance(problem, 0.02, 0.05, BOTTOM)
    return problem, sensors, disturbance, full_filter(problem, sensors, disturbance, TICK)


@pytest.mark.parametrize("overrides", [[], [STIFF]])
def test_gain_is_that_of_the_dense_filter_of_all_modes(overrides: list[str]) -> None:
    problem, sensors, disturbance, found = make("tissue.cells=[4,8]", *overrides)
    modes = ModalLoop(problem, DENSE_LIMIT).plant
    n, w = len(modes.omega), modes.omega
    A = np.block([[np.zeros((n, n)), np.diag(w)], [-np.diag(w), -modes.D]])  # of [omega eta, eta']
    comm = problem.layout.comm
    C = np.hstack([total(comm, sensors.of(modes.Phi)[0])[sensors.markers] / w, np.zeros((8, n))])
    F = np.vstack([np.zeros((n, 4)), total(comm, modes.Phi.T @ np.hstack([problem.system.G, disturbance.p]))])
    V = np.eye(8) * 1e-6 * TICK
    S = scipy.linalg.solve_continuous_are(A.T, C.T, F @ disturbance.W @ F.T, V)
    exact = S @ C.T @ np.linalg.inv(V)
    gain = np.vstack([w[:, None] * total(comm, modes.massed.T @ found.L_1), total(comm, modes.Phi.T @ found.L_2)])
    # the residual 1e-10 of the equation through its condition
    assert np.abs(gain - exact).max() < 1e-8 * np.abs(exact).max()
    tip = modes.c / w
    exact_sd = np.sqrt(np.diag(tip @ S[:n, :n] @ tip.T))
    assert np.abs(found.sd_of(problem, problem.C_z) / exact_sd - 1).max() < 1e-6  # a root of the residual's size
    nodes = np.sqrt(np.sum((modes.Phi / w) * ((modes.Phi / w) @ S[:n, :n]), axis=1))
    assert np.abs(found.sd / nodes - 1).max() < 1e-6


def test_dual_equation_is_solved_in_few_solves() -> None:
    found = make()[-1].solution
    assert found.residual <= 1e-10
    assert found.counts["solves"] <= 60


@pytest.mark.slow
def test_solves_do_not_grow_with_the_mesh() -> None:
    coarse, fine = make()[-1].solution, make("tissue.cells=[40,80]")[-1].solution
    assert fine.residual <= 1e-10
    assert fine.counts["solves"] <= 2 * coarse.counts["solves"]


@pytest.mark.ranks
def test_deviations_do_not_depend_on_the_ranks() -> None:
    problem, _, _, found = make("tissue.cells=[4,8]")
    sd = found.sd_of(problem, problem.C_z)
    assert np.allclose(sd, [1.954288e-4, 1.964913e-4], rtol=1e-5)  # of one rank, to the residual of the equation
    assert len(rows_on_all(problem.layout.comm, found.sd)) == problem.layout.n_e


def test_force_sensor_reads_the_load_that_hangs_on_the_hand() -> None:
    model = build(load_scene("paper_lqr", ["tissue.cells=[4,8]", "effects.gravity=[0.3,-1.0]"]), comm=MPI.COMM_SELF)
    problem = make_problem(model)
    force = make_sensors(problem, [], Noise(1e-5, force=0.1)).C.parts[2][:, 2:].T @ rest(problem.system).z
    # free nodes carry their share of the weight rho g |body| through the contact zone, which holds the rest
    held = force / (problem.system.M_rigid @ np.array([0.3, -1.0]))
    assert np.allclose(held, held[0], rtol=1e-10)  # the load is along g; rounding of the equilibrium
    assert 0.7 < held[0] < 1.0  # three quarters of the body lie below the zone


@pytest.mark.parametrize(
    ("markers", "sentence"),
    [
        ([[0.0, 3.0]], "markers[0] = [0.0, 3.0] lies outside the body"),
        ([[0.0, 0.0], [0.01, 0.0]], "markers[1] = [0.01, 0.0] names the node [0.0, 0.0] a second time"),
        ([[0.0, 0.0, 0.0]], "markers[0] = [0.0, 0.0, 0.0] must have 2 entries"),
    ],
)
def test_markers_that_do_not_fit_are_refused(markers: list[list[float]], sentence: str) -> None:
    problem = make_problem(build(load_scene("paper_lqr", ["tissue.cells=[4,8]"]), comm=MPI.COMM_SELF))
    with pytest.raises(ControlError) as error:
        make_sensors(problem, markers, Noise(1e-5))
    assert sentence in str(error.value)
    blind, acting = make_sensors(problem, [], Noise(1e-5, force=1.0)), make_disturbance(problem, 0.02, 0.05, None)
    with pytest.raises(ControlError, match="needs markers"):
        full_filter(problem, blind, acting, TICK)
    with pytest.raises(ControlError, match=r"disturbance.box = \[\[5, 5\], \[6, 6\]\] contains no free node"):
        make_disturbance(problem, 0.02, 0.05, [[5, 5], [6, 6]])
