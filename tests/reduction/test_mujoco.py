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


def test_a_free_body_with_tissue_keeps_more_than_a_rigid_one() -> None:
    """MuJoCo's explicit gyroscopic forces lose momenta in first order; the linear one of the tissue is given back."""
    rom, h, rng, drifts = reduced({"damping": False}, 24), 1e-3, np.random.default_rng(0), []
    small = rom.at(h)
    M = rom.M_hand + small.rigid
    model = world(mujoco_body(rom), h)
    for _ in range(6):
        spin, drift = rng.normal(size=3), []
        start = np.concatenate([0.3 * rng.normal(size=3), 2.5 * spin / np.linalg.norm(spin)])
        for alone in (True, False):
            data, at, tissue, kept = mujoco.MjData(model), mujoco.MjData(model), MujocoTissue(rom, model, dt=h), []
            data.qvel[:] = start
            for n in range(750):
                data.qfrc_applied[:] = [0.5, -0.3, 0.2, 0.01, 0.02, 0.0] if n < 50 else 0.0
                if alone:
                    mujoco.mj_step(model, data)
                else:
                    tissue.step(data)
                if n >= 50 and n % 25 == 0:
                    at.qpos[:], at.qvel[:] = data.qpos, data.qvel
                    mujoco.mj_forward(model, at)
                    J, Q = np.zeros((6, 6)), at.xmat[tissue.body].reshape(3, 3)
                    mujoco.mj_jacBody(model, at, J[:3], J[3:], tissue.body)
                    xi = np.concatenate([Q.T @ J[:3] @ data.qvel, Q.T @ J[3:] @ data.qvel])
                    row = TurningSteps(small.small, h, tissue.a, tissue.e, xi[3:]).row()
                    P, L = Sums.of(row, 6).momenta(M, xi).reshape(2, 3) @ Q.T
                    kept.append([P, L + np.cross(at.xpos[tissue.body], P)])
            drift.append(np.ptp(kept, axis=0).max(axis=1) / np.linalg.norm(kept[0], axis=1))
        drifts.append(drift)
        assert np.abs(tissue.a).max() > 0
        data.qvel[:3] += 1.0  # by the user: not to be given back
        before = data.qvel[:3].copy()
        tissue.step(data)
        assert np.abs(data.qvel[:3] - before).max() < 0.05
    rigid, soft = np.array(drifts).transpose(1, 0, 2)  # changes of the linear and of the angular momentum
    assert np.all(soft[:, 0] < rigid[:, 0])
    # the hand spins about its centre, so that it loses no linear momentum; of the angular one MuJoCo loses as before
    assert np.all(soft.sum(axis=0) < [0.02, 1.0] * rigid.sum(axis=0))  # measured 0.009 and 0.62


def test_a_free_body_turns_the_same_at_any_speed() -> None:
    rom, ends, boost = reduced({"damping": False}, 24), [], np.array([3.0, -2.0, 1.0])
    model = world(mujoco_body(rom), 1e-3)
    for speed in (0.0, 1.0):
        data, tissue = mujoco.MjData(model), MujocoTissue(rom, model)
        data.qvel[:] = [*(speed * boost), 2.0, 1.3, 1.3]
        for _ in range(500):
            tissue.step(data)
        ends.append(np.concatenate([data.qvel[:3] - speed * boost, data.qvel[3:], data.qpos[3:], tissue.a]))
    assert np.abs(ends[1] - ends[0]).max() < 1e-10  # rounding of 500 steps


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
