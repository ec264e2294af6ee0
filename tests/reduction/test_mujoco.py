"""Tissue on a body of MuJoCo: against the own two-way model, what it conserves, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

import softgrasp as sg
from softgrasp.fem.errors import ResourceError
from softgrasp.fem.frame.integrals import Sums
from softgrasp.fem.petsc import Array
from softgrasp.reduction import online
from softgrasp.reduction.bridges import MujocoTissue, mujoco_body, write_mujoco
from softgrasp.reduction.model import ReducedModel
from softgrasp.reduction.system import ModelError
from softgrasp.reduction.turning.model import TurningModel
from softgrasp.reduction.turning.stepper import TurningSteps

mujoco: Any = pytest.importorskip("mujoco", reason="MuJoCo is no dependency: pip install 'softgrasp[mujoco]'")
pytestmark = pytest.mark.serial
SLIDES = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))


def reduced(effects: dict[str, Any], N: int, turns: bool = True) -> Any:
    """A block of silicone on a Franka Hand."""
    frame = {"rotation": True, "frame": "hand"} if turns else {"rotation": False}
    model = sg.build(
        "block_3d", comm=MPI.COMM_SELF, effects={"gravity": False, "reaction": True} | frame | effects,
        tissue={"cells": [2, 2, 3], "order": 1, "refine": False, "material": "ecoflex-00-30"},
        hand={"mass": 0.73, "inertia": [2e-3, 2e-3, 1e-3]}, output={"snapshots": "memory"},
        motion={"target": [0.05, 0.0, 0.0, *([0.0] * 3 if turns else [])], "duration": 0.1},
        time={"steps": 4, "end": 0.1, "start": "rest"},
    )  # fmt: skip
    return sg.reduce(model, sg.simulate(model), "craig_bampton", N=N)


@pytest.fixture(scope="module")
def rom() -> TurningModel:
    """Twelve modes, damped."""
    model = reduced({"damping": {"kind": "kelvin-voigt", "beta": 0.005}}, 36)
    assert isinstance(model, TurningModel)
    return model


def world(body: str, h: float, gravity: str = "0 0 0", option: str = 'solver="Newton"', more: str = "") -> Any:
    """A model of MuJoCo with the body."""
    option = f'<option timestep="{h}" gravity="{gravity}" {option} {"" if "integrator" in option else EULER}/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{body}</worldbody>{more}</mujoco>")


EULER = 'integrator="Euler"'


def test_of_second_order_beside_the_own_two_way_model(rom: TurningModel) -> None:
    own = reduced({"damping": {"kind": "kelvin-voigt", "beta": 0.005}}, 30, turns=False)
    assert isinstance(own, ReducedModel)

    def force(t: Array) -> Array:
        return np.outer(np.sin(2 * np.pi * t) * (t < 0.5), [8.0, -4.0, 3.0])

    errors, fine = [], 20
    for h in (2e-3, 1e-3, 5e-4):
        steps = round(0.75 / h)
        exact, same = (
            online.run(own.at(), h / parts, force=force((np.arange(steps * parts) + 0.5) * h / parts)).v_s[::parts]
            for parts in (fine, 1)
        )
        model = world(mujoco_body(rom, joint=SLIDES), h)
        data, tissue, found = mujoco.MjData(model), MujocoTissue(rom, model, dt=h), [np.zeros(3)]
        for load in force((np.arange(steps) + 0.5) * h):
            data.qfrc_applied[:] = load
            tissue.step(data)
            found.append(data.qvel.copy())
        assert np.abs(np.array(found) - same).max() < 1e-13 * np.abs(exact).max()  # rounding of 375 to 1500 steps
        errors.append(np.abs(np.array(found) - exact).max() / np.abs(exact).max())
        assert np.array_equal(data.qfrc_applied, load)  # what the user applied stays
    assert errors[1] <= 2e-6  # asked for; 1.995e-6, which is the midpoint rule's own at this step
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 2) < 0.1), (errors, orders)


def momenta(rom: TurningModel, model: Any, data: Any, a: Array, e: Array) -> Array:
    """Linear momentum, and angular momentum about the origin, of all bodies of MuJoCo and of a deformation, (6,)."""
    at, J, body = mujoco.MjData(model), np.zeros((6, model.nv)), model.body("hand").id
    at.qpos[:], at.qvel[:] = data.qpos, data.qvel
    mujoco.mj_forward(model, at)
    mujoco.mj_subtreeVel(model, at)
    mujoco.mj_jacBody(model, at, J[:3], J[3:], body)
    Q, P = at.xmat[body].reshape(3, 3), model.body_subtreemass[0] * at.subtree_linvel[0]
    xi = np.concatenate([Q.T @ J[:3] @ data.qvel, Q.T @ J[3:] @ data.qvel])
    row = TurningSteps(rom.at(1.0).small, 1.0, a, e, xi[3:]).row()
    p, turning = Sums.of(row, 6).momenta(np.zeros((6, 6)), xi).reshape(2, 3) @ Q.T
    about = at.subtree_angmom[0] + np.cross(at.subtree_com[0], P) + turning + np.cross(at.xpos[body], p)
    return np.concatenate([P + p, about])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_free_body_with_tissue_keeps_its_momenta(seed: int) -> None:
    """A rigid one loses them in MuJoCo, in first order."""
    rom, h, rng, drifts = reduced({"damping": False}, 24), 1e-3, np.random.default_rng(seed), []
    model = world(mujoco_body(rom), h)
    for _ in range(4):
        spin, drift = rng.normal(size=3), []
        start = np.concatenate([0.3 * rng.normal(size=3), 2.5 * spin / np.linalg.norm(spin)])
        for alone in (True, False):
            data, tissue, kept = mujoco.MjData(model), MujocoTissue(rom, model, dt=h), []
            data.qvel[:] = start
            for n in range(500):
                data.qfrc_applied[:] = [0.5, -0.3, 0.2, 0.01, 0.02, 0.0] if n < 50 else 0.0
                if alone:
                    mujoco.mj_step(model, data)
                else:
                    tissue.step(data)
                if n >= 50 and n % 25 == 0:
                    kept.append(momenta(rom, model, data, tissue.a, tissue.e).reshape(2, 3))
            drift.append(np.ptp(kept, axis=0).max(axis=1) / np.linalg.norm(kept[0], axis=1))
        drifts.append(drift)
        assert np.abs(tissue.a).max() > 0
    rigid, soft = np.array(drifts).transpose(1, 0, 2)  # changes of the linear and of the angular momentum
    assert soft.max() < 1e-11 < 1e-7 < rigid.min()  # rounding of 500 steps; measured 4e-13 and 4e-7


FLOATING = """<body name="base" pos="1 0 2"><freejoint/><inertial pos=".02 .01 0" mass="3" diaginertia=".05 .04 .03"/>
  <body pos="0 0 .1"><joint name="one" axis="1 0 0" stiffness="3" damping=".05" armature=".01"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".8"/>
  <body pos=".3 0 0" quat=".9 .1 .3 0"><joint axis="0 1 0" stiffness="2" damping=".02"/>{}</body></body></body>"""


def test_a_robot_that_floats_changes_its_momentum_by_gravity_and_forces_alone(rom: TurningModel) -> None:
    """Two links with springs and a motor: forces inside change no momentum, a force from outside by its impulse."""
    text = FLOATING.format(mujoco_body(rom, joint=""))
    model = world(text, 1e-3, "1 2 -9.81", more='<actuator><motor joint="one"/></actuator>')
    data, tissue, push = mujoco.MjData(model), MujocoTissue(rom, model), np.array([0.3, -2.0, 1.0])
    data.qvel[:] = [0.3, -0.2, 0.1, 1.0, 2.0, -1.5, 0.5, -1.0]
    first, weight = momenta(rom, model, data, tissue.a, tissue.e), model.body_subtreemass[0] * model.opt.gravity
    for n in range(300):
        data.ctrl[:], data.xfrc_applied[1, :3] = 0.3 * np.sin(0.01 * n), push if n < 100 else 0.0
        tissue.step(data)
    assert np.abs(tissue.a).max() > 1e-6
    last = momenta(rom, model, data, tissue.a, tissue.e)
    assert (last - first)[:3] == pytest.approx(0.3 * weight + 0.1 * push, rel=1e-11)  # rounding


@pytest.mark.parametrize("compiled", [True, False])
def test_gravity_that_the_model_disables_acts_neither_on_robot_nor_tissue(rom: TurningModel, compiled: bool) -> None:
    ends = []
    for gravity, flag in (("0 0 0", ""), ("1 2 -9.81", '<option><flag gravity="disable"/></option>')):
        model = world(mujoco_body(rom), 1e-3, gravity, more=flag)
        data, tissue = mujoco.MjData(model), MujocoTissue(rom, model)
        tissue._code = tissue._code if compiled else None
        data.qvel[:] = [0.3, -0.2, 0.1, 1.0, 2.0, -1.5]
        tissue.settle(data)
        for _ in range(20):
            tissue.step(data)
        ends.append(np.concatenate([data.qpos, data.qvel, tissue.a]))
    assert np.array_equal(*ends)


def test_a_free_body_turns_as_in_the_own_two_way_model(rom: TurningModel) -> None:
    """The angular velocity after a torque, in second order of the step; MuJoCo's own step is of first order."""
    push = np.array([0.0, 0.0, 0.0, 0.02, 0.04, 0.01])  # in space
    exact, errors = rom.at(2.5e-4).run(force=lambda n, t, q, v: push * (t < 0.1), steps=1200), []
    for h in (2e-3, 1e-3):
        model = world(mujoco_body(rom), h)
        data, tissue = mujoco.MjData(model), MujocoTissue(rom, model, dt=h)
        for n in range(round(0.3 / h)):
            data.xfrc_applied[tissue.body] = push * (n < round(0.1 / h))
            tissue.step(data)
        mujoco.mj_kinematics(model, data)
        spin = data.xmat[tissue.body].reshape(3, 3) @ data.qvel[3:]
        errors.append(np.abs(spin - exact.v_s[-1, 3:]).max() / np.abs(exact.v_s[-1, 3:]).max())
    assert errors[1] < 2e-6  # 7.6e-7; 2.4e-4 by MuJoCo's own step
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


