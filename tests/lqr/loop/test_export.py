"""The controller of a robot, its file, and the exports against python-control and pyMOR."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI

from softgrasp.fem.columns import hand_columns
from softgrasp.fem.mesh.scene_hash import scene_hash
from softgrasp.fem.model.build import Model, build
from softgrasp.fem.model.outputs import make_outputs
from softgrasp.fem.reduced import ReducedSystem, ReducedSystemError
from softgrasp.fem.solve.modes import lowest_modes
from softgrasp.lqr.loop.actuation import Actuation
from softgrasp.lqr.loop.controller import Controller, layout_hash, load_gain, save_gain
from softgrasp.lqr.loop.full import ClosedLoop
from softgrasp.lqr.loop.small import Shapes, galerkin
from softgrasp.lqr.plant.checks import ControlError
from softgrasp.lqr.plant.gain import PlantState
from softgrasp.lqr.plant.problem import RiccatiProblem
from softgrasp.lqr.plant.target import hand_target, rest
from tests.helpers.models import close, gather_rows, make_scene, same_everywhere
from tests.helpers.small_loop import expand, expand_gain, run_small

Array = np.ndarray
Q, R = 30.0, 0.5
EFFECTS: dict[str, Any] = {
    "damping": {"kind": "kelvin-voigt", "beta": 0.05},
    "gravity": {"g": [0.5, -2.0], "hand_weight": True},
}


def make_model(**tables: Any) -> Model:
    scene = make_scene(effects=EFFECTS, control={"outputs": [{"kind": "node", "point": [0.5, 0.0]}]}, **tables)
    return build(scene, comm=MPI.COMM_WORLD)


def make_problem(model: Model) -> RiccatiProblem:
    system = model.system
    (tip,) = make_outputs(model.scene, system)
    C_z = np.zeros((system.layout.n_local, 2), order="F")
    for row in tip.dofs:
        C_z[row, [0, 1]] = tip.weight
    return RiccatiProblem(system, tip.C_s, C_z, Q * np.eye(2), R * np.eye(system.layout.n_s), hand_columns(2, 2, "tip"))


@pytest.fixture(scope="module")
def model() -> Model:
    return make_model()


@pytest.fixture(scope="module")
def problem(model: Model) -> RiccatiProblem:
    return make_problem(model)


@pytest.fixture(scope="module")
def small(problem: RiccatiProblem) -> tuple[ReducedSystem, Shapes, Array]:
    """Ten modes and the optimal gain of their plant, by SciPy."""
    _, Phi = lowest_modes(problem.system, 10)
    plant, shapes = galerkin(problem, Phi)
    inverse = np.linalg.inv(plant.E)
    A, B = inverse @ plant.A, inverse @ plant.B
    P = scipy.linalg.solve_continuous_are(A, B, Q * plant.C.T @ plant.C, R * np.eye(B.shape[1]))
    return plant, shapes, -B.T @ P / R


def make_controller(small: tuple[ReducedSystem, Shapes, Array], q_bar: Array, **keys: Any) -> Controller:
    plant, _, K = small
    x_bar, u_bar = plant.rest_at(q_bar)
    return Controller(K, x_bar, u_bar, plant, **keys)


AIM = np.array([0.6, -0.3])


def test_controller_gives_the_sampled_loop(problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array]) -> None:
    """Controller.command on the full plant's reduced state is what ClosedLoop applies with the lifted gain."""
    _, shapes, K = small
    controller = make_controller(small, AIM, period=0.02, limits=np.array([3.0, 45.0]))
    target = hand_target(problem, AIM)
    loop = ClosedLoop(problem, 0.01)
    run = loop.run(expand_gain(shapes, problem, K), target, 100, Actuation(rate=50.0, limits=(3.0, 45.0)))
    u = controller.command(shapes.reduce(problem, run.final))
    later = loop.run(
        expand_gain(shapes, problem, K), target, 1, Actuation(rate=50.0, limits=(3.0, 45.0)), start=run.final
    )
    # the target of the ten modes lacks the sag of the others, which their filter does not see
    assert close(u, later.inputs[0]) < 1e-11  # rounding: modes are decoupled
    assert same_everywhere(problem.layout.comm, u)
    loop.destroy()


