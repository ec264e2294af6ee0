"""Plans of a hand that feels the tissue, or turns: modes against the whole plant, bounds, and runs."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from softgrasp.fem.model.build import Stopwatch, build
from softgrasp.fem.scene.file import load_scene
from softgrasp.lqr.constrained.horizon import held
from softgrasp.lqr.constrained.pulse import PulseError
from softgrasp.lqr.constrained.rows import turned
from softgrasp.lqr.constrained.tissue import make_surface, modal_tissue
from softgrasp.lqr.dense.modal import assemble_space, gather_tissue
from softgrasp.lqr.design.body import body_surface
from softgrasp.lqr.design.constrained import PlannedControl, plan_control
from softgrasp.lqr.design.feedback import design
from softgrasp.lqr.design.scene import problem as make_problem
from softgrasp.lqr.plant.checks import ControlError

pytestmark = pytest.mark.serial  # dense oracles, and plans that are made on one rank
LIGHT = ("tissue.cells=[2,4]", "effects.reaction=true", "hand.mass=2.0")


@pytest.mark.parametrize("effect", ["effects.reaction=true", "effects.rotation=true"])
@pytest.mark.parametrize("cells", ["[2,4]", "[2,2,2]"])
def test_modes_about_the_centre_move_as_the_whole_plant(cells: str, effect: str) -> None:
    scene = "paper_lqr" if cells == "[2,4]" else "reach_over_3d"
    turns = "rotation" in effect
    rest_of = [f"motion.target={[0.1] * (3 if cells == '[2,4]' else 6)}", "hand.inertia=5.0"] if turns else []
    model = build(load_scene(scene, [f"tissue.cells={cells}", effect, *rest_of]), comm=MPI.COMM_SELF)
    problem = make_problem(model)
    surface = body_surface(model)
    tissue, n_s, grid, parts = modal_tissue(problem, surface), problem.layout.n_s, 0.4, 3
    whole = gather_tissue(problem)
    assert whole is not None
    space = assemble_space(problem, whole)
    A, B = np.linalg.solve(space.E, space.A), np.linalg.solve(space.E, space.B)
    u = np.random.default_rng(0).standard_normal((6, n_s))
    x, r, v = np.zeros(len(A)), np.zeros(n_s), np.zeros(n_s)
    a = u @ np.linalg.inv(problem.M_s).T
    eta = tissue.answer(a, grid, parts)
    largest = 0.0
    for k in range(len(u)):
        for i in range(parts + 1):
            s = grid * i / parts
            F, D = held(A, B, s)
            now = F @ x + D @ u[k]
            q, z = now[:n_s], now[2 * n_s : 2 * n_s + problem.layout.n_e]
            centre = r + s * v + s**2 / 2 * a[k]
            body = surface.with_hand(centre) + tissue.seen @ eta[k, i]
            hand = np.broadcast_to(surface.with_hand(q), body.shape)
            free = hand[: surface.free] + z[surface.rows]
            size = np.abs(free).max() + 1e-3
            assert np.abs(body[: surface.free] - free).max() < 1e-9 * size  # rounding of expm of a stiff plant
            assert np.abs(body[surface.free :] - hand[surface.free :]).max(initial=0.0) < 1e-9 * size
            assert np.allclose(space.C @ now, problem.C_s @ centre + tissue.c @ eta[k, i], atol=1e-9 * size)
            largest = max(largest, float(np.abs(q - centre).max()))
        x, r, v = now, centre, v + grid * a[k]
    assert turns or largest > 1e-7 * np.abs(r).max()  # the hand is not at the centre


def test_bound_is_attained_and_not_exceeded_where_the_hand_feels_the_tissue() -> None:
    model = build(load_scene("paper_lqr", list(LIGHT)), comm=MPI.COMM_SELF)
    problem = make_problem(model)
    full = modal_tissue(problem, make_surface(problem.layout, *model.space.surface()))
    pulses = PulseError(full, full.reduced(5, 1.0), 1.0)
    error = pulses.kernel(1.0)[..., :60]  # what older pulses add is bounded apart
    bound = np.abs(error).sum(axis=-1)
    inputs = np.random.default_rng(0).uniform(-1, 1, (1000, error.shape[-1]))
    for axis in range(2):
        assert (np.abs(error[:, :, axis] @ inputs.T).max(axis=-1) <= bound[:, :, axis]).all()
    j, d = np.unravel_index(bound[..., 0].argmax(), bound.shape[:2])
    worst = np.sign(error[j, d, 0])[::-1][:, None] * [1.0, 0.0]  # the newest pulse last
    gone = [t.seen[j, d] @ t.answer(worst, 1.0, 1)[-1, -1] for t in (full, pulses.reduced)]
    assert gone[0] - gone[1] == pytest.approx(bound[j, d, 0], rel=1e-6)


def test_a_light_hand_that_feels_the_tissue_keeps_its_gaps() -> None:
    model = build(load_scene("paper_obstacle", [*LIGHT, "control.constraints={force=8.0, N=14, parts=4}"]))
    found = plan_control(design(model), Stopwatch(MPI.COMM_SELF))
    plan, runs = found.plan, found.runs
    assert plan.certified
    assert (runs.planned.least >= 0).all()
    assert (runs.free.least < -0.1).all()
    assert np.abs(runs.planned.inputs).max() <= 8 * (1 + 1e-9)
    assert runs.reduction_error <= np.linalg.norm(plan.task.error, axis=1).max()
    assert runs.step_error < 1e-3  # phase of the midpoint steps of 10 ms
    assert abs(runs.planned.cost / plan.cost - 1) < 1e-3  # the reduced plant predicts the cost of the full one
    assert found.online is None
    assert "the hand feels the tissue" in found.reason


TURNING = (
    "tissue.cells=[2,4]", "effects.rotation=true", "hand.inertia=5.0", "motion.target=[5.0,3.0,0.1]",
    "control.outputs=[{kind='node',point=[0.5,0.0],name='tip'},{kind='hand'}]", "obstacle.1.offset=-6.3",
    "control.constraints={force=8.0, speed=2.0, N=14, parts=4}",
)  # fmt: skip


def turned_places(found: PlannedControl, body: np.ndarray) -> np.ndarray:
    """Places (.., nodes, 2) where the hand turns as a rigid body does, from those of small angles."""
    surface = found.surface
    assert surface.rigid is not None
    r = np.column_stack([surface.rigid[:, 1, 2], -surface.rigid[:, 0, 2]])
    (i, j), held = (surface.free, -1), body - surface.nodes  # two nodes that the hand holds, r apart along x
    theta = ((held[..., j, 1] - held[..., i, 1]) / (r[j, 0] - r[i, 0]))[..., None]
    cos, sin = np.cos(theta) - 1, np.sin(theta) - theta
    return body + np.stack([cos * r[:, 0] - sin * r[:, 1], sin * r[:, 0] + cos * r[:, 1]], axis=-1)


def test_a_hand_that_turns_keeps_its_gaps_at_its_true_angle() -> None:
    model = build(load_scene("paper_obstacle", list(TURNING)), comm=MPI.COMM_SELF)
    found = plan_control(design(model), Stopwatch(MPI.COMM_SELF))
    plan, runs = found.plan, found.runs
    assert plan.certified
    true = plan.task.gaps(turned_places(found, runs.planned.body), runs.planned.times)
    assert (runs.planned.gaps >= 0).all()
    assert (true >= 0).all()
    assert runs.reduction_error <= np.linalg.norm(plan.task.error, axis=1).max()
    assert abs(runs.planned.cost / plan.cost - 1) < 1e-3  # the reduced plant predicts the cost of the full one
    assert np.abs(runs.planned.v_s[:, :2]).max() <= 2 * (1 + 1e-9)
    states, inputs = plan.horizon.state(plan.task.start, plan.c), plan.horizon.input(plan.task.start, plan.c)
    bound = turned(plan.horizon.plant, states, inputs, np.asarray(plan.task.arms), np.array([0.1]))
    off = np.linalg.norm(turned_places(found, plan.body()) - plan.body(), axis=-1)
    assert (off <= bound).all()
    assert off.max() > 0.8 * bound.max()  # 2 cm; the bound is that of the larger angle at both ends of a part
    assert off.max() > 0.01
    assert found.online is None
    assert "the hand turns" in found.reason


def test_what_a_hand_that_feels_the_tissue_has_not_is_refused() -> None:
    for changes, sentence in (
        ([*LIGHT, "control.constraints={force=8.0, speed=1.0}"], "control.constraints.speed limits"),
        (
            [*LIGHT, "control={outputs=[{kind='hand'}], constraints={force=8.0}, observer={markers=[[0, 0]]}}"],
            "a plan with control.observer",
        ),
        ([*TURNING, "effects.reaction=true"], "does not turn, or does not feel the tissue"),
    ):
        model = build(load_scene("paper_obstacle", changes), comm=MPI.COMM_SELF)
        with pytest.raises(ControlError, match=sentence):
            plan_control(design(model), Stopwatch(MPI.COMM_SELF))