def test_a_free_body_turns_the_same_at_any_speed_and_from_any_direction() -> None:
    rom, ends, boost = reduced({"damping": False}, 24), [], np.array([3.0, -2.0, 1.0])
    model, q = world(mujoco_body(rom), 1e-3), np.array([0.5, -0.1, 0.7, 0.5])
    q /= np.linalg.norm(q)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, q)
    for speed, turn, start in (
        (0.0, np.eye(3), [1.0, 0, 0, 0]),
        (1.0, np.eye(3), [1.0, 0, 0, 0]),
        (0.0, np.eye(3), [0.0, 0, 0, 0]),  # MuJoCo takes it for no turn
        (1.0, matrix.reshape(3, 3), q),
    ):
        data, tissue = mujoco.MjData(model), MujocoTissue(rom, model)
        data.qpos[3:], data.qvel[:] = start, [*(turn @ boost * speed), 2.0, 1.3, 1.3]
        for _ in range(500):
            tissue.step(data)
        mujoco.mj_kinematics(model, data)
        Q = turn.T @ data.xmat[tissue.body].reshape(3, 3)
        v, p = turn.T @ data.qvel[:3] - speed * boost, turn.T @ data.qpos[:3] - 0.5 * speed * boost
        ends.append(np.concatenate([v, p, data.qvel[3:], Q.ravel(), tissue.a]))
    assert np.abs(np.array(ends) - ends[0]).max() < 1e-10  # rounding of 500 steps