def test_controller_carries_the_tissue_without_an_observer(
    problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array]
) -> None:
    """Fed with the hand of a full-order run only, its tissue is that of the run, seen through the filter."""
    plant, shapes, K = small
    target, dt, steps = hand_target(problem, AIM), 0.01, 200
    loop = ClosedLoop(problem, dt)
    run = loop.run(expand_gain(shapes, problem, K), target, steps)
    loop.destroy()
    controller = make_controller(small, AIM, period=dt)
    for q, v in zip(run.q_s, run.v_s, strict=True):
        u = controller.step(q, v)
    seen = shapes.reduce(problem, run.final)
    n_s = problem.layout.n_s
    # modes are decoupled, and the hand's mean acceleration in a step is all they need: equal to rounding
    assert close(controller.tissue, seen[2 * n_s :]) < 1e-9
    assert close(u, controller.command(seen)) < 1e-9  # as above
    wrong = make_controller(small, AIM, period=dt)
    wrong.reset(np.full(plant.N - 2 * n_s, 0.1))
    for q, v in zip(run.q_s, run.v_s, strict=True):
        wrong.step(q, v)
    slowest = -np.linalg.eigvals(np.linalg.solve(plant.E, plant.A))[2 * n_s :].real
    start = np.linalg.norm(0.1 - controller.tissue)
    decay = np.exp(-slowest[slowest > 1e-6].min() * steps * dt)
    assert np.linalg.norm(wrong.tissue - controller.tissue) < 20 * decay * start  # 20: energy norm against plain norm


@pytest.mark.serial
def test_controller_with_own_model_reaches_the_target_at_1_khz(
    problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array]
) -> None:
    """Controller and reduced plant, each stepping by itself, as a robot would."""
    plant, _, K = small
    controller = make_controller(small, AIM)
    n_s, period, steps = problem.layout.n_s, 1e-3, 20000
    left = np.linalg.inv(plant.E - period / 2 * plant.A)
    advance, push = left @ (plant.E + period / 2 * plant.A), period * left @ plant.B
    x, drift = plant.rest_at(np.zeros(n_s))[0], period * left @ plant.f
    begin = time.perf_counter()
    for _ in range(steps):
        u = controller.step(x[:n_s], x[n_s : 2 * n_s])
        x = advance @ x + push @ u + drift
    each = (time.perf_counter() - begin) / steps
    assert close(plant.C @ x, plant.C @ controller.x_bar) < 1e-3  # decays like exp(-0.44 t), t = 20
    assert each < 1e-3  # one tick; measured about 1e-5
    law = Actuation(rate=1000.0)
    reference = run_small(plant, period, K, plant.rest_at(AIM), steps, (problem.Q, problem.R), law)
    assert close(plant.C @ x, reference.outputs[-1]) < 1e-9  # the same recursion
    assert close(u, reference.inputs[-1]) < 1e-9  # the same recursion


def test_a_controller_survives_its_file_bitwise(
    model: Model, problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array], tmp_path: Path
) -> None:
    keys: dict[str, Any] = {
        "limits": np.array([5.0, np.inf]),
        "period": 0.002,
        "scene_hash": scene_hash(model.scene),
        "layout_hash": layout_hash(problem.layout),
        "about": {"method": "ten modes", "Q": Q},
    }
    controller = make_controller(small, AIM, **keys)
    path = controller.save(tmp_path / f"arm{problem.layout.comm.rank}")
    assert path.suffix == ".npz"
    again = Controller.load(path, keys["scene_hash"], keys["layout_hash"])
    assert again.about == controller.about
    assert again.plant.names == controller.plant.names
    q, v = np.array([0.1, 0.2]), np.array([-0.3, 0.4])
    for _ in range(3):
        assert (again.step(q, v) == controller.step(q, v)).all()
        q, v = q + 0.1, v + 0.2
    with pytest.raises(ControlError, match="another mesh"):
        Controller.load(path, layout_hash="0" * 64)
    with pytest.raises(ControlError, match="another scene"):
        Controller.load(path, scene_hash="0" * 64)
    with pytest.raises(ControlError, match="does not exist"):
        Controller.load(tmp_path / "nothing.npz")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ControlError, match="damaged"):
        Controller.load(path)