@pytest.mark.parametrize("joint", ['<joint axis="0 1 0" damping="0.3"/>', "<freejoint/>"])
def test_the_compiled_step_is_that_in_numpy(rom: TurningModel, joint: str) -> None:
    """A hand on a link that spins, under gravity, with a force of the user and data changed on the way."""
    link = f'<body>{joint}<geom size=".05" pos="0 0 .2" mass="1"/>'
    model, states = world(f"{link}{mujoco_body(rom, joint=SLIDES)}</body>", 1e-3, "1 2 -9.81"), []
    for compiled in (True, False):
        tissue, data = MujocoTissue(rom, model), mujoco.MjData(model)
        assert tissue._code is not None
        if not compiled:
            tissue._code = None
        data.qvel[:] = np.resize([4.0, 1.0, 2.0, -1.0], model.nv)
        data.qfrc_applied[:] = np.resize([0.3, 1.0, 0.0, 2.0], model.nv)
        for n in range(40):
            if n == 20:
                copy = mujoco.MjData(model)
                copy.qpos[:], copy.qvel[:], copy.qfrc_applied[:] = data.qpos, data.qvel, data.qfrc_applied
                data = copy
            tissue.step(data)
        states.append(np.concatenate([data.qpos, data.qvel, data.qfrc_applied, tissue.a, tissue.e, tissue.wrench]))
    assert np.abs(tissue.a).max() > 1e-5
    assert np.abs(states[0] - states[1]).max() < 1e-11 * np.abs(states[1]).max()  # rounding of forty steps