def test_towards_moves_the_target_only(small: tuple[ReducedSystem, Shapes, Array]) -> None:
    controller = make_controller(small, AIM)
    other = controller.towards(2 * AIM)
    assert (other.K == controller.K).all()
    # K (x_bar - x_bar) = 0: the same bits, or the rounding of one sum
    assert (other.command(other.x_bar) == other.u_bar).all() or close(other.command(other.x_bar), other.u_bar) < 1e-12


@pytest.mark.ranks
def test_a_full_gain_survives_its_file(
    model: Model, problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array], tmp_path_factory: Any
) -> None:
    comm, layout = problem.layout.comm, problem.layout
    folder = comm.bcast(tmp_path_factory.mktemp("gain") if comm.rank == 0 else None)
    gain = expand_gain(small[1], problem, small[2])
    state = hand_target(problem, AIM).state
    path = save_gain(folder / "full.npz", gain, state, layout, scene_hash(model.scene))
    again, target = load_gain(path, layout, scene_hash(model.scene))
    for a, b in ((again.K_s, gain.K_s), (again.K_z, gain.K_z), (again.K_v, gain.K_v)):
        assert (a == b).all()
    assert (target.z == state.z).all()
    assert (target.q_s == state.q_s).all()
    # the rows of the file are in the order of the nodes, whatever the number of ranks
    rows = gather_rows(layout, gain.K_z)
    with np.load(path) as file:
        assert close(file["tissue"][:, : layout.n_s], rows) == 0.0
    other = make_model(tissue={"cells": [4, 6]})
    with pytest.raises(ControlError, match="another mesh"):
        load_gain(path, other.system.layout)
    with pytest.raises(ControlError, match="another scene"):
        load_gain(path, layout, scene_hash(other.scene))


@pytest.mark.ranks
def test_hash_knows_the_mesh_only(problem: RiccatiProblem) -> None:
    ours = layout_hash(problem.layout)
    soft = make_model(tissue={"material": {"lambda": 10.0, "mu": 5.0, "rho": 1.0}})
    wide = make_model(tissue={"size": [1.0, 2.0 + 1e-6]})
    alone = build(soft.scene, comm=MPI.COMM_SELF)
    assert len(ours) == 64
    assert layout_hash(soft.system.layout) == ours
    assert layout_hash(alone.system.layout) == ours  # whatever the number of ranks
    assert layout_hash(wide.system.layout) != ours


def test_what_does_not_fit_is_refused(small: tuple[ReducedSystem, Shapes, Array]) -> None:
    plant, _, K = small
    x_bar, u_bar = plant.rest_at(AIM)
    with pytest.raises(ControlError, match="K of the controller"):
        Controller(K[:, 1:], x_bar, u_bar, plant)
    with pytest.raises(ControlError, match="period"):
        Controller(K, x_bar, u_bar, plant, period=0.0)
    controller = Controller(K, x_bar, u_bar, plant)
    with pytest.raises(ControlError, match="q_s and v_s have 1 and 2 entries; this hand has 2 each"):
        controller.step(np.zeros(1), np.zeros(2))
    for wrong in (np.zeros(3), np.full(2, np.nan)):
        with pytest.raises(ControlError, match="the target must be 2 finite numbers"):
            controller.towards(wrong)
    with pytest.raises(ReducedSystemError, match="shape"):
        plant.under(K[:1])
    with pytest.raises(ReducedSystemError, match="finite"):
        plant.under(np.nan * K)


# --- other packages