@pytest.mark.parametrize(("solver", "digits"), [("Newton", 1e-8), ("CG", 1e-4)])
def test_a_hand_set_down_presses_with_its_weight_and_that_of_its_tissue(
    rom: TurningModel, solver: str, digits: float
) -> None:
    box = '<freejoint/><geom type="box" size=".08 .08 .05" mass="0"/>'
    body = mujoco_body(rom, joint=box).replace('<body name="hand">', '<body name="hand" pos="0 0 .052">')
    model = world(body + '<geom type="plane" size="2 2 .1"/>', 1e-3, "0 0 -9.81", f'solver="{solver}"')
    data, tissue = mujoco.MjData(model), MujocoTissue(rom, model)
    tissue.settle(data)
    for _ in range(2000):
        tissue.step(data)
    force, local = np.zeros(3), np.zeros(6)
    for c in range(data.ncon):
        mujoco.mj_contactForce(model, data, c, local)
        force += data.contact[c].frame.reshape(3, 3).T @ local[:3]
    weight = 9.81 * (rom.M_hand[0, 0] + rom.at(1e-3).rigid[0, 0])
    assert force[2] == pytest.approx(weight, rel=digits)  # what the solver of contact leaves
    sag = np.linalg.solve(tissue.small.K, tissue.small.G[:, :3] @ [0.0, 0.0, -9.81])
    assert tissue.a == pytest.approx(sag, abs=1e-4 * np.abs(sag).max())
    assert tissue.outputs["tip_z"] == pytest.approx(
        float(rom.outputs.C_z[rom.outputs.names.index("tip_z")] @ sag), rel=1e-3
    )
    assert tissue.wrench == pytest.approx(np.zeros(6), abs=1e-2 * weight * 0.1)  # at rest there is the weight alone


def test_the_file_is_a_model_with_the_mass_of_both(rom: TurningModel, tmp_path: Path) -> None:
    path = write_mujoco(rom, tmp_path / "folder" / "hand.xml", 2e-3)
    model = mujoco.MjModel.from_xml_path(str(path))
    data, rigid = mujoco.MjData(model), rom.at(1.0).rigid
    mujoco.mj_forward(model, data)
    full = np.zeros((6, 6))
    try:
        mujoco.mj_fullM(model, data, full)
    except TypeError:  # the order of the arguments before version 4
        mujoco.mj_fullM(model, full, data.qM)
    assert full == pytest.approx(rom.M_hand + rigid, abs=1e-9)  # a free joint at rest has the axes of the body
    MujocoTissue(rom, model, dt=2e-3).step(data)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResourceError, match="cannot be written"):
        write_mujoco(rom, tmp_path / "file" / "hand.xml")


def test_what_does_not_fit_is_refused(rom: TurningModel) -> None:
    body = mujoco_body(rom)
    for keys, text in (
        ({"option": 'solver="PGS"'}, "dual solvers"),
        ({"option": 'noslip_iterations="3"'}, "dual solvers"),
        ({"option": 'integrator="RK4"'}, "another method than Euler"),
        ({"option": 'integrator="implicitfast"'}, "another method than Euler"),
    ):
        with pytest.raises(ModelError, match=text):
            MujocoTissue(rom, world(body, 1e-3, **keys))
    model = world(body, 1e-3)
    with pytest.raises(ModelError, match=r"step of the MuJoCo model is 0\.001 s and dt = 0\.002 s"):
        MujocoTissue(rom, model, dt=2e-3)
    with pytest.raises(ModelError, match="has no body 'finger'; it has hand, hand_tissue"):
        MujocoTissue(rom, model, body="finger")
    with pytest.raises(ModelError, match="and its tissue"):
        MujocoTissue(rom, world('<body name="hand"><freejoint/><geom size=".01" mass=".001"/></body>', 1e-3))
    with pytest.raises(ModelError, match="small angles"):
        MujocoTissue(reduced({"damping": False}, 12, turns=False), model)
    with pytest.raises(ModelError, match=r"'block.h5' is no model; give what sg.reduce or sg.load returns"):
        MujocoTissue("block.h5", model)  # type: ignore[arg-type]