def test_python_control_sees_the_same_plant(
    problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array]
) -> None:
    plant, _, K = small
    ours, closed = plant.to_control(), plant.under(K).to_control()
    assert ours.output_labels == ["tip_x [m]", "tip_y [m]"]
    assert ours.input_labels == ["force_x [N]", "force_y [N]"]
    assert ours.state_labels[:4] == ["q_x [m]", "q_y [m]", "v_x [m/s]", "v_y [m/s]"]
    assert ours.nstates == plant.N
    poles = np.linalg.eigvals(np.linalg.solve(plant.E, plant.A + plant.B @ K))
    theirs = closed.poles()
    assert close(np.sort(poles.real), np.sort(theirs.real)) < 1e-9  # eigenvalues of one matrix
    assert theirs.real.max() < 0
    assert closed.nstates == plant.N
    # their own LQR, with their sign of the gain, from the exported plant
    weight = Q * plant.C.T @ plant.C
    G, _, _ = control.lqr(ours, (weight + weight.T) / 2, R * np.eye(2), method="scipy")
    assert close(-np.asarray(G), K) < 1e-6  # SciPy's equation solver, twice, on matrices of condition 1e4
    # a step of the target as an initial condition: their simulation against ours
    x_bar, _ = plant.rest_at(AIM)
    start = plant.rest_at(np.zeros(2))[0]
    times = np.linspace(0.0, 2.0, 21)
    theirs_y = control.initial_response(closed, times, start - x_bar).outputs
    ours_y = run_small(plant, 0.001, K, plant.rest_at(AIM), 2000, (problem.Q, problem.R)).outputs[::100]
    assert (
        close(ours_y - plant.C @ x_bar, theirs_y.T) < 1e-4
    )  # midpoint rule, (omega dt)^2 / 12 of the modes that matter


def test_pymor_sees_the_same_plant(small: tuple[ReducedSystem, Shapes, Array]) -> None:
    plant, _, K = small
    if MPI.COMM_WORLD.size > 1:
        with pytest.raises(ReducedSystemError, match="load it there"):
            plant.to_pymor()
        return
    theirs, their_loop = plant.to_pymor(), plant.under(K).to_pymor()
    assert theirs.order == plant.N
    for s in (0.3 + 1.0j, 5.0j, 40.0j):
        ours = plant.C @ np.linalg.solve(s * plant.E - plant.A, plant.B)
        assert close(theirs.transfer_function.eval_tf(s), ours) < 1e-9  # one solve each
        assert close(plant.transfer([s])[0], ours) < 1e-9  # the same
        closed = plant.C @ np.linalg.solve(s * plant.E - plant.A - plant.B @ K, plant.B)
        assert close(their_loop.transfer_function.eval_tf(s), closed) < 1e-9  # one solve, as above
    assert their_loop.poles().real.max() < 0


def test_start_state_round_trip(problem: RiccatiProblem, small: tuple[ReducedSystem, Shapes, Array]) -> None:
    """reduce(expand(x)) = x, and expand keeps what the shapes can hold."""
    _, shapes, _ = small
    x = np.random.default_rng(5).standard_normal(small[0].N)
    assert close(shapes.reduce(problem, expand(shapes, problem, x)), x) < 1e-12  # W'V = I
    state = rest(problem.system)
    assert isinstance(state, PlantState)


def test_a_hand_that_is_not_measured_gets_the_load_before(small: tuple[ReducedSystem, Shapes, Array]) -> None:
    robot, twin = (make_controller(small, np.array([0.4, -0.2])) for _ in range(2))
    with pytest.raises(ControlError, match="the first samples of the hand must be finite"):
        robot.step(np.array([np.nan, 0.0]), np.zeros(2))
    places = 1e-2 * np.random.default_rng(0).standard_normal((9, 2, 2))
    for tick, (q, v) in enumerate(places):
        u = robot.step(q, v)
        if tick == 4:
            u[:] = 7.0  # the load that is kept is not the caller's
            last = twin.step(q, v)
            for bad in (np.nan, np.inf, 1e308):
                assert np.array_equal(robot.step(np.array([bad, 0.0]), v), last)
                assert np.array_equal(robot.step(q, np.array([0.0, -bad])), last)
        else:
            assert np.array_equal(u, twin.step(q, v))  # no tick of the tissue was lost in between