def test_loads_of_a_spin_are_those_of_point_masses() -> None:
    """What acts on modes and body at a deformation and its velocity, against sums over nine masses."""
    rng, h, k = np.random.default_rng(0), 1e-3, 5
    mass, r, phi = rng.uniform(0.5, 1, 9), rng.normal(size=(9, 3)), rng.normal(size=(k, 9, 3))
    axes = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1)  # axes[c] y = e_c x y
    E, S = np.einsum("n,ink,jnl->klij", mass, phi, phi), np.einsum("n,ink,nl->ikl", mass, phi, r).reshape(k, 9)
    G = np.hstack([np.einsum("n,ink->ik", mass, phi), np.einsum("n,ink,ckl,nl->ic", mass, phi, axes, r)])
    M, K, D = np.trace(E), 7 * np.eye(k), 0.3 * np.eye(k)
    sums = np.hstack([G[:, :3], S])
    tissue: Any = SimpleNamespace(
        dt=h, a=rng.normal(size=k), e=rng.normal(size=k), _past=np.zeros(k), _rate=np.zeros(3),
        small=SimpleNamespace(M=M, K=K, D=D, G=G, S=S, E=E), inverse=np.linalg.inv(M + h / 2 * D + h * h / 4 * K),
        _integrals=np.vstack([E.reshape(9 * k, k), sums.T]), _loads=sums, _forces=np.hstack([K, D + h / 2 * K]),
        _turns=np.vstack([np.zeros((2, 9)), axes.reshape(3, 9)]),
    )  # fmt: skip
    w, g = rng.normal(size=3), rng.normal(size=3)
    inertia, force, right, pulled = MujocoTissue._known(tissue, w, g)

    z, rate = (np.einsum("i,ink->nk", x, phi) for x in (tissue.a + h / 2 * tissue.e, tissue.e))
    place = r + z

    def travel(places: Array, rates: Array) -> Array:
        """Acceleration in the axes of the body that a spin gives to points."""
        return np.cross(w, np.cross(w, places)) + 2 * np.cross(w, rates)

    def rigid(places: Array) -> Array:
        """Mass matrix (6, 6) of the masses fixed to the body."""
        turns = np.einsum("ckl,nl->nkc", axes, places)
        rows = np.concatenate([np.broadcast_to(np.eye(3), (9, 3, 3)), turns], axis=2)
        return np.einsum("n,nki,nkj->ij", mass, rows, rows)

    G_a = np.hstack([G[:, :3], np.einsum("n,ink,ckl,nl->ic", mass, phi, axes, place)])
    r_a = np.einsum("n,ink,nk->i", mass, phi, g - travel(place, rate)) - K @ tissue.a - (D + h / 2 * K) @ tissue.e
    f, f_rigid = travel(place, rate), travel(r, np.zeros((9, 3)))
    v = np.concatenate([
        mass @ (f - f_rigid),
        mass @ (np.cross(place, f) - np.cross(r, f_rigid)) - np.cross(mass @ z, g),
    ])  # fmt: skip
    assert np.abs(pulled - G_a).max() < 1e-12  # rounding of sums of size 10
    assert np.abs(right - r_a).max() < 1e-12
    assert np.abs(inertia - (rigid(place) - rigid(r) - G_a.T @ tissue.inverse @ G_a)).max() < 1e-11
    assert np.abs(force - (G_a.T @ tissue.inverse @ r_a + v)).max() < 1e-11


def test_a_body_whose_mass_matrix_is_kept_as_a_diagonal_is_refused(rom: TurningModel) -> None:
    """MuJoCo has no room for the coupling there."""
    simple = f'<body name="hand">{SLIDES}<inertial pos="0 0 0" mass="5" diaginertia="0.02 0.02 0.02"/></body>'
    model = world(simple, 1e-3)
    assert model.body_simple[1]
    with pytest.raises(ModelError, match="diagonal alone of the mass matrix of body 'hand'"):
        MujocoTissue(rom, model, body="hand", dt=1e-3)


def test_a_body_that_is_held_steps_as_mujoco_does(rom: TurningModel) -> None:
    """A pendulum of a free joint and an equality: momenta are not its own."""
    model, ends = world(mujoco_body(rom), 1e-3, "0 0 -9.81", more=HELD), []
    for flies in (True, False):
        data, tissue = mujoco.MjData(model), MujocoTissue(rom, model)
        if not flies:
            tissue._flight, tissue._code = None, None
        data.qvel[:] = [0.0, 0.0, 0.0, 1.0, 2.0, 3.0]
        for _ in range(50):
            tissue.step(data)
        ends.append(np.concatenate([data.qpos, data.qvel, tissue.a]))
    assert ends[0] == pytest.approx(ends[1], rel=1e-10, abs=1e-13)  # rounding of NumPy beside C
    assert np.abs(ends[0][:3]).max() < 0.05


HELD = '<equality><connect body1="hand" body2="world" anchor="0 0 0.1"/></equality>'
